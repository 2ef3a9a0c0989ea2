"""Mitsuba 3 and OpenUSD themselves read the files that are written for them: `pip install -e '.[programs]'`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shinypartial.conversion.convert import convert
from tests.shinypartial.conversion.test_scenes import DIRECTIONS, prediction

__all__ = ["prediction"]

SPAN_PX = 4
"""Every so many pixels along a side are compared with what rays through them meet."""


def color(directions: np.ndarray) -> np.ndarray:
    """Of the light from there."""
    return (directions + 1) / 2


@pytest.fixture
def mitsuba() -> Any:
    found = pytest.importorskip("mitsuba")
    found.set_variant("scalar_rgb")
    return found


def test_mitsuba_finds_the_light_of_a_direction(mitsuba: Any, prediction: Path) -> None:
    """As the emitter is sampled, without a picture. A texel of 64 spans 2.8°."""
    convert(prediction, ("mitsuba",), prediction / "out")
    light = mitsuba.load_file(str(prediction / "out" / "scene.xml")).environment()
    met = mitsuba.SurfaceInteraction3f()
    for direction in DIRECTIONS:
        met.wi = mitsuba.Vector3f(*(-direction).tolist())
        np.testing.assert_allclose(np.array(light.eval(met)), color(direction), atol=0.03)


def test_mitsuba_renders_mirror_and_background(mitsuba: Any, prediction: Path) -> None:
    """Rays through pixels that meet nothing have the color of their direction, others that of the mirrored one times
    the reflectance.
    """
    convert(prediction, ("mitsuba",), prediction / "out")
    scene = mitsuba.load_file(str(prediction / "out" / "scene.xml"))
    (sensor,) = scene.sensors()
    picture = np.array(mitsuba.render(scene, spp=16))
    height, width = picture.shape[:2]
    beside, mirrored = [], []
    for row in range(SPAN_PX // 2, height, SPAN_PX):
        for column in range(SPAN_PX // 2, width, SPAN_PX):
            at = mitsuba.Point2f((column + 0.5) / width, (row + 0.5) / height)
            ray, _ = sensor.sample_ray(0.0, 0.5, at, mitsuba.Point2f(0.5, 0.5))
            met = scene.ray_intersect(ray)
            direction = np.array(ray.d)
            if not met.is_valid():
                beside.append(picture[row, column] - color(direction))
                continue
            normal = np.array(met.sh_frame.n)
            out = direction - 2 * (direction @ normal) * normal
            if not scene.ray_test(met.spawn_ray(mitsuba.Vector3f(*out.tolist()))):
                mirrored.append(picture[row, column] - np.array([0.9, 0.6, 0.3]) * color(out))
    assert min(len(beside), len(mirrored)) > 100
    for errors in (beside, mirrored):
        assert np.quantile(np.abs(errors), 0.95) < 0.02


def test_usd_reads_a_stage_without_a_complaint(prediction: Path) -> None:
    """All validators of OpenUSD pass it, and it has meters, +Z up and the light's turn."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdValidation

    convert(prediction, ("usd",), prediction / "out")
    stage = Usd.Stage.Open(str(prediction / "out" / "scene.usda"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    complaints = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [each.GetMessage() for each in complaints] == []
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 1.0)
    light = UsdGeom.Xformable(stage.GetPrimAtPath("/scene/light")).GetLocalTransformation()
    turned = np.array([light.TransformDir(axis) for axis in np.eye(3).tolist()])
    np.testing.assert_allclose(turned, [[0, 1, 0], [0, 0, 1], [1, 0, 0]])
