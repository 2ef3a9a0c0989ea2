"""Camera options of the command line: keys of the recipe, checked as a recipe is."""

import dataclasses
import typing
from typing import Any

import pytest

from shinypartial.cli import main
from shinypartial.cli.scenes import CameraOptions
from shinypartial.core.errors import InputError
from shinypartial.core.trajectory import PATHS, SWEPT_PATHS, CameraPath
from shinypartial.generate import dataset as generate_module
from shinypartial.scene import SceneSpec, load_scene, override


@pytest.fixture
def requested(monkeypatch: pytest.MonkeyPatch) -> list[SceneSpec]:
    """The recipes that the command would have rendered."""
    specs: list[SceneSpec] = []

    def record(spec: SceneSpec, root: Any) -> generate_module.Generated:
        specs.append(spec)
        return generate_module.Generated(root, 0, 0)

    monkeypatch.setattr(generate_module, "generate", record)
    return specs


def test_options_are_keys_of_the_camera_in_their_order() -> None:
    options, keys = dataclasses.fields(CameraOptions), [key.name for key in dataclasses.fields(CameraPath)]
    assert (names := [option.name for option in options]) == [key for key in keys if key in names]
    assert all(option.default is None for option in options)


def test_paths_are_those_of_the_recipe() -> None:
    literal, _ = typing.get_args(typing.get_type_hints(CameraOptions)["path"])
    assert typing.get_args(literal) == PATHS


def test_options_enter_the_recipe(requested: list[SceneSpec], capsys: pytest.CaptureFixture[str]) -> None:
    arguments = "generate --scene vase --path plus --azimuth-deg -32 32 --elevation-deg -30 40 --train 10"
    assert main(arguments.split()) == 0
    assert requested[0].camera == dataclasses.replace(
        load_scene("vase").camera, path="plus", azimuth_deg=(-32, 32), elevation_deg=(-30, 40), train=10
    )
    assert requested[0].recipe()["camera"]["path"] == "plus"
    assert "datasets/vase-plus-800" in capsys.readouterr().out


def test_without_options_the_recipe_holds(requested: list[SceneSpec]) -> None:
    assert main(["generate", "--scene", "vase"]) == 0
    assert requested == [load_scene("vase")]


BAD = {
    "unknown path": ("--path spiral", "spiral"),
    "half circle": ("--azimuth-deg -90 90", "camera.azimuth_deg"),
    "falling range": ("--elevation-deg 40 10", "camera.elevation_deg"),
    "sweeps of a plus": ("--path plus --sweeps 3", "camera.sweeps"),
    "camera inside": ("--radius 0.5", "camera.radius"),
    "one end": ("--azimuth-deg 40", "azimuth-deg"),
}


@pytest.mark.parametrize(("options", "named"), BAD.values(), ids=BAD.keys())
def test_bad_options_are_named(
    options: str, named: str, requested: list[SceneSpec], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["generate", "--scene", "vase", *options.split()]) == 2
    out, err = capsys.readouterr()
    assert named in out + err
    assert requested == []


@pytest.mark.parametrize("path", PATHS)
def test_sweeps_are_refused_where_a_path_has_none(path: str) -> None:
    if path in SWEPT_PATHS:
        assert override(load_scene("vase"), path=path, sweeps=3).camera.sweeps == 3
    else:
        with pytest.raises(InputError, match="has no sweeps"):
            override(load_scene("vase"), path=path, sweeps=3)
