"""Curved Gaussian surfels, fitted by gradient descent."""
