"""How other methods shade surfels and 3D Gaussians: one file a method, on shared parts. `registry` names them."""
