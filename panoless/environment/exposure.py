"""Exposure and white balance of each view, against the others, by what it shows of the directions that they all see."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.encoding import SATURATED
from panoless.environment.following import FollowingMap
from panoless.environment.rays import Rays
from panoless.numeric.robust import robust_weight

#: Channels that share a gain: all of a picture where its exposure differs, none where its white balance does.
Groups = tuple[tuple[int, ...], ...]
EXPOSURE: Groups = ((0, 1, 2),)
WHITE_BALANCE: Groups = ((0,), (1,), (2,))


def exposure_gains(
    views: Sequence[Rays],
    saturation: Float[Tensor, "3"],
    resolution: int,
    scale: float,
    rounds: int,
    groups: Groups = EXPOSURE,
) -> Float[np.ndarray, "V 3"]:
    """Gains g of views against their geometric mean: min Σ w ‖c − g E‖² over gains and the texels E of a map together,
    for each group of channels.

    w are the rays' trust and Geman–McClure weights of that scale (linear radiance). Each round is a Gauss–Newton step
    of all log g from which the texels are eliminated: views that have few directions in common hold on to gains that a
    map has followed. Saturated pixels have no say; a view that shares no texel with others keeps the mean.
    """
    count = len(views)
    of_view = np.repeat(np.arange(count), [len(rays.radiance) for rays in views])
    radiance = torch.cat([rays.radiance for rays in views]).double().cpu().numpy()
    trust = torch.cat([rays.initial_weight() for rays in views]).double().cpu().numpy()
    clear = radiance < SATURATED * saturation.cpu().numpy()
    directions = torch.cat([rays.directions for rays in views]).double().cpu().numpy()
    gains = np.ones((count, 3))
    for group in groups:
        following = FollowingMap.of(directions, trust * clear[:, group].all(1), resolution)
        gains[:, group] = _gains(radiance[:, group], following, of_view, count, scale, rounds)[:, None]
    return gains


def _gains(
    radiance: Float[np.ndarray, "P C"],
    following: FollowingMap,
    of_view: Int[np.ndarray, "P"],
    count: int,
    scale: float,
    rounds: int,
) -> Float[np.ndarray, "V"]:
    """One gain a view, for colors of one or more channels: of w (c − g E)², c/g counts w g² times."""
    log_gains, trust, weight = np.zeros(count), following.weights, following.weights
    for _ in range(rounds + 1):
        gain = np.exp(log_gains)[of_view]
        asked = radiance / gain[:, None]
        left = replace(following, weights=weight * gain**2).beyond(asked)
        weight = trust * robust_weight(gain[:, None] * left, scale)
        gradient, matrix = replace(following, weights=weight * gain**2).sparse_equations(
            (asked - left)[:, :, None], of_view[:, None], count, left
        )
        log_gains = log_gains + np.linalg.pinv(matrix, rcond=1e-6, hermitian=True) @ gradient
        log_gains -= log_gains.mean()
    return np.exp(log_gains)
