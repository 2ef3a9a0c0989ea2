"""What other programs read as light is the light of the prediction, in the direction in which they look for it."""

from pathlib import Path

import numpy as np
import pytest

from shinypartial.conversion.convert import convert
from shinypartial.conversion.light import filled, harmonics_of, light_of
from shinypartial.core.errors import InputError
from shinypartial.core.harmonics import real_harmonics
from shinypartial.core.sphere import latlong_directions, latlong_solid_angles
from shinypartial.io.files import read_json
from shinypartial.io.images import read_picture
from shinypartial.prediction.format import (
    VISIBILITY,
    PredictionInfo,
    read_environment_map,
    write_environment_map,
    write_info,
    write_visibility,
)
from tests.support.tiny_scene import direction_colors

FACES = ("px", "nx", "py", "ny", "pz", "nz")


@pytest.fixture
def prediction(tmp_path: Path) -> Path:
    """A map colored by direction, of which the part with X > 0 was seen."""
    folder = tmp_path / "prediction"
    write_environment_map(folder, direction_colors(64))
    write_visibility(folder, np.clip(latlong_directions(64)[..., 0], 0, 1))
    write_info(folder, PredictionInfo("colors", "none", "", {}, {}, {}, {}, 0))
    return folder


def sampler_cube(faces: dict[str, np.ndarray], directions: np.ndarray) -> np.ndarray:
    """What a GPU fetches from six pictures uploaded first row first: OpenGL 4.6, table 8.19, nearest texel."""
    found = np.zeros((len(directions), 3))
    for i, (x, y, z) in enumerate(directions):
        table = {
            "px": (-z, -y, x), "nx": (z, -y, -x), "py": (x, z, y), "ny": (x, -z, -y), "pz": (x, -y, z),
            "nz": (-x, -y, -z),
        }  # fmt: skip
        name = max(FACES, key=lambda face: table[face][2])
        across, down, major = table[name]
        side = len(faces[name])
        column, row = (int(np.clip((value / major + 1) / 2 * side, 0, side - 1)) for value in (across, down))
        found[i] = faces[name][row, column]
    return found


@pytest.mark.parametrize(("layout", "mirrored"), [("opengl", 1.0), ("three", -1.0)])
def test_lookups_find_the_light_of_their_direction(prediction: Path, layout, mirrored: float) -> None:
    """three.js flips x before it looks up; the Y-up direction (x, y, z) is (x, −z, y) in the world."""
    convert(prediction, ("cubemap",), prediction / "out", layout=layout)
    faces = {name: read_picture(prediction / "out" / f"{name}.hdr") for name in FACES}
    random = np.random.default_rng(0).normal(size=(200, 3))
    y_up = np.concatenate([np.eye(3), -np.eye(3), random / np.linalg.norm(random, axis=1, keepdims=True)])
    x, y, z = y_up.T
    world = np.stack([x, -z, y], 1)
    # A texel of 32 spans 1/16 of a face, half of it in color; RGBE adds 1/256.
    np.testing.assert_allclose(sampler_cube(faces, y_up * [mirrored, 1, 1]), (world + 1) / 2, atol=0.03)


def test_irradiance_of_the_json_is_that_of_an_integral(prediction: Path) -> None:
    """As a reader of the file computes it, about Y-up axes, for light of all degrees up to 4."""
    write_environment_map(prediction, direction_colors(64) ** 4)
    convert(prediction, ("sh",), prediction / "out")
    content = read_json(prediction / "out" / "harmonics.json", "harmonics")
    degrees = np.repeat(np.arange(5), [1, 3, 5, 7, 9])
    coefficients = np.array(content["coefficients"]) * np.array(content["irradiance_factors"])[degrees, None]
    normals = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.48, -0.6, 0.64]])
    light, area = direction_colors(64) ** 4, latlong_solid_angles(64)
    world = np.stack([normals[:, 0], -normals[:, 2], normals[:, 1]], 1)
    cosine = np.maximum(latlong_directions(64) @ world.T, 0) * area[..., None]
    expected = np.einsum("hwn,hwc->nc", cosine, light)
    np.testing.assert_allclose(real_harmonics(normals, 4) @ coefficients, expected, atol=5e-3)


def test_degrees_that_are_not_offered_are_refused() -> None:
    with pytest.raises(InputError, match="--degree"):
        harmonics_of(direction_colors(8), 5)


def test_a_fill_continues_harmonic_light() -> None:
    """log((1 − d·a)/(1 + d·a)) is harmonic but at ±a; from both caps the band between is known, poles and seam too."""
    axis = np.array([0.6, 0.8, 0.0])
    cosine = latlong_directions(64) @ axis
    harmonic = np.log((1 - np.clip(cosine, -0.99, 0.99)) / (1 + np.clip(cosine, -0.99, 0.99)))
    seen = np.abs(cosine) > 0.8
    light = np.where(seen, harmonic, 9.0)[..., None].repeat(3, 2)
    found = filled(light, seen)
    np.testing.assert_array_equal(found[seen], light[seen])
    # Steps of 2.8°: measured 2.3e-4.
    np.testing.assert_allclose(found[..., 0][~seen], harmonic[~seen], atol=1e-3)


def test_a_fill_on_a_coarser_grid_keeps_what_was_seen_and_its_range() -> None:
    random = np.random.default_rng(2)
    light, seen = random.random((256, 512, 3)).astype(np.float32), random.random((256, 512)) < 0.02
    seen[60:200, 100:300] = False
    found = filled(light, seen)
    np.testing.assert_array_equal(found[seen], light[seen])
    assert found.min() >= light[seen].min() - 1e-6
    assert found.max() <= light[seen].max() + 1e-6
    np.testing.assert_array_equal(filled(light, np.zeros_like(seen)), light)


def test_confidence_darkens_fills_or_keeps(prediction: Path) -> None:
    light, seen = read_environment_map(prediction), latlong_directions(64)[..., 0] > 0
    np.testing.assert_array_equal(light_of(prediction, "keep"), light)
    dark = light_of(prediction, "darken")
    np.testing.assert_allclose(dark, light * np.clip(latlong_directions(64)[..., :1], 0, 1), atol=1e-6)
    fill = light_of(prediction, "fill")
    np.testing.assert_array_equal(fill[seen], light[seen])
    # A half sphere filled from its border, half a texel within which the color of x is ½: measured 0.012.
    np.testing.assert_allclose(fill[~seen][:, 0], 0.5, atol=0.02)


def test_confidence_needs_visibility(prediction: Path) -> None:
    (prediction / VISIBILITY).unlink()
    light_of(prediction, "keep")
    with pytest.raises(InputError, match="--confidence keep"):
        light_of(prediction, "darken")
