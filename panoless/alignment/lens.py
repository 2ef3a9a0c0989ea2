"""The focal length, by what is mirrored: how far photographs pull a fitted surface toward another one.

A longer focal length shows an object larger, so a fit in which it is wrong by the factor eˢ finds the object e⁻ˢ as
large, and the directions of its rays too near to each other by as much. In the frame of the object that is the camera
eˢ as far away: it sees every point where it did, to first order, but from another side. What a pixel mirrors turns by
δr, and the map of all views no longer agrees with itself. With the rows B = ∇E·δr, the residuals e and the projection Π
on means over a texel, the pull is −(Bᵀ W (1 − Π) B)⁻¹ Bᵀ W (1 − Π) e.

A fitted shape has bent until it agrees as well as it can. So the pull is only a share of s, which differs from kind to
kind; it vanishes where the focal length is right.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.views import TrainView, Views, at_most_pixels
from panoless.capture.zoom import farther
from panoless.environment.following import FollowingMap
from panoless.environment.mirrored import radiance_of, slopes_of
from panoless.environment.rays import Rays
from panoless.environment.solve import solve_environment
from panoless.geometry.base import Geometry
from panoless.numeric.robust import robust_weight

DIFFERENCE = 2e-3
"""Of the logarithm of the focal length, for derivatives; not tuned."""
WIDEST_TURN = 1.0
"""Rays that turn by more, in rad for a change of s by one, lose their vote: they graze the surface, or are mirrored
more than once. Usual ones turn by the object's half angle."""
LEAST_COUNTED = 0.25
"""At least this share of the rays is beyond what texels take over; not tuned."""


@dataclass(frozen=True)
class FocalPull:
    """The change of the logarithm of the focal length that photographs ask for under a surface that stays, and its
    standard deviation by their noise.
    """

    step: float
    sigma: float


def focal_pull(views: Views, geometry: Geometry, rays: int, resolution: int, robust_scale: float) -> FocalPull:
    """The pull of about so many pixels of corrected views; the map has `resolution` texels along a face side.

    `robust_scale` (linear radiance) is the residual beyond which a ray loses its vote.
    """
    directions, turns, radiance = (np.concatenate(parts) for parts in zip(*_seen(views, geometry, rays), strict=True))
    seen = Rays(torch.from_numpy(directions).float(), torch.from_numpy(radiance).float())
    environment = solve_environment([seen], resolution)
    residual = radiance_of(environment, directions) - radiance
    weights = robust_weight(residual, robust_scale) * robust_weight(turns, WIDEST_TURN)
    following = FollowingMap.of(directions, weights, resolution)
    gradient, matrix = following.equations(np.matmul(slopes_of(environment, directions), turns[..., None]), residual)
    curvature, votes = max(float(matrix[0, 0]), 1e-12), float(weights.sum())
    counted = 3 * max(votes - following.count, votes * LEAST_COUNTED, 1.0)
    variance = float((weights[:, None] * residual**2).sum()) / counted
    return FocalPull(-float(gradient[0]) / curvature, (variance / curvature) ** 0.5)


def _seen(views: Views, geometry: Geometry, rays: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each view: the directions that pixels mirror, how these turn with s, and what was seen along them."""
    found = []
    with torch.no_grad():
        for view, pixels in at_most_pixels(geometry.corrected(views), rays):
            (near, ahead), (far, behind) = (
                _mirrored(geometry, farther(view, sign * DIFFERENCE), pixels) for sign in (1.0, -1.0)
            )
            common, first, second = np.intersect1d(near, far, assume_unique=True, return_indices=True)
            mean = ahead[first] + behind[second]
            directions = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
            radiance = view.radiance_at(torch.from_numpy(common))
            turns = (ahead[first] - behind[second]) / (2 * DIFFERENCE)
            found.append((directions, turns, radiance.double().cpu().numpy()))
    return found


def _mirrored(
    geometry: Geometry, view: TrainView, pixels: Int[Tensor, "P"]
) -> tuple[Int[np.ndarray, "Q"], Float[np.ndarray, "Q 3"]]:
    """Those of the pixels that see the surroundings, and the directions that they mirror."""
    numbers = torch.arange(view.mask.numel(), dtype=torch.float32, device=view.mask.device)
    numbered = numbers.view(1, *view.mask.shape).expand(3, -1, -1)
    rays = geometry.observe(replace(view, radiance=numbered), pixels)
    return rays.radiance[:, 0].long().cpu().numpy(), rays.directions.cpu().numpy().astype(np.float64)
