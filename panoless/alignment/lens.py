"""The lens, by what is mirrored: how far photographs pull a fitted surface toward another focal length or distortion.

A longer focal length shows an object larger, so a fit in which it is wrong by the factor eˢ finds the object e⁻ˢ as
large, and the directions of its rays too near to each other by as much. In the frame of the object that is the camera
eˢ as far away: it sees every point where it did, to first order, but from another side. What a pixel mirrors turns by
δr, and the map of all views no longer agrees with itself. With the rows B = ∇E·δr, the residuals e and the projection Π
on means over a texel, the pull is −(Bᵀ W (1 − Π) B)⁻¹ Bᵀ W (1 − Π) e.

A radial distortion moves what is seen at q by k₁ |q|² q. The fit takes most of that over at outlines, where it has made
the object as much larger, so what is left is about k₁ (|q|² − ρ²) q, with ρ the distance of outlines from the principal
point. Those of a disk have twice the mean square of its pixels.

A fitted shape has bent until it agrees as well as it can. So the pull is only a share of the change, which differs from
kind to kind; it vanishes where the lens is right.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.lens import farther, zoomed
from panoless.capture.rays import camera_rays
from panoless.capture.views import TrainView, Views, at_most_pixels
from panoless.environment.following import FollowingMap
from panoless.environment.mirrored import radiance_of, slopes_of
from panoless.environment.rays import Rays
from panoless.environment.solve import solve_environment
from panoless.geometry.base import Geometry
from panoless.journal import remembered
from panoless.numeric.robust import robust_weight
from shinypartial.core.conventions import PIXEL_CENTER

DIFFERENCE = 2e-3
"""Of the logarithm of the focal length, for derivatives; not tuned."""
LEAST_COUNTED = 0.25
"""At least this share of the rays is beyond what texels take over; not tuned."""


@dataclass(frozen=True)
class LensUnknown:
    """What may be wrong with the lens of all views, and how the ray of a pixel moves with it."""

    name: Literal["focal", "k1"]
    """Of the logarithm of the focal length, or of the radial distortion."""
    moved: Callable[[TrainView, float], TrainView]
    """The camera by which a ray moves…"""
    is_radial: bool
    """…as much more as |q|² is larger than ρ²."""
    widest_turn: float
    """Mirrored rays that turn by more, in rad for a change of that camera by one, lose their vote: they graze the
    surface, or are mirrored more than once. Usual ones turn by the object's half angle, or, where the camera stays
    where it is, by that and by what the surface bends."""


FOCAL_LENGTH = LensUnknown("focal", farther, is_radial=False, widest_turn=1.0)
DISTORTION = LensUnknown("k1", zoomed, is_radial=True, widest_turn=2.0)
OUTLINE_SHARE = 2.0
"""ρ² over the mean of |q|²."""


@dataclass(frozen=True)
class LensPull:
    """The change that photographs ask for under a surface that stays, and its standard deviation by their noise."""

    step: float
    sigma: float


@remembered()
def lens_pull(
    views: Views, geometry: Geometry, unknown: LensUnknown, rays: int, resolution: int, robust_scale: float
) -> LensPull:
    """The pull of about so many pixels of corrected views; the map has `resolution` texels along a face side.

    `robust_scale` (linear radiance) is the residual beyond which a ray loses its vote.
    """
    seen = zip(*_seen(views, geometry, unknown, rays), strict=True)
    directions, turns, squares, radiance = (np.concatenate(parts) for parts in seen)
    environment = solve_environment(
        [Rays(torch.from_numpy(directions).float(), torch.from_numpy(radiance).float())], resolution
    )
    residual = radiance_of(environment, directions) - radiance
    weights = robust_weight(residual, robust_scale) * robust_weight(turns, unknown.widest_turn)
    if unknown.is_radial:
        turns = turns * (squares - OUTLINE_SHARE * squares.mean())[:, None]
    following = FollowingMap.of(directions, weights, resolution)
    gradient, matrix = following.equations(np.matmul(slopes_of(environment, directions), turns[..., None]), residual)
    curvature, votes = max(float(matrix[0, 0]), 1e-12), float(weights.sum())
    counted = 3 * max(votes - following.count, votes * LEAST_COUNTED, 1.0)
    variance = float((weights[:, None] * residual**2).sum()) / counted
    return LensPull(-float(gradient[0]) / curvature, (variance / curvature) ** 0.5)


def _seen(views: Views, geometry: Geometry, unknown: LensUnknown, rays: int) -> list[tuple[np.ndarray, ...]]:
    """Of each view: the directions that pixels mirror, how these turn as the camera moves, |q|², and what was seen."""
    found: list[tuple[np.ndarray, ...]] = []
    with torch.no_grad():
        for view, pixels in at_most_pixels(geometry.corrected(views), rays):
            (near, ahead), (far, behind) = (
                _mirrored(geometry, unknown.moved(view, sign * DIFFERENCE), pixels) for sign in (1.0, -1.0)
            )
            common, first, second = np.intersect1d(near, far, assume_unique=True, return_indices=True)
            mean = ahead[first] + behind[second]
            directions = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
            radiance = view.radiance_at(torch.from_numpy(common))
            turns = (ahead[first] - behind[second]) / (2 * DIFFERENCE)
            row, column = np.divmod(common, view.camera.width)
            places = camera_rays(view.camera, column + PIXEL_CENTER, row + PIXEL_CENTER)[:, :2]
            found.append((directions, turns, (places**2).sum(1), radiance.double().cpu().numpy()))
    return found


def _mirrored(
    geometry: Geometry, view: TrainView, pixels: Int[Tensor, "P"]
) -> tuple[Int[np.ndarray, "Q"], Float[np.ndarray, "Q 3"]]:
    """Those of the pixels that see the surroundings, and the directions that they mirror."""
    numbers = torch.arange(view.mask.numel(), dtype=torch.float32, device=view.mask.device)
    numbered = numbers.view(1, *view.mask.shape).expand(3, -1, -1)
    rays = geometry.observe(replace(view, radiance=numbered), pixels)
    return rays.radiance[:, 0].long().cpu().numpy(), rays.directions.cpu().numpy().astype(np.float64)
