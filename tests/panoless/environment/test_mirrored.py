"""What rays see by way of a mirror changes with rays and normals as the slopes say."""

import numpy as np
import pytest
import torch
from jaxtyping import Float

from panoless.environment.mirrored import MirroredRays, radiance_of, slopes_of
from panoless.environment.surroundings import FAR, Surroundings
from panoless.kernels.cubemap import cubemap_directions

NEAR = Surroundings(np.array([0.3]))
RESOLUTION = 256
WAVES = np.random.default_rng(1).normal(size=(3, 3))


def light(directions: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """A smooth function of directions, in three channels."""
    return np.sin(directions @ WAVES)


@pytest.fixture(scope="module")
def environment() -> torch.Tensor:
    values = light(cubemap_directions(RESOLUTION).double().numpy().reshape(-1, 3))
    return torch.from_numpy(values.reshape(6, RESOLUTION, RESOLUTION, 3)).permute(0, 3, 1, 2).contiguous()


def unit(count: int, seed: int) -> Float[np.ndarray, "P 3"]:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def seen(surroundings: Surroundings, turned_ray: np.ndarray | float = 0.0, turned_normal: np.ndarray | float = 0.0):
    rays, normals = unit(200, 2) + turned_ray, unit(200, 3) + turned_normal
    rays, normals = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (rays, normals))
    return MirroredRays(rays, normals, 0.7 * unit(200, 4), surroundings)


def assert_alike(found: Float[np.ndarray, "P 3"], expected: Float[np.ndarray, "P 3"]) -> None:
    """To 1 % of the root mean square: at the seams of a cube, texels are no regular grid."""
    assert np.sqrt(((found - expected) ** 2).mean()) < 0.01 * np.sqrt((expected**2).mean())


def test_slopes_across_directions_are_those_of_the_light(environment: torch.Tensor) -> None:
    directions, step = unit(200, 5), 1e-5
    across = np.cross(directions, unit(200, 6))
    expected = (light(directions + step * across) - light(directions - step * across)) / (2 * step)
    found = np.einsum("pcj,pj->pc", slopes_of(environment, directions), across)
    assert_alike(found, expected)
    np.testing.assert_allclose(radiance_of(environment, directions), light(directions), atol=1e-4)


@pytest.mark.parametrize("surroundings", [FAR, NEAR])
@pytest.mark.parametrize("what", ["ray", "normal"])
def test_light_changes_with_rays_and_normals(environment: torch.Tensor, surroundings: Surroundings, what: str) -> None:
    """Against the light itself in turned directions; slopes are those of a map of 256 texels."""
    mirrored, step = seen(surroundings), 1e-5
    base = mirrored.directions if what == "ray" else mirrored.normals
    across = np.cross(base, unit(200, 7))
    ahead, behind = (
        light(seen(surroundings, **{f"turned_{what}": sign * step * across}).looked_up) for sign in (1, -1)
    )
    slopes = mirrored.slopes(environment)
    rows = mirrored.by_ray(slopes) if what == "ray" else mirrored.by_normal(slopes)
    assert_alike(np.einsum("pcj,pj->pc", rows, across), (ahead - behind) / (2 * step))


@pytest.mark.parametrize("surroundings", [FAR, NEAR])
def test_turns_of_the_normal_change_the_light_as_slopes_say(
    environment: torch.Tensor, surroundings: Surroundings
) -> None:
    """Along two ways across it, in a smooth map; where rays graze, half a texel of the normal is little."""
    mirrored = seen(surroundings)
    ways = np.stack([np.cross(mirrored.normals, unit(200, seed)) for seed in (7, 8)], 2)
    expected = np.matmul(mirrored.by_normal(mirrored.slopes(environment)), ways)
    found = mirrored.light_by_turns(environment, ways)
    for each in range(2):
        assert_alike(found[:, :, each], expected[:, :, each])


def test_the_sign_of_a_normal_means_nothing(environment: torch.Tensor) -> None:
    here = seen(NEAR)
    other = MirroredRays(here.directions, -here.normals, here.points, NEAR)
    np.testing.assert_allclose(other.light(environment), here.light(environment), atol=1e-12)
    slopes = here.slopes(environment)
    np.testing.assert_allclose(other.by_normal(slopes), -here.by_normal(slopes), atol=1e-12)
