"""A free-form mirror: the zero level of a tricubic B-spline. Imports the surfels that a free fit starts from."""
