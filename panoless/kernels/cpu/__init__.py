"""The same operators in Numba, vectorized and threaded, for float32 tensors on the CPU."""
