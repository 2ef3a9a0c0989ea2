"""The operators of splatting in Numba, threaded and vectorized, for float32 tensors on the CPU."""
