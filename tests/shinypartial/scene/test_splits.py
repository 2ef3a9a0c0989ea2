"""Splits: every scene declares one, the held-out ones are many and varied, and no constant was chosen by them."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from shinypartial.blender.geometry import make_part
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import MANIFEST
from shinypartial.scene import (
    DEVELOPMENT,
    HELD_OUT,
    SPLITS,
    load_scene,
    older_recipe,
    override,
    parse_scene,
    scene_names,
)
from tests.architecture.source import ROOT
from tests.support.coarse_scene import coarse_scene, parts_of
from tests.support.tiny_scene import tiny_scene

#: Scenes whose names are words of geometry, which code uses without meaning them.
WORDS = {"sphere"}


def test_the_scenes_that_anything_was_chosen_by_are_for_development() -> None:
    chosen_by = {"vase", "cola", "mirror", "deformed-mirror", "sculpture", "dish", "horseshoe"}
    chosen_by |= {"chrome-block", "glass-front"}
    assert set(scene_names(DEVELOPMENT)) == chosen_by
    assert sorted(scene_names(DEVELOPMENT) + scene_names(HELD_OUT)) == scene_names()


def test_held_out_scenes_are_of_other_shapes_worlds_and_cameras() -> None:
    held_out, development = ([load_scene(name) for name in scene_names(split)] for split in (HELD_OUT, DEVELOPMENT))
    assert len(held_out) >= 6 + len({"teapot", "coffee", "sphere"})
    shapes = [tuple(part.shape for part in parts_of(spec)) for spec in held_out]
    assert not set(shapes) & {tuple(part.shape for part in parts_of(spec)) for spec in development}
    assert len({spec.world for spec in held_out} - {spec.world for spec in development}) >= 4
    assert len({spec.camera.path for spec in held_out}) == 5, "Every kind of path."
    assert not {spec.camera for spec in held_out} & {spec.camera for spec in development}


def convexity(name: str) -> float:
    """The share of the convex hull's volume that a closed form of one part fills."""
    from scipy.spatial import ConvexHull

    (part,) = parts_of(coarse_scene(name))
    mesh = make_part(part)
    triangles = np.array([(face[0], *face[i : i + 2]) for face in mesh.faces for i in range(1, len(face) - 1)])
    a, b, c = mesh.vertices[triangles].transpose(1, 0, 2)
    return float(np.sum(a * np.cross(b, c)) / 6 / ConvexHull(mesh.vertices).volume)


def test_free_forms_and_concave_forms_are_among_them() -> None:
    kinds = {part.shape.kind for name in scene_names(HELD_OUT) for part in parts_of(load_scene(name))}
    assert {"radial_harmonics", "superquadric", "ring", "soft_balls"} <= kinds
    # Measured 0.999, 0.51 and 0.84.
    assert convexity("pebble") > 0.99
    assert convexity("wavy-ring") < 0.6
    assert convexity("idol") < 0.9


def test_development_scenes_have_a_hollow_and_inner_sides() -> None:
    # Measured 0.86 and 0.77.
    assert convexity("dish") < 0.9
    assert convexity("horseshoe") < 0.85


def test_no_option_or_constant_is_chosen_by_a_held_out_scene() -> None:
    """A fit knows no scene; where one is named at all, something was chosen by looking at it."""
    names = "|".join(sorted(set(scene_names(HELD_OUT)) - WORDS)).replace("-", "[-_ ]")
    found = {
        f"{path.relative_to(ROOT)}: {match.group()}"
        for path in (ROOT / "panoless").rglob("*.py")
        for match in re.finditer(rf"\b({names})\b", path.read_text(encoding="utf-8"), re.IGNORECASE)
    }
    assert found == set()


@pytest.mark.parametrize("split", SPLITS)
def test_a_split_is_kept_by_variations_and_enters_the_recipe(tmp_path: Path, split: str) -> None:
    spec = parse_scene(load_scene("vase").recipe() | {"split": split}, "the recipe")
    assert spec.split == split
    assert override(spec, roughness=0.2).recipe()["split"] == split


def test_a_recipe_without_split_learns_what_to_write() -> None:
    table = load_scene("vase").recipe()
    del table["split"]
    with pytest.raises(InputError, match=r"`split` of scene\.toml") as raised:
        parse_scene(table, "scene.toml")
    assert 'split = "development"' in raised.value.remedy
    with pytest.raises(InputError, match=r"split.*one of development, held-out"):
        parse_scene(table | {"split": "test"}, "scene.toml")


def test_a_dataset_tells_the_split_of_its_scene_and_an_older_one_continues(tmp_path: Path) -> None:
    pytest.importorskip("bpy")
    from shinypartial.generate.dataset import generate

    spec = tiny_scene(tmp_path / "recipe")
    root = generate(spec, tmp_path / "made").root
    assert open_dataset(root).scene_split == DEVELOPMENT
    assert open_dataset(root).manifest["recipe"]["render"]["max_bounces"] == 16
    manifest = json.loads((root / MANIFEST).read_text(encoding="utf-8"))
    del manifest["recipe"]["split"], manifest["recipe"]["render"]["max_bounces"]
    (root / MANIFEST).write_text(json.dumps(manifest), encoding="utf-8")
    assert open_dataset(root).scene_split == "unknown"
    (root / "train/r_000.exr").unlink()
    assert generate(spec, root).rendered == 1
    manifest = json.loads((root / MANIFEST).read_text(encoding="utf-8"))
    manifest["recipe"] |= {"split": DEVELOPMENT}
    del manifest["recipe"]["operator"], manifest["recipe"]["camera"]["motion_deg"], manifest["recipe"]["world"]["room"]
    (root / MANIFEST).write_text(json.dumps(manifest), encoding="utf-8")
    assert generate(spec, root).rendered == 0, "A folder of a version in between."
    with pytest.raises(InputError, match=r"another recipe.*operator"):
        generate(override(spec, operator_height=1.0), root)
    with pytest.raises(InputError, match=r"another recipe.*split"):
        generate(dataclasses.replace(spec, split=HELD_OUT), root)
    with pytest.raises(InputError, match="another recipe"):
        generate(parse_scene(spec.recipe() | {"world": {"kind": "studiolight", "name": "city"}}, "other"), root)


def test_an_older_recipe_lacks_what_later_versions_added_and_nothing_else() -> None:
    recipe = load_scene("cola").recipe()
    older = older_recipe(recipe)
    assert recipe.keys() - older.keys() == {"split", "operator", "ground"}
    assert recipe["world"].keys() - older["world"].keys() == {"distance_radii", "room", "proportions"}
    assert recipe["camera"].keys() - older["camera"].keys() == {"f_number", "focus_distance", "motion_deg"}
    assert recipe["render"].keys() - older["render"].keys() == {"max_bounces"}
    assert [part.keys() for part in older["object"]["parts"]] == [{"shape", "material"}] * 4
    near = load_scene("kettle").recipe()["world"] | {
        "distance_radii": 5.0,
        "room": "box",
        "proportions": [1.0, 1.0, 1.0],
    }
    assert older_recipe(near) == near
    moved = recipe | {"render": recipe["render"] | {"max_bounces": 4}}
    assert older_recipe(moved)["render"]["max_bounces"] == 4
