"""Every operator in plain torch: the definition that the fast kernels are checked against."""
