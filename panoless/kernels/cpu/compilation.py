"""How kernels are compiled."""

PLAIN_LOOPS = {"nogil": True, "cache": True, "error_model": "numpy"}
"""Loops without fast math."""

VECTORIZED_LOOPS = {
    **PLAIN_LOOPS,
    # Everything of LLVM's fast math except `nnan` and `ninf`: inputs that are not finite must still compare as such.
    "fastmath": {"reassoc", "nsz", "arcp", "contract", "afn"},
}
"""Plain scalar loops that LLVM vectorizes."""

LANE_CODE = {**PLAIN_LOOPS, "_nrt": False}
"""Loops over `Lanes`, without Numba's reference counting.

It counts at every call that was inlined, by atomic operations that took a quarter of the time of blending, and more
where threads share a cache line. So such a function allocates nothing: scratch memory is an argument, a part a thread.
"""

INLINED_LANE_CODE = {"forceinline": True, "_nrt": False}
"""Parts of `LANE_CODE` functions."""
