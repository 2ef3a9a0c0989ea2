"""How long each view was exposed, against the others, by what it shows of the directions that they all see."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.encoding import SATURATED
from panoless.environment.cubemap import texels_of
from panoless.environment.rays import Rays
from panoless.numeric.robust import robust_weight


def exposure_gains(
    views: Sequence[Rays], saturation: Float[Tensor, "3"], resolution: int, scale: float, rounds: int
) -> Float[np.ndarray, "V"]:
    """Gains g of views against their geometric mean: min Σ w ‖c − g E‖² over gains and the texels E of a map together.

    w are the rays' trust and Geman–McClure weights of that scale (linear radiance). Each round is a Gauss–Newton step
    of all log g from which the texels are eliminated: views that have few directions in common hold on to gains that a
    map has followed. Saturated pixels have no say; a view that shares no texel with others keeps the mean.
    """
    from scipy import sparse

    count = len(views)
    of_view = np.repeat(np.arange(count), [len(rays.radiance) for rays in views])
    radiance = torch.cat([rays.radiance for rays in views]).double().cpu().numpy()
    trust = torch.cat([rays.initial_weight() for rays in views]).double().cpu().numpy()
    trust = trust * (radiance < SATURATED * saturation.cpu().numpy()).all(1)
    texel = texels_of(torch.cat([rays.directions for rays in views]).double().cpu().numpy(), resolution)
    points, log_gains, weight, light = np.arange(len(texel)), np.zeros(count), trust, radiance
    gather = sparse.csr_matrix((np.ones(len(texel)), (texel, points)))
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
        for channel in range(3):
            shared = sparse.csr_matrix(
                (weight * shown[:, channel] * gain / among[texel], (texel, of_view)), (len(among), count)
            )
            asked = gather @ (weight * gain * residual[:, channel]) / among
            matrix -= (shared.T @ shared).toarray()
            gradient -= shared.T @ asked
        log_gains = log_gains + np.linalg.pinv(matrix, rcond=1e-6, hermitian=True) @ gradient
        log_gains -= log_gains.mean()
    return np.exp(log_gains)
