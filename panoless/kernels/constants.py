"""Numbers that define what the kernels compute; every backend reads them from here."""

import math

ALPHA_MAX = 0.99
"""Largest alpha of one fragment, so that something always shines through (Kerbl et al. 2023)."""

ALPHA_MIN = 1 / 255
"""A fragment below this alpha is skipped."""

TRANSMITTANCE_MIN = 1e-4
"""Blending of a pixel stops before the fragment that would bring the transmittance below this."""

MEDIAN_TRANSMITTANCE = 0.5
"""The median depth is that of the last fragment met while the transmittance is above this."""

LOW_PASS_SIGMA = math.sqrt(2) / 2
"""Standard deviation, in pixels, of the screen-space Gaussian below which no surfel shrinks (Huang et al. 2024, Eq.
11).
"""

HIT_RATIO_MIN = 0.1
"""A ray–surfel hit counts while (depth of the center) / (depth of the hit) is at least this; it excludes hits behind
the camera.
"""

EDGE_ON_COSINE_MIN = 1e-4
"""Below this |cos| between normal and viewing ray a surfel has no usable intersection and is drawn by its low pass
alone.
"""

CAMERA_PLANE_MARGIN = 1e-3
"""A surfel whose disk comes this close (relative to its squared depth) to the plane of the camera is given the whole
image as its box.
"""

TILE = 16
"""Edge in pixels of the tiles that `rasterize` can be told to leave out."""

ALPHA_FLOOR = 1e-3
"""Alpha by which the accumulated depth is divided at least; below it a pixel shows nothing."""

SHORTEST_NORMAL = 1e-8
"""Blended normals are divided by their length, but at least by this."""

CHARBONNIER = 1e-2
"""ε of the photometric term √(‖e‖² + ε²)."""

ALPHA_MARGIN = 1e-4
"""The cross-entropy of the silhouette takes alpha to lie this far inside (0, 1)."""

SURFACE_ALPHA = 0.5
"""Pixels with more alpha than this have a surface whose normals must be consistent."""

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

SPLAT_DILATION = 0.3
"""Variance, in square pixels, that is added to every splat, so that none falls between pixels (Kerbl et al. 2023)."""

SPLAT_TANGENT_SHARE = 1.3
"""The slope at which a Gaussian is projected ends so many halves of the picture from its middle (Kerbl et al. 2023)."""
