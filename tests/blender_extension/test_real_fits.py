"""Real fits from Blender's buttons: what its mirror shows differs from photographs by what the fit itself leaves."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import Bool, Float
from mathutils import Vector

from shinypartial.conversion.extension import blender_camera
from shinypartial.core.color import linear_to_srgb
from shinypartial.dataset.bundled import bundled_dataset
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.prediction.format import prediction_frame
from tests.blender_extension.conftest import write_program

pytestmark = pytest.mark.slow


@pytest.fixture
def real(programs: Path) -> None:
    """The real panoless."""
    write_program(programs, "panoless", "from panoless.cli import main\nsys.exit(main())\n")


def psnr(one: Float[np.ndarray, "H W 3"], other: Float[np.ndarray, "H W 3"], where: Bool[np.ndarray, "H W"]) -> float:
    """Of sRGB colors, in dB."""
    first, second = (linear_to_srgb(each.clip(0, 1))[where] for each in (one, other))
    return float(-10 * np.log10(((first - second) ** 2).mean()))


@pytest.mark.timeout(3600)
@pytest.mark.usefixtures("real")
def test_the_mirror_of_a_fit_looks_as_the_fit_says(blender: Any, picture: Callable[..., np.ndarray]) -> None:
    """In test views. Measured: 33.1, 33.2, 34.4 dB against photographs where the fit itself has 33.1, 33.5, 34.7."""
    from blender_extension.build import _add_camera, show_photograph

    dataset = open_dataset(bundled_dataset("tiny-vase"))
    cameras = str(dataset.root / "transforms_train.json")
    assert blender.ops.panoless.light(filepath=cameras, preset="fast") == {"FINISHED"}
    scene = blender.context.scene
    scene.objects["PanoLess ground"].hide_render = True
    for frame in dataset.test[:3]:
        name = f"test {frame.stem.name}"
        _add_camera(scene.collection, asdict(blender_camera(name, frame.photograph, frame.camera)), Vector(), 1.0)
        show_photograph(scene, scene.objects[f"PanoLess camera {name}"])
        found, truth = picture(blender, samples=64), read_view(frame)
        fitted = read_view(prediction_frame(Path(scene.panoless.prediction), frame))
        solid = (truth.alpha > 0.99) & (found[..., 3] > 0.99) & (fitted.alpha > 0.99)
        assert psnr(found[..., :3], truth.radiance, solid) > psnr(fitted.radiance, truth.radiance, solid) - 0.5
        assert psnr(found[..., :3], fitted.radiance, solid) > 40


@pytest.mark.timeout(3600)
@pytest.mark.usefixtures("real")
def test_photographs_of_a_ball_light_the_scene(blender: Any) -> None:
    """Those that come with the package."""
    assert blender.ops.panoless.example() == {"FINISHED"}
    scene = blender.context.scene
    assert scene.world.name == "PanoLess"
    assert [each.type for each in scene.objects].count("CAMERA") == 3
    assert scene.panoless.verdict
