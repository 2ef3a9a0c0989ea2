"""The operators of splatting in plain torch: the definition that the fast kernels are checked against."""
