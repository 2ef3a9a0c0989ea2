"""Places that differ come back from pixels that see other light in each view, and only from these."""

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float

from panoless.environment.material_field import MaterialField, MaterialPixels, lattice_corners
from panoless.environment.reflectance import Reflectance
from panoless.geometry.base import from_plain, to_plain

CELLS = 16
RANDOM = np.random.default_rng(5)
POINTS = RANDOM.normal(size=(30_000, 3))
POINTS /= np.linalg.norm(POINTS, axis=1, keepdims=True) * 1.01
LIGHT = RANDOM.uniform(0.1, 0.9, size=(30_000, 3))
LABEL = POINTS[:, 0] > 0.6
WELL_INSIDE, WELL_OUTSIDE = POINTS[:, 0] > 0.75, POINTS[:, 0] < 0.45
COLOR = np.array([0.5, 0.2, 0.1])


def fitted(radiance: Float[np.ndarray, "P 3"]) -> MaterialField:
    """Beside a perfect mirror."""
    return MaterialPixels.of(POINTS, CELLS).field(LIGHT, radiance - LIGHT)


def test_trilinear_weights_reproduce_linear_functions() -> None:
    corners, weights = lattice_corners(POINTS, CELLS)
    place = np.stack(np.unravel_index(corners, (CELLS + 1,) * 3), -1) * 2 / CELLS - 1
    assert np.einsum("pk,pkc->pc", weights, place) == pytest.approx(POINTS, abs=1e-9)


def test_a_matte_label_is_separated_from_the_mirror_around_it() -> None:
    field = fitted(np.where(LABEL[:, None], COLOR, LIGHT))
    share, scattered = field.at(POINTS)
    assert share[WELL_INSIDE].mean(0) == pytest.approx(-np.ones(3), abs=0.03)
    assert scattered[WELL_INSIDE].mean(0) == pytest.approx(COLOR, abs=0.02)
    assert not share[WELL_OUTSIDE].any()
    assert not scattered[WELL_OUTSIDE].any()


def test_a_glaze_keeps_a_part_of_the_mirror() -> None:
    share, scattered = fitted(0.4 * LIGHT + COLOR).at(POINTS)
    assert share.mean(0) == pytest.approx(-0.6 * np.ones(3), abs=0.03)
    assert scattered.mean(0) == pytest.approx(COLOR, abs=0.02)


def test_a_saturated_label_is_at_least_as_bright() -> None:
    shown = np.where(LABEL[:, None], 1.0, LIGHT)
    field = fitted(shown)
    share, scattered = field.at(POINTS)
    assert ((1 + share) * LIGHT + scattered)[WELL_INSIDE].mean() == pytest.approx(1, abs=0.1)


def test_what_varies_without_the_light_is_no_material() -> None:
    """Wrong normals show other light: no place has one color."""
    field = fitted(np.where(LABEL[:, None], RANDOM.permutation(LIGHT), LIGHT))
    assert np.abs(field.at(POINTS)[0]).mean() < 0.02


def test_a_field_is_stored_and_read_and_is_zero_elsewhere() -> None:
    field = fitted(np.where(LABEL[:, None], COLOR, LIGHT))
    again = from_plain(Reflectance, to_plain(Reflectance(np.ones(3), field=field))).field
    assert again is not None
    for one, other in zip(again.at(POINTS), field.at(POINTS), strict=True):
        assert np.array_equal(one, other)
    assert not np.any(field.at(np.zeros((1, 3))))
    assert replace(field, scattered=2 * field.scattered).at(POINTS)[1] == pytest.approx(field.exposed(2).at(POINTS)[1])
