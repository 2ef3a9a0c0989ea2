"""Curved Gaussian surfels, fitted by gradient descent. Imports no other kind."""
