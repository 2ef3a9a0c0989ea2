"""Large arrays that are used again, because fresh pages cost as much as the kernels that fill them.

An array from `take` belongs to the caller alone until its last reference is gone; then its memory may be handed out
again. That holds for views and for tensors made by `torch.from_numpy`, which keep the array alive, so autograd state
and results are safe as long as anyone can see them.
"""

import math
import threading
from bisect import bisect_left, insort
from collections.abc import Callable

import numpy as np

_KEEP = 64
"""Buffers kept for later use; beyond this the smallest are released."""

_ALIGNMENT = 64

_Buffer = tuple[int, int, np.ndarray]
"""Bytes that fit, their aligned address, and the memory."""

_free: list[_Buffer] = []
"""Sorted by size; addresses differ, so that two buffers never compare their memory."""
_lock = threading.RLock()


def _new_buffer(size: int) -> _Buffer:
    room = size + size // 8
    memory = np.empty(room + _ALIGNMENT, np.uint8)
    address = memory.ctypes.data
    return room, address + -address % _ALIGNMENT, memory


def _give_back(buffer: _Buffer) -> None:
    with _lock:
        insort(_free, buffer)
        if len(_free) > _KEEP:
            del _free[0]


class _Lease:
    """The owner at the end of an array's chain of bases; when it goes, nobody can see the memory any more."""

    __slots__ = ("__array_interface__", "_buffer")

    def __init__(self, buffer: _Buffer, shape: tuple[int, ...], dtype: np.dtype):
        self._buffer = buffer
        address = (buffer[1], False)
        self.__array_interface__ = {"version": 3, "shape": shape, "typestr": dtype.str, "data": address}

    def __del__(self, give_back: Callable[[_Buffer], None] = _give_back) -> None:
        # The default keeps the function alive while the interpreter shuts down.
        give_back(self._buffer)


def take(shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
    """Return an uninitialized C-contiguous array; its memory is used again once nothing refers to the array."""
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    if size == 0:
        return np.empty(shape, kind)
    with _lock:
        index = bisect_left(_free, (size,))
        found = index < len(_free) and _free[index][0] <= 2 * size + 4096
        buffer = _free.pop(index) if found else None
    return np.asarray(_Lease(buffer or _new_buffer(size), shape, kind))
