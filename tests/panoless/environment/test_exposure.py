"""Gains of views come back from what they show of the directions that they share."""

import numpy as np
import pytest
import torch

from panoless.environment.exposure import exposure_gains
from panoless.environment.rays import Rays
from panoless.kernels.cubemap import cubemap_directions

RESOLUTION = 8
GAINS = np.array([0.7, 1.1, 0.9, 1.5, 1.0])
GAINS /= np.exp(np.log(GAINS).mean())
GAINS_OF_CHANNELS = np.repeat(GAINS[:, None], 3, 1)


def rays_of(gains: np.ndarray, saturation: float = np.inf) -> list[Rays]:
    """Each view sees a third of the texels' centers, and only those beside it in order some of the same."""
    directions = cubemap_directions(RESOLUTION).reshape(-1, 3)
    light = torch.rand(len(directions), 3, generator=torch.Generator().manual_seed(2)) / 2 + 0.1
    found = []
    for index, gain in enumerate(gains.tolist()):
        part = slice(60 * index, 60 * index + 128)
        found.append(Rays(directions[part], (light[part] * gain).clamp(max=saturation)))
    return found


def gains_from(rays: list[Rays], saturation: float = np.inf) -> np.ndarray:
    return exposure_gains(rays, torch.full((3,), saturation), RESOLUTION, scale=0.1, rounds=6)


def test_views_in_a_chain_tell_their_gains() -> None:
    """Without noise exactly, though the first sees nothing of what the last does."""
    assert gains_from(rays_of(GAINS)) == pytest.approx(GAINS_OF_CHANNELS, rel=1e-3)


def test_saturated_pixels_have_no_say() -> None:
    assert gains_from(rays_of(GAINS, saturation=0.6), saturation=0.6) == pytest.approx(GAINS_OF_CHANNELS, rel=1e-3)


def test_some_wrong_pixels_change_little() -> None:
    """Every tenth is of another color."""
    rays = rays_of(GAINS)
    for each in rays:
        each.radiance[::10] = 0.9
    assert gains_from(rays) == pytest.approx(GAINS_OF_CHANNELS, rel=0.02)


def test_a_view_that_shares_nothing_keeps_the_mean() -> None:
    """No photograph tells its exposure from its light."""
    rays = rays_of(GAINS)
    alone = Rays(-torch.tensor([[0.1, 0.2, 1.0]]), torch.tensor([[0.3, 0.3, 0.3]]))
    found = gains_from([*rays[:2], alone])
    assert found[0] / found[1] == pytest.approx(np.full(3, GAINS[0] / GAINS[1]), rel=1e-3)
    assert (found[2] > 0.5).all()
    assert (found[2] < 2).all()
