"""Exposure and white balance of each view, against the others, by what it shows of the directions that they all see."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.encoding import SATURATED
from panoless.environment.cubemap import texels_of
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
    from scipy import sparse

    count = len(views)
    of_view = np.repeat(np.arange(count), [len(rays.radiance) for rays in views])
    radiance = torch.cat([rays.radiance for rays in views]).double().cpu().numpy()
    trust = torch.cat([rays.initial_weight() for rays in views]).double().cpu().numpy()
    clear = radiance < SATURATED * saturation.cpu().numpy()
    texel = texels_of(torch.cat([rays.directions for rays in views]).double().cpu().numpy(), resolution)
    gather = sparse.csr_matrix((np.ones(len(texel)), (texel, np.arange(len(texel)))))
    gains = np.ones((count, 3))
    for group in groups:
        of_group = _gains(
            radiance[:, group], trust * clear[:, group].all(1), of_view, texel, gather, count, scale, rounds
        )
        gains[:, group] = of_group[:, None]
    return gains


def _gains(
    radiance: Float[np.ndarray, "P C"],
    trust: Float[np.ndarray, "P"],
    of_view: Int[np.ndarray, "P"],
    texel: Int[np.ndarray, "P"],
    gather: Any,
    count: int,
    scale: float,
    rounds: int,
) -> Float[np.ndarray, "V"]:
    """One gain a view, for colors of one or more channels; `gather` sums points of a texel."""
    from scipy import sparse

    log_gains, weight = np.zeros(count), trust
    for _ in range(rounds + 1):
        gain = np.exp(log_gains)[of_view]
        squares = np.maximum(gather @ (weight * gain**2), 1e-12)
        light = (gather @ ((weight * gain)[:, None] * radiance) / squares[:, None])[texel]
        shown = gain[:, None] * light
        residual = radiance - shown
        weight = trust * robust_weight(residual, scale)
        matrix = np.diag(np.bincount(of_view, weight * (shown**2).sum(1), count))
        gradient = np.bincount(of_view, weight * (shown * residual).sum(1), count)
        among = np.sqrt(np.maximum(gather @ (weight * gain**2), 1e-12))
        for channel in range(radiance.shape[1]):
            shared = sparse.csr_matrix(
                (weight * shown[:, channel] * gain / among[texel], (texel, of_view)), (len(among), count)
            )
            asked = gather @ (weight * gain * residual[:, channel]) / among
            matrix -= (shared.T @ shared).toarray()
            gradient -= shared.T @ asked
        log_gains = log_gains + np.linalg.pinv(matrix, rcond=1e-6, hermitian=True) @ gradient
        log_gains -= log_gains.mean()
    return np.exp(log_gains)
