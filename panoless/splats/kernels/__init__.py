"""Operators of splatting, each with a plain reference beside its fast kernels, as in `panoless.kernels`. Imports that
room only.
"""
