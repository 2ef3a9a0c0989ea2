"""Mathematics without a subject: robust weights, solvers, splines, polygons. Imports kernels at most."""
