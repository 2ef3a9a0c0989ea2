"""Large arrays that are used again, because fresh pages cost as much as the kernels that fill them.

An array from `take` belongs to the caller alone until its last reference is gone; then its memory may be handed out
again. That holds for views and for tensors made by `torch.from_numpy`, which keep the array alive, so autograd state
and results are safe as long as anyone can see them.
"""

import math
import threading
import weakref

import numpy as np

_KEEP = 64
"""Buffers kept for later use; beyond this the smallest are released."""

_ALIGNMENT = 64

_free: list[np.ndarray] = []
_lock = threading.RLock()


def _give_back(memory: np.ndarray) -> None:
    with _lock:
        _free.append(memory)
        _free.sort(key=lambda buffer: buffer.size)
        if len(_free) > _KEEP:
            del _free[0]


class _Lease:
    """The owner at the end of an array's chain of bases; when it goes, nobody can see the memory any more."""

    def __init__(self, memory: np.ndarray, size: int):
        address = memory.ctypes.data + -memory.ctypes.data % _ALIGNMENT
        self.__array_interface__ = {"version": 3, "shape": (size,), "typestr": "|u1", "data": (address, False)}
        weakref.finalize(self, _give_back, memory).atexit = False


def take(shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
    """Return an uninitialized C-contiguous array; its memory is used again once nothing refers to the array."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size == 0:
        return np.empty(shape, dtype)
    with _lock:
        index = next((i for i, buffer in enumerate(_free) if size + _ALIGNMENT <= buffer.size <= 2 * size + 4096), None)
        memory = None if index is None else _free.pop(index)
    if memory is None:
        memory = np.empty(size + size // 8 + _ALIGNMENT, np.uint8)
    return np.asarray(_Lease(memory, size)).view(dtype).reshape(shape)
