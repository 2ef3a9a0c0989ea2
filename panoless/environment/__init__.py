"""Rays to an environment map and its confidence; knows no geometry. Imports capture, numeric and kernels."""
