"""Recipes: the vase is what it should be, a recipe survives its own JSON, and each bad value is named."""

import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shinypartial.core.errors import InputError
from shinypartial.scene import SCENES, FileWorld, StudioWorld, load_scene, override, parse_scene, scene_names
from tests.support.tiny_scene import tiny_scene, write_recipe

VASE = SCENES / "vase" / "scene.toml"


def test_the_vase_is_a_perfect_mirror_under_the_interior_light() -> None:
    vase = load_scene("vase")
    assert (vase.material.metallic, vase.material.roughness, vase.material.base_color) == (1, 0, (1, 1, 1))
    assert vase.world == StudioWorld("interior")
    assert (vase.camera.train, vase.camera.test, vase.camera.sweeps, vase.camera.radius) == (100, 200, 5, 3.2)
    assert (vase.render.samples, vase.render.resolution) == (16, 800)
    assert vase.object.profile[0] == (0, 0)
    assert vase.object.offset_z == -0.9


def test_a_path_names_a_scene_as_well() -> None:
    assert load_scene(str(VASE)) == load_scene("vase")


@pytest.mark.parametrize("name", scene_names())
def test_the_recipe_in_a_dataset_gives_the_scene_back(name: str) -> None:
    spec = load_scene(name)
    assert spec.name == name
    assert parse_scene(spec.recipe(), "the manifest") == spec


def test_a_world_file_is_named_by_its_content(tmp_path: Path) -> None:
    here, there = tiny_scene(tmp_path / "a"), tiny_scene(tmp_path / "b")
    assert here != there
    assert here.recipe() == there.recipe()
    assert isinstance(here.world, FileWorld)
    Path(here.world.path).write_bytes(b"another world")
    assert here.recipe() != there.recipe()


def test_an_unknown_scene_lists_what_exists() -> None:
    with pytest.raises(InputError, match=r"vase.*'vse'"):
        load_scene("vse")


def test_a_missing_recipe_file_is_an_error_of_the_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_scene(str(tmp_path / "scene.toml"))


BAD = {
    "unknown key": ("object", "colour", "red", "object.colour"),
    "unknown table": (None, "lamp", {}, "`lamp`"),
    "missing": (None, "title", None, "title"),
    "not a number": ("camera", "radius", "far", "camera.radius"),
    "true is no number": ("camera", "radius", True, "camera.radius"),
    "not whole": ("camera", "train", 10.5, "camera.train"),
    "NaN": ("material", "roughness", float("nan"), "material.roughness"),
    "infinite": ("world", "strength", float("inf"), "world.strength"),
    "out of range": ("material", "metallic", 1.5, "material.metallic"),
    "negative": ("render", "samples", -1, "render.samples"),
    "unknown choice": ("world", "name", "kitchen", "world.name.*interior"),
    "unknown kind": ("object", "kind", "teapot", "object.kind.*sphere"),
    "kind of wrong type": ("object", "kind", [1], "object.kind"),
    "empty text": (None, "license", " ", "license"),
    "text of wrong type": (None, "title", 3, "title"),
    "other format": (None, "format", 2, "format"),
    "table of wrong type": (None, "camera", 3, "`camera`"),
    "pair of three": ("camera", "azimuth_deg", [-1, 0, 1], "camera.azimuth_deg"),
    "pair of wrong type": ("camera", "elevation_deg", 3, "camera.elevation_deg"),
    "falling pair": ("camera", "azimuth_deg", [75, -75], "camera.azimuth_deg"),
    "half circle": ("camera", "azimuth_deg", [-90, 90], "camera.azimuth_deg.0"),
    "camera inside": ("camera", "radius", 0.9, "camera.radius"),
    "two points": ("object", "profile", [[0, 0], [1, 1]], "object.profile"),
    "point twice": ("object", "profile", [[0, 0], [1, 1], [1, 1]], "object.profile"),
    "negative radius": ("object", "profile", [[0, 0], [-1, 1], [1, 2]], "object.profile"),
    "pinched": ("object", "profile", [[1, 0], [0, 1], [1, 2]], "object.profile"),
    "point of three": ("object", "profile", [[0, 0], [1, 1, 1], [1, 2]], "object.profile.1"),
    "plane without normal": (None, "object", {"kind": "plane", "normal": [0, 0, 0]}, "object.normal"),
}


@pytest.mark.parametrize(("section", "key", "value", "named"), BAD.values(), ids=BAD.keys())
def test_a_bad_value_is_named_with_its_file(section: str | None, key: str, value: object, named: str) -> None:
    table = tomllib.loads(VASE.read_text(encoding="utf-8"))
    place = table[section] if section else table
    place[key] = value
    if value is None:
        del place[key]
    with pytest.raises(InputError, match=named) as raised:
        parse_scene(table, "scene.toml")
    assert "scene.toml" in raised.value.expected


def test_broken_toml_names_the_line(tmp_path: Path) -> None:
    path = write_recipe(tmp_path)
    path.write_text(path.read_text() + "\nlens = wide\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"scene\.toml to be TOML.*line"):
        load_scene(str(path))


def test_a_world_that_is_not_there_is_refused(tmp_path: Path) -> None:
    path = write_recipe(tmp_path)
    (tmp_path / "world.exr").unlink()
    with pytest.raises(InputError, match=r"world\.path"):
        load_scene(str(path))


@given(train=st.integers(1, 500), test=st.integers(1, 500), samples=st.integers(1, 512), resolution=st.integers(4, 999))
def test_options_replace_their_values_and_nothing_else(train: int, test: int, samples: int, resolution: int) -> None:
    vase = load_scene("vase")
    changed = override(vase, train=train, test=test, samples=samples, resolution=resolution)
    assert (changed.camera.train, changed.camera.test) == (train, test)
    assert (changed.render.samples, changed.render.resolution) == (samples, resolution)
    assert override(changed, train=100, test=200, samples=16, resolution=800) == vase


@pytest.mark.parametrize("option", ["train", "test", "samples", "resolution"])
def test_options_are_checked_as_recipes_are(option: str) -> None:
    with pytest.raises(InputError, match=option):
        override(load_scene("vase"), **{option: 0})
