"""Rays to an environment map, its confidence and its distance; knows no geometry.
Imports capture, numeric and kernels.
"""
