"""What one surfel looks like to the tile kernels: two cache lines of float32, and the gradient of the first of them.

With (dx, dy) the pixel minus the projected center and w = HIT_CENTER + A2·dx + B2·dy, the ray meets the surfel at u =
(A0·dx + B0·dy) / w, v = (A1·dx + B1·dy) / w, at depth DEPTH / w. An edge-on surfel has HIT_CENTER = 0 and no slopes,
so that w = 0 marks every hit as invalid; otherwise HIT_CENTER is 1.
"""

from panoless.splats.kernels.constants import TILE as TILE

CENTER_X, CENTER_Y = 0, 1
A0, B0, A1, B1, A2, B2 = 2, 3, 4, 5, 6, 7
DEPTH = 8
HIT_CENTER = 9
LOG2_OPACITY = 10
RHO_MAX = 11
"""Value of min(u² + v², 2·|dx, dy|²) at which alpha falls to ALPHA_MIN."""
COLOR = 12
NORMAL = 15
CURVED_U = 18
"""The normal's derivative with respect to u; CURVED_V with respect to v. Left unset, and never read, where surfels
are flat.
"""
CURVED_V = 21
ELLIPSE_X, ELLIPSE_Y = 24, 25
FORM_XX, FORM_XY, FORM_YY = 26, 27, 28
"""(p − ellipse)ᵀ FORM (p − ellipse) ≤ 1 holds for every pixel p at which u² + v² ≤ RHO_MAX."""
SLOPE_X, SLOPE_Y = 29, 30
"""The form is least at x = SLOPE_X·y on a horizontal line, and at y = SLOPE_Y·x on a vertical one."""
RECORD_SIZE = 32

GRAD_OPACITY = 9
"""Gradient rows follow the record up to DEPTH; here stands Σ dL/dα·α, which is the opacity times its gradient."""
GRAD_NORMAL = 10
GRAD_CURVED_U = 13
GRAD_CURVED_V = 16
GRAD_COLOR_FLAT = 13
GRAD_COLOR_CURVED = 19
FLAT_GRADIENT_SIZE = 16
CURVED_GRADIENT_SIZE = 24

CAMERA_TRANSLATION = 9
"""The rotation stands before it, row by row."""
CAMERA_FX, CAMERA_FY, CAMERA_CX, CAMERA_CY, CAMERA_NEAR = 12, 13, 14, 15, 16
CAMERA_SIZE = 17

BLOCK = 4
"""Edge of a block in pixels; a tile is 4×4 blocks."""
CULLED = 0xFFFFFFFF
"""Sorting key of a surfel that is not drawn; no depth has these bits."""
