"""A free-form mirror: the zero level of a tricubic B-spline. Imports no other kind."""
