"""Gaussian surfels and the compared methods that shade them, with their training and kernels. Imports geometry and
below; what chooses, fits and judges a geometry never imports it.
"""
