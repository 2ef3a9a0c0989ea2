"""The same operators in Numba, threaded: vectorized for float32 tensors on the CPU, plain loops for float64 arrays."""
