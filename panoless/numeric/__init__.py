"""Numerical methods without a subject: robust weights, Gauss–Newton, splines, polygons. Imports kernels at most."""
