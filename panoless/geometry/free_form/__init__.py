"""A free-form mirror: the zero level of a tricubic B-spline."""
