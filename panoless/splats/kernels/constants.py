"""Numbers that define what the kernels of splatting compute; every backend reads them from here."""

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
"""Edge in pixels of the tiles that `rasterize` can leave out."""

CHARBONNIER = 1e-2
"""ε of the photometric term √(‖e‖² + ε²)."""

ALPHA_MARGIN = 1e-4
"""The cross-entropy of the silhouette takes alpha to lie this far inside (0, 1)."""

SURFACE_ALPHA = 0.5
"""Pixels with more alpha than this have a surface whose normals must be consistent."""

SPLAT_DILATION = 0.3
"""Variance, in square pixels, that is added to every splat, so that none falls between pixels (Kerbl et al. 2023)."""

SPLAT_TANGENT_SHARE = 1.3
"""The slope at which a Gaussian is projected ends so many halves of the picture from its middle (Kerbl et al. 2023)."""
