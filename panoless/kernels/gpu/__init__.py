"""The operators in Triton, for float32 tensors on a CUDA or ROCm device, or on the CPU through Triton's interpreter."""
