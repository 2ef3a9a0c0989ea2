"""The lobe of a rough mirror: an adjoint pair that keeps light, and holds as much of it within each angle as facets
tilt there."""

import numpy as np
import pytest
import torch

from panoless.environment.lobe import Lobe, Lobes, _torch_matrix, lobe_weights
from panoless.kernels.cubemap import cubemap_directions


@pytest.mark.parametrize(("roughness", "texels"), [(None, 32), (0.1, 32), (0.35, 32), (0.35, 24)])
def test_gathering_is_the_adjoint_of_blurring(roughness: float | None, texels: int) -> None:
    lobe, generator = Lobe.of(roughness, texels), torch.Generator().manual_seed(1)
    first, second = (torch.rand(6, 2, texels, texels, generator=generator) for _ in range(2))
    blurred, gathered = (lobe.blurred(first) * second).double(), (first * lobe.gathered(second)).double()
    assert float(blurred.sum()) == pytest.approx(float(gathered.sum()), rel=1e-5)


def test_a_plain_world_looks_plain_in_any_mirror() -> None:
    """A smooth mirror shows every world as it is."""
    plain = torch.full((6, 1, 32, 32), 0.7)
    assert Lobe.of(0.2, 32).blurred(plain).numpy() == pytest.approx(0.7, abs=1e-5)
    world = torch.rand(6, 3, 8, 8, generator=torch.Generator().manual_seed(2))
    assert torch.equal(Lobe.of(None, 8).blurred(world), world)


def test_products_with_the_matrices_of_other_devices_are_those_of_the_cpu() -> None:
    """The values and their gradients, with such matrices in main memory."""
    blurs = [blur for blur in Lobes.by_cosine((0.1, 0.5), 16).blurs if blur.matrix is not None]
    assert blurs
    for blur in blurs:
        image = torch.rand(6, 3, 16, 16, generator=torch.Generator().manual_seed(3), requires_grad=True)
        expected = blur.shrunk(image)
        cotangent = torch.rand(expected.shape, generator=torch.Generator().manual_seed(4))
        gradient = torch.autograd.grad(expected, image, cotangent)[0]
        blur._pairs[image.device] = tuple(_torch_matrix(each, image.device) for each in (blur.matrix, blur.matrix.T))
        found = blur.shrunk(image)
        torch.testing.assert_close(found, expected)
        torch.testing.assert_close(torch.autograd.grad(found, image, cotangent)[0], gradient)
        del blur._pairs[image.device]


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75, 0.9, 0.98])
def test_light_within_an_angle_is_the_share_of_facets_that_send_it(share: float) -> None:
    """A facet drawn with the uniform number u is tilted by atan(α √(u/(1 − u))) and turns light by twice as much.

    A disk of light about a direction is seen there as u; texels are 1.4° wide. Measured: within 0.028.
    """
    roughness = 0.35
    angle = 2 * np.arctan(roughness**2 * np.sqrt(share / (1 - share)))
    axis = torch.tensor([0.2, -0.3, 1.0])
    directions = cubemap_directions(64)
    cosine = directions @ (axis / axis.norm())
    disk = (cosine > np.cos(angle)).float()[:, None]
    seen = Lobe.of(roughness, 64).blurred(disk)[:, 0]
    assert float(seen.flatten()[cosine.argmax()]) == pytest.approx(share, abs=0.03)


def test_weights_are_shares() -> None:
    for roughness in (0.05, 0.1, 0.5):
        weights = lobe_weights(roughness)
        assert (weights >= 0).all()
        assert weights.sum() == pytest.approx(1)
