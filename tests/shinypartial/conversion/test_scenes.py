"""Scene files put the light where it came from, by the lookups that each program documents, written out again here."""

import base64
import json
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from shinypartial.cli import main
from shinypartial.conversion.convert import convert
from shinypartial.conversion.lobes import lobes_of
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions, sample_latlong
from shinypartial.io.files import read_json
from shinypartial.io.images import read_exr_rgb, read_picture
from shinypartial.prediction.format import (
    PredictionInfo,
    write_environment_map,
    write_info,
    write_inverse_distance,
    write_visibility,
)
from tests.shinypartial.conversion.test_surface import write_ply
from tests.support.polyhedra import wavy_patch
from tests.support.tiny_scene import direction_colors

AXES = np.concatenate([np.eye(3), -np.eye(3)])
RANDOM = np.random.default_rng(0).normal(size=(50, 3))
DIRECTIONS = np.concatenate([AXES, RANDOM / np.linalg.norm(RANDOM, axis=1, keepdims=True)])


@pytest.fixture
def prediction(tmp_path: Path) -> Path:
    """A map of the color (d + 1)/2 in the direction d, of which the part with X > 0 was seen, and a surface."""
    folder = tmp_path / "prediction"
    write_environment_map(folder, direction_colors(64))
    write_visibility(folder, (latlong_directions(64)[..., 0] > 0).astype(np.float32))
    vertices, faces, normals = wavy_patch()
    write_ply(folder / "patch.ply", vertices, faces, normals)
    write_info(folder, PredictionInfo("m", "none", "", {}, {}, {}, {}, 0, reflectance=(0.9, 0.6, 0.3)))
    return folder


def texel(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Nearest texel at coordinates from the upper left corner."""
    height, width = image.shape[:2]
    return image[np.clip((v * height).astype(int), 0, height - 1), (np.floor(u * width) % width).astype(int)]


def test_mitsuba_finds_the_light_of_a_direction(prediction: Path) -> None:
    """u = atan2(x, −z)/2π and v = acos(y)/π in the light's frame; the matrix acts on columns."""
    convert(prediction, ("mitsuba",), prediction / "out")
    scene = ElementTree.parse(prediction / "out" / "scene.xml").getroot()
    matrix = np.array(scene.find("emitter/transform/matrix").attrib["value"].split(), float).reshape(4, 4)
    x, y, z = np.linalg.inv(matrix[:3, :3]) @ DIRECTIONS.T
    image = read_exr_rgb(prediction / "out" / scene.find("emitter/string").attrib["value"])
    seen = texel(image, np.arctan2(x, -z) / (2 * np.pi), np.arccos(y.clip(-1, 1)) / np.pi)
    # A texel of 64 spans 2.8°, so a direction is up to 0.035 off and its color half of that; half precision.
    np.testing.assert_allclose(seen, (DIRECTIONS + 1) / 2, atol=0.03)
    shape = scene.find("shape")
    surface = PlyData.read(str(prediction / "out" / shape.find("string").attrib["value"]))
    vertices, _, normals = wavy_patch()
    np.testing.assert_allclose(np.stack([surface["vertex"][name] for name in "xyz"], 1), vertices, atol=1e-6)
    np.testing.assert_allclose(np.stack([surface["vertex"][f"n{name}"] for name in "xyz"], 1), normals, atol=1e-6)
    assert all(len(face) == 3 for face in surface["face"]["vertex_indices"])
    assert shape.find("bsdf/bsdf/rgb").attrib["value"] == "0.9 0.6 0.3"


def test_usd_finds_the_light_of_a_direction(prediction: Path) -> None:
    """Longitude λ with sin λ along +x and cos λ along +z falls from π at the left to −π; matrices act on rows."""
    convert(prediction, ("usd",), prediction / "out")
    text = (prediction / "out" / "scene.usda").read_text()
    (matrix,) = re.findall(r"matrix4d xformOp:transform = (.*)", text)
    matrix = np.array(re.findall(r"-?[\d.e]+", matrix), float).reshape(4, 4)
    x, y, z = (DIRECTIONS @ np.linalg.inv(matrix[:3, :3])).T
    image = read_exr_rgb(prediction / "out" / "world.exr")
    seen = texel(image, 0.5 - np.arctan2(x, z) / (2 * np.pi), 0.5 - np.arcsin(y.clip(-1, 1)) / np.pi)
    np.testing.assert_allclose(seen, (DIRECTIONS + 1) / 2, atol=0.03)
    assert 'upAxis = "Z"' in text
    (points,) = re.findall(r"point3f\[\] points = \[(.*)\]", text)
    found = np.array(re.findall(r"-?[\d.]+(?:e-?\d+)?", points), float).reshape(-1, 3)
    np.testing.assert_allclose(found, wavy_patch()[0], atol=1e-6)
    assert text.count("{") == text.count("}")


def test_a_page_finds_the_light_of_a_direction(prediction: Path, tmp_path: Path) -> None:
    """u = atan(z, x)/2π + ½ and v = asin(y)/π + ½ from below, of Y-up directions: the world's (x, −z, y)."""
    convert(prediction, ("threejs", "glb"), prediction / "out")
    page = (prediction / "out" / "index.html").read_text()
    light, glb = (base64.b64decode(each) for each in re.findall(r"base64,([^\"]+)\"", page))
    (tmp_path / "light.hdr").write_bytes(light)
    image = read_picture(tmp_path / "light.hdr")
    x, y, z = DIRECTIONS.T
    seen = texel(image, np.arctan2(z, x) / (2 * np.pi) + 0.5, 0.5 - np.arcsin(y) / np.pi)
    np.testing.assert_allclose(seen, (np.stack([x, -z, y], 1) + 1) / 2, atol=0.035)
    assert glb == (prediction / "out" / "surface.glb").read_bytes()


def test_lobes_of_a_lobe_are_that_lobe() -> None:
    """A Gaussian about one of the axes, as sharp as one of those tried, is found by a reader of the file."""
    count, directions = 12, latlong_directions(64)
    first = lobes_of(np.ones((64, 128, 3)), count)["lobes"][3]["axis"]
    x, y, z = first
    axis, sharpness = np.array([x, -z, y]), 0.5 * count
    light = np.exp(sharpness * (directions @ axis - 1))[..., None] * [1.0, 0.5, 2.0]
    content = json.loads(json.dumps(lobes_of(light, count)))
    found = np.zeros_like(light)
    for lobe in content["lobes"]:
        x, y, z = lobe["axis"]
        values = np.exp(lobe["sharpness"] * (directions @ np.array([x, -z, y]) - 1))
        found += values[..., None] * lobe["color"]
    # Means over 2×2 texels take the place of values.
    np.testing.assert_allclose(found, light, atol=0.02)
    assert content["relative_error"] < 0.01
    assert lobes_of(direction_colors(64), 24)["relative_error"] < 0.05


@pytest.mark.parametrize("height", [20, 64, 100])
def test_lobes_have_the_direction_of_the_light_on_maps_of_any_height(height: int) -> None:
    """The mean direction Σ colors · axes is that of ∫ L d dω, which is +X for L = exp(4 (x − 1))."""
    light = np.exp(4 * (latlong_directions(height)[..., :1] - 1)) * np.ones(3)
    mean = sum(np.array(lobe["axis"]) * lobe["color"][0] for lobe in lobes_of(light, 100)["lobes"])
    # Measured 0.005°; 2° where the blocks of 100 rows left some over.
    assert np.degrees(np.arccos(mean[0] / np.linalg.norm(mean))) < 0.1


def test_the_mask_is_zero_where_nothing_was_seen_and_one_well_inside(prediction: Path) -> None:
    arguments = ["--to", "mask", "--feather-deg", "10", "--output", str(prediction / "o")]
    assert main(["convert", str(prediction), *arguments]) == 0
    mask = read_picture(prediction / "o" / "mask.png")[..., 0].astype(float) / 255
    depth_deg = np.degrees(np.arcsin(latlong_directions(64)[..., 0]))
    assert (mask[depth_deg <= 0] == 0).all()
    assert (mask[depth_deg > 15] > 0.99).all()
    assert 0.5 < sample_latlong(mask[..., None], np.array([np.sin(np.radians(5)), 0, np.cos(np.radians(5))]))[0] < 0.95


def test_the_walls_of_a_box_are_found(prediction: Path) -> None:
    """1/D of a box is the largest of ω·a/h over its walls; a far world has none."""
    with pytest.raises(InputError, match="infinitely far"):
        convert(prediction, ("room",), prediction / "out")
    walls = np.array([3.0, 2.0, 1.5, 4.0, 2.5, 1.0])
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    write_inverse_distance(prediction, (latlong_directions(64) @ axes.T / walls).max(-1))
    convert(prediction, ("room",), prediction / "out")
    room = read_json(prediction / "out" / "room.json", "a room")
    # The world's +X, +Y, +Z are +x, −z, +y with Y up.
    np.testing.assert_allclose(room["box_max"], [3.0, 1.5, 2.5], rtol=0.02)
    np.testing.assert_allclose(room["box_min"], [-4.0, -1.0, -2.0], rtol=0.02)
    diagonal = latlong_directions(64) @ np.full(3, 3**-0.5) > 0.98
    write_inverse_distance(prediction, diagonal.astype(float))
    with pytest.raises(InputError, match="within 30° of an axis"):
        convert(prediction, ("room",), prediction / "out")
