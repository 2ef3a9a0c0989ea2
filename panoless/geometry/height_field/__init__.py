"""A bent mirror: a B-spline height over a plane. Imports the plane, and the surfels that a free fit starts from."""
