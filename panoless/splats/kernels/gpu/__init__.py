"""The operators of splatting in Triton, for float32 tensors on a CUDA or ROCm device, or in its interpreter."""
