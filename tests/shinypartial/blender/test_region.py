"""The rendered region holds all of the object, and leaving the rest out changes no pixel."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shinypartial.blender import render
from shinypartial.blender.region import MARGIN_PX, Region, image_region
from shinypartial.core.camera import Camera, look_at, project
from shinypartial.core.trajectory import plan_cameras
from tests.support.tiny_scene import tiny_scene


def camera_at(position: tuple[float, float, float], width: int = 60, height: int = 40) -> Camera:
    pose = look_at(np.array(position), np.zeros(3))
    return Camera(pose, 70.0, 70.0, width / 2, height / 2, width, height)


@given(seed=st.integers(0, 2**31), spread=st.floats(0.01, 1.5))
def test_every_vertex_that_is_seen_lies_in_the_region(seed: int, spread: float) -> None:
    camera = camera_at((4.0, 1.0, 0.5))
    points = np.random.default_rng(seed).uniform(-spread, spread, (20, 3))
    region = image_region(camera, points)
    x, y, _ = project(camera, points).T
    seen = (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)
    assert ((x >= region.left) & (x <= region.right))[seen].all()
    assert ((y >= region.top) & (y <= region.bottom))[seen].all()


def test_the_region_is_tight() -> None:
    camera = camera_at((4.0, 0.0, 0.0))
    region = image_region(camera, np.array([[0.0, -0.5, -0.25], [0.0, 0.5, 0.25]]))
    half_width, half_height = 0.5 * 70 / 4, 0.25 * 70 / 4
    assert region.right - region.left <= 2 * half_width + 2 * MARGIN_PX + 2
    assert region.bottom - region.top <= 2 * half_height + 2 * MARGIN_PX + 2


def test_nothing_is_left_out_where_a_vertex_lies_behind_or_none_is_known() -> None:
    camera = camera_at((4.0, 0.0, 0.0))
    whole = Region(0, 0, camera.width, camera.height)
    assert image_region(camera, np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])) == whole
    assert image_region(camera, np.zeros((0, 3))) == whole


@pytest.mark.parametrize("point", [(0.0, 9.0, 0.0), (0.0, 0.0, -9.0), (0.0, -9.0, 9.0)])
def test_a_region_is_never_empty(point: tuple[float, float, float]) -> None:
    region = image_region(camera_at((4.0, 0.0, 0.0)), np.array([point]))
    assert 0 <= region.left < region.right <= 60
    assert 0 <= region.top < region.bottom <= 40


def test_no_pixel_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same renderer with and without a border: equal in every pass.

    But for the last bits of the averaged light: numpy's vector functions round by where an array lies in memory.
    """
    pytest.importorskip("bpy")
    shape = '{ kind = "plane", size = [1.0, 0.6], normal = [1.0, 0.5, 0.4] }'
    spec = tiny_scene(tmp_path, shape=shape, samples=8, resolution=37)
    camera = plan_cameras(spec.camera, 37).train[0]
    with render.open_renderer(spec) as renderer:
        region = image_region(camera, renderer.body_vertices_world)
        assert (region.right - region.left) * (region.bottom - region.top) < 0.5 * 37**2
        bordered = renderer.render(camera)
        monkeypatch.setattr(render, "image_region", lambda *_: Region(0, 0, 37, 37))
        whole = renderer.render(camera)
    inside = np.zeros((37, 37), bool)
    inside[region.top : region.bottom, region.left : region.right] = True
    assert (whole.alpha[~inside] == 0).all()
    assert whole.alpha.any()
    np.testing.assert_allclose(bordered.radiance, whole.radiance, rtol=4 * np.finfo(np.float32).eps, atol=0)
    for name in ("alpha", "normals_world", "depth", "self_reflection"):
        np.testing.assert_array_equal(getattr(bordered, name), getattr(whole, name))
