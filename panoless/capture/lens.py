"""What the lens of all views may be instead of what is said of it: of another focal length, or bent.

**Cameras farther away through a longer lens** leave silhouettes where they are. With eˢ times the distance from the
object's center and eˢ times the focal length a camera sees every point where it did, to first order, but from another
side. Of a camera with the optical axis a the ray o + t d becomes

o + (eˢ − 1) o + t (d + (eˢ − 1)(d·a) a), to first order one of the turn ω = s (d·a) d × a and the shift τ = s o.

**One radial distortion** k₁, as OpenCV and COLMAP have it: what a pinhole would show at q from the principal point, in
focal lengths, is seen at q (1 + k₁ |q|²). The ray of a pixel turns by ω = k₁ |q|² (d·a) d × a, to first order.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch.nn.functional import grid_sample

from panoless.capture.views import TrainView
from shinypartial.core.conventions import PIXEL_CENTER, SOLID_ALPHA

INVERSE_STEPS = 6
"""Newton steps that undo a distortion: rays are then exact to 1e-12 where it does not fold the picture."""


@dataclass(frozen=True)
class LensChange:
    """Unknowns of a lens that all views share; None for one that is fixed."""

    focal: float | None = None
    """s where the focal length is said to be e⁻ˢ times what it is: cameras are eˢ as far away and see through a lens of
    eˢ times the focal length, so that silhouettes stay where they are.
    """
    k1: float | None = None
    """The radial distortion."""

    def rays(
        self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], axes: Float[np.ndarray, "P 3"]
    ) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
        """Origins and unit directions of rays through that lens; `axes` are the optical ones of their cameras."""
        if self.focal is not None:
            origins, directions = farther_rays(origins, directions, axes, self.focal)
        if self.k1 is not None:
            directions = undistorted_rays(directions, axes, self.k1)
        return origins, directions

    def motions(
        self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], axes: Float[np.ndarray, "P 3"]
    ) -> Float[np.ndarray, "P 6 M"]:
        """(ω, τ) of rays by each of the unknowns, to first order."""
        along = (directions * axes).sum(1, keepdims=True)
        turns = np.cross(directions, along * axes)
        farther_away = np.concatenate([turns, origins], 1)
        bent = np.concatenate([(along**-2 - 1) * turns, np.zeros_like(origins)], 1)
        both = zip((self.focal, self.k1), (farther_away, bent), strict=True)
        return np.stack([motion for known, motion in both if known is not None], 2)


def with_focal_factor(view: TrainView, factor: float) -> TrainView:
    """A view through a lens of so many times the focal length."""
    camera = view.camera
    return replace(view, camera=replace(camera, fx=factor * camera.fx, fy=factor * camera.fy))


def farther_rays(
    origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], axes: Float[np.ndarray, "P 3"], s: float
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Origins and unit directions of rays after that change; `axes` are the optical ones of their cameras."""
    found = directions + np.expm1(s) * (directions * axes).sum(1, keepdims=True) * axes
    return origins + np.expm1(s) * origins, found / np.linalg.norm(found, axis=1, keepdims=True)


def undistorted_rays(
    directions: Float[np.ndarray, "P 3"], axes: Float[np.ndarray, "P 3"], k1: float
) -> Float[np.ndarray, "P 3"]:
    """Unit directions of what a lens of that distortion shows where a pinhole has the rays of those directions.

    With u the share of the distance from the optical axis, u (1 + k₁ r² u²) = 1.
    """
    beside = directions / (directions * axes).sum(1, keepdims=True) - axes
    bend = k1 * (beside**2).sum(1, keepdims=True)
    share = np.ones_like(bend)
    for _ in range(INVERSE_STEPS):
        slope = 1 + 3 * bend * share**2
        share = share - (share * (1 + bend * share**2) - 1) / np.maximum(slope, 0.1)
    found = axes + share * beside
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def undistorted_view(view: TrainView, k1: float) -> TrainView:
    """A view as a pinhole of its camera would have shown it, of the same size: radiance looked up bicubically (Keys
    1981), the mask bilinearly, so that only what lies among solid pixels is solid.
    """
    camera = view.camera
    indices = [torch.arange(size, dtype=torch.float64) + PIXEL_CENTER for size in view.mask.shape]
    y, x = torch.meshgrid((indices[0] - camera.cy) / camera.fy, (indices[1] - camera.cx) / camera.fx, indexing="ij")
    stretch = 1 + k1 * (x**2 + y**2)
    column, row = camera.cx + camera.fx * stretch * x, camera.cy + camera.fy * stretch * y
    places = torch.stack([2 * column / camera.width - 1, 2 * row / camera.height - 1], 2)[None].to(view.radiance)
    radiance = grid_sample(view.radiance[None], places, "bicubic", "border", align_corners=False)[0]
    mask = grid_sample(view.mask[None, None], places, "bilinear", "border", align_corners=False)[0, 0]
    highest = view.radiance.amax((1, 2), keepdim=True)
    solid = torch.nonzero(mask.flatten() > SOLID_ALPHA)[:, 0]
    return replace(view, radiance=radiance.clamp(min=0).minimum(highest), mask=mask, solid=solid)
