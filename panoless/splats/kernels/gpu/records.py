"""What one surfel looks like to the tile kernels: one cache line of float32, and its gradient.

With (dx, dy) the pixel minus the projected center and w = HIT_CENTER + A2·dx + B2·dy, the ray meets the surfel at u =
(A0·dx + B0·dy) / w, v = (A1·dx + B1·dy) / w, at depth DEPTH / w. An edge-on surfel has HIT_CENTER = 0 and no slopes,
so that w = 0 marks every hit as invalid; otherwise HIT_CENTER is 1.
"""

from triton.language import constexpr

CENTER_X, CENTER_Y = constexpr(0), constexpr(1)
A0, B0, A1, B1, A2, B2 = (constexpr(i) for i in range(2, 8))
DEPTH = constexpr(8)
HIT_CENTER = constexpr(9)
LOG2_OPACITY = constexpr(10)
RHO_MAX = constexpr(11)
"""Value of min(u² + v², 2·|dx, dy|²) at which alpha falls to ALPHA_MIN."""
COLOR = constexpr(12)
NORMAL = constexpr(15)
CURVED_U = constexpr(18)
"""The normal's derivative with respect to u; CURVED_V with respect to v. Never read where surfels are flat."""
CURVED_V = constexpr(21)
ELLIPSE_X, ELLIPSE_Y = constexpr(24), constexpr(25)
FORM_XX, FORM_XY, FORM_YY = constexpr(26), constexpr(27), constexpr(28)
"""(p − ellipse)ᵀ FORM (p − ellipse) ≤ 1 holds for every pixel p at which u² + v² ≤ RHO_MAX."""
RECORD_SIZE = constexpr(32)

GRAD_OPACITY = constexpr(9)
"""Gradient rows follow the record up to DEPTH; here stands Σ dL/dα·α, which is the opacity times its gradient."""
GRAD_COLOR = constexpr(10)
GRAD_NORMAL = constexpr(13)
GRAD_CURVED_U = constexpr(16)
GRAD_CURVED_V = constexpr(19)
FLAT_GRADIENT_SIZE = constexpr(16)
GRADIENT_SIZE = constexpr(32)
"""Row length, flat or curved: a row is added by one instruction of one warp."""
