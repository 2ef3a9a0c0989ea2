"""Every operator in plain torch or numpy: the definition that the fast kernels are checked against."""
