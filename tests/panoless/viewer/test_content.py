"""What the viewer shows: hits against closed forms, colors against the maps that they come from."""

import asyncio
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from panoless.export.mesh_files import write_ply
from panoless.geometry.base import Mesh
from panoless.viewer.content import (
    Moment,
    Surface,
    environment_sphere,
    moment_folders,
    picture_of_test,
    read_surface,
    thumbnail,
)
from panoless.viewer.server import Address, Viewer, open_prediction
from shinypartial.core import mesh as core
from shinypartial.core.color import to_display
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import sample_latlong
from shinypartial.dataset.schema import Dataset
from shinypartial.prediction.surface import triangles_of
from tests.support.truth_prediction import write_truth_prediction


def ball(rings: int = 60) -> Surface:
    """A unit sphere of triangles, with exact normals."""
    polar, turn = np.pi * np.arange(rings + 1) / rings, 2 * np.pi * np.arange(2 * rings) / (2 * rings)
    polar, turn = np.meshgrid(polar, turn, indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1)
    index = np.arange(polar.size).reshape(polar.shape)
    upper, lower = index[:-1], index[1:]
    quads = np.stack([upper, lower, np.roll(lower, -1, 1), np.roll(upper, -1, 1)], -1).reshape(-1, 4)
    points = points.reshape(-1, 3)
    return Surface(points, points, triangles_of(polygons(points, quads)))


def polygons(vertices: np.ndarray, faces: np.ndarray) -> core.Mesh:
    return core.Mesh(vertices, 0 * vertices, [tuple(face) for face in faces.tolist()])


def test_a_ray_is_mirrored_by_a_ball_as_in_closed_form() -> None:
    """It meets the unit sphere at −b − √(b² − c) and leaves for the sphere of the environment."""
    origin, target = np.array([4.0, 0.5, 0.3]), np.array([0.1, 0.4, -0.2])
    direction = (target - origin) / np.linalg.norm(target - origin)
    half = origin @ direction
    point = origin + (-half - np.sqrt(half**2 - origin @ origin + 1)) * direction
    outgoing = direction - 2 * (direction @ point) * point
    surface = ball()
    corners = surface.path(origin, direction, 6.0)
    # Chords of triangles of 3° lie 0.0004 below the sphere.
    np.testing.assert_allclose(corners[1], point, atol=2e-3)
    np.testing.assert_allclose((corners[2] - corners[1]) / (6 * surface.radius), outgoing, atol=5e-3)
    assert surface.path(origin, -direction, 6.0).shape == (1, 3)


def test_polygons_become_triangles_of_their_area() -> None:
    """A square, and an L of six corners, which is not convex."""
    corners = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], dtype=float)
    vertices = np.concatenate([corners, np.zeros((6, 1))], 1)
    for polygon, area in ((np.array([0, 1, 2, 3]), 1.5), (np.arange(6), 3.0)):
        a, b, c = vertices[triangles_of(polygons(vertices, polygon[None]))].transpose(1, 0, 2)
        assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(area)


def test_the_sphere_of_the_environment_has_the_colors_of_the_map() -> None:
    """Every vertex that of its own direction; where nothing was seen, none of the light."""
    rng = np.random.default_rng(0)
    light, seen = rng.random((16, 32, 3)), np.ones((16, 32))
    seen[:8] = 0
    moment = Moment("end", None, light.astype(np.float32), seen.astype(np.float32))
    whole, part = environment_sphere(moment, "light"), environment_sphere(moment, "light that was seen")
    expected = to_display(sample_latlong(moment.environment, whole.vertices))
    np.testing.assert_array_equal(whole.colors, expected)
    up, down = part.vertices[:, 2] > 0.2, part.vertices[:, 2] < -0.2
    assert len(np.unique(part.colors[up], axis=0)) == 1
    np.testing.assert_array_equal(part.colors[down], whole.colors[down])


def written(folder: Path, dataset: Dataset) -> Path:
    """The truth as a prediction, with a ball of triangles."""
    surface = ball(12)
    columns = dict(zip(("nx", "ny", "nz"), surface.normals.T, strict=True))
    write_ply(
        write_truth_prediction(folder, dataset) / "sphere.ply", Mesh(surface.vertices, surface.triangles, columns)
    )
    return folder


def test_a_prediction_is_read_with_its_pictures(sphere_dataset: Dataset, tmp_path: Path) -> None:
    """That of the truth has no errors."""
    folder, frame = written(tmp_path, sphere_dataset), sphere_dataset.test[0]
    assert list(moment_folders(folder)) == ["end"]
    surface = read_surface(folder)
    assert surface is not None
    assert surface.radius == pytest.approx(1)
    photograph, prediction = (picture_of_test(folder, frame, each) for each in ("photograph", "prediction"))
    np.testing.assert_array_equal(photograph, prediction)
    assert picture_of_test(folder, frame, "error").max() == 0
    assert picture_of_test(folder, frame, "normals").shape == photograph.shape
    assert max(thumbnail(frame, 16).shape) <= 16


def test_the_server_shows_it(sphere_dataset: Dataset, tmp_path: Path) -> None:
    """By HTTP and by the protocol of the browser's client: the page, and messages that name what is in the scene."""
    pytest.importorskip("viser")
    viewer = open_prediction(written(tmp_path, sphere_dataset), Address(port=8137))
    try:
        assert b"<html" in urllib.request.urlopen(viewer.url, timeout=20).read(2000).lower()
        messages = asyncio.run(asyncio.wait_for(_received(viewer.url, (b"/surface", b"/environment")), 60))
        assert messages.count(b"/cameras/train/r_") >= len(sphere_dataset.train)
        corners = viewer.pick(np.array([4.0, 0, 0]), np.array([-1.0, 0, 0]))
        np.testing.assert_allclose(corners[1], [1, 0, 0], atol=0.05)
    finally:
        viewer.stop()


async def _received(url: str, names: tuple[bytes, ...]) -> bytes:
    """What a client is sent until all names were in it. Messages are 16 bytes of two lengths, then zstandard."""
    import viser
    import websockets
    import zstandard

    found, protocol = b"", f"viser-v{viser.__version__}"
    async with websockets.connect(url.replace("http", "ws"), subprotocols=[protocol], max_size=None) as client:
        while not all(name in found for name in names):
            data = await client.recv()
            length = int.from_bytes(data[8:16], "little")
            found += zstandard.ZstdDecompressor().decompress(data[16 : 16 + length])
    return found


def test_a_missing_viser_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, sphere_dataset: Dataset) -> None:
    """Everything else works without it; the message says how to install it."""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'panoless\[viewer\]'"):
        Viewer(sphere_dataset, tmp_path)
