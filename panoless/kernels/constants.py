"""Numbers that define what the kernels compute; every backend reads them from here."""

ALPHA_FLOOR = 1e-3
"""Alpha by which the accumulated depth is divided at least; below it a pixel shows nothing."""

SHORTEST_NORMAL = 1e-8
"""Blended normals are divided by their length, but at least by this."""

MAX_NEWTON_STEPS, NEWTON_CONVERGED = 20, 1e-10
"""Of a ray toward a height field; it is there when the height over it is below this, which float64 rounds to."""

LEAST_RISE = 1e-6
"""A ray looks into a mouth, or leaves it, if its unit direction falls or rises by more than this."""

LEAST_FACING = 0.05
"""A ray sees the front of a slope if the cosine between it and the normal's opposite is above this."""

LEAST_STEP = 0.25
"""A ray toward a level set proceeds by at least so many cells."""

MAX_ROOT_STEPS, ROOT_CONVERGED = 60, 1e-9
"""Of a ray within the cell where it meets a level set; it is there when a step is this short, relative to its length.
"""

LEAST_SLANT = 0.05
"""Cosine between a ray and the surface's normal by which the slide of its hit is divided at least."""

SHORTEST_DIRECTION = 1e-30
"""A direction whose components are all smaller looks nowhere."""

SUB_PIXELS = {1: ((0.0, 0.0),), 4: ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))}
"""Places of one and of four rays of a pixel, from its center, in pixels."""
