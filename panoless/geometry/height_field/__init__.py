"""A bent mirror: a B-spline height over a plane. Imports the plane."""
