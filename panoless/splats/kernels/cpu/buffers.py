"""Large arrays that are used again, because fresh pages cost as much as the kernels that fill them.

An array from `take` belongs to the caller alone until its last reference is gone; then its memory may be handed out
again. That holds for views and for tensors made by `torch.from_numpy` too, so autograd state and results are safe as
long as anyone can see them: a view of a view refers to the array that owns the memory, so the owner's reference count
says whether anyone does.
"""

import math
from bisect import bisect_left, insort
from sys import getrefcount
from threading import Lock

import numpy as np

_KEEP = 128
"""Buffers, in use or not; beyond this the smallest unused one is forgotten."""

_ALIGNMENT = 64

_Buffer = tuple[int, int, np.ndarray]
"""Bytes that fit, where they are aligned, and the memory."""

_buffers: list[_Buffer] = []
"""Sorted by size."""
_lock = Lock()


def _new_buffer(size: int) -> _Buffer:
    room = size + size // 8
    memory = np.empty(room + _ALIGNMENT, np.uint8)
    return room, -memory.ctypes.data % _ALIGNMENT, memory


def _references(buffer: _Buffer) -> int:
    return getrefcount(buffer[2])


_UNUSED = _references(_new_buffer(0))


def take(shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
    """Return an uninitialized C-contiguous array; its memory is used again once nothing refers to the array."""
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    if size == 0:
        return np.empty(shape, kind)
    with _lock:
        _, offset, memory = _find(size) or _add(size)
        return np.ndarray(shape, kind, memory, offset)


def _find(size: int) -> _Buffer | None:
    """The smallest unused buffer that fits, unless it is more than twice as large."""
    for index in range(bisect_left(_buffers, (size,)), len(_buffers)):
        buffer = _buffers[index]
        if buffer[0] > 2 * size + 4096:
            return None
        if _references(buffer) == _UNUSED:
            return buffer
    return None


def _add(size: int) -> _Buffer:
    if len(_buffers) >= _KEEP:
        smallest = next((i for i, buffer in enumerate(_buffers) if _references(buffer) == _UNUSED), None)
        if smallest is not None:
            del _buffers[smallest]
    buffer = _new_buffer(size)
    insort(_buffers, buffer, key=lambda each: each[0])
    return buffer
