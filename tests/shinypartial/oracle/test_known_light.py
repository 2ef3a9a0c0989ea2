"""A light is recognized among others, turned and brighter as it is; where none is the right one, none is taken."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

from shinypartial.cli import main
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions
from shinypartial.dataset.read import open_dataset, read_environment, read_view
from shinypartial.dataset.schema import Dataset
from shinypartial.dataset.subset import SubsetOptions, make_subset
from shinypartial.dataset.validate import unscored, validate
from shinypartial.io.files import read_json, write_json
from shinypartial.io.images import read_exr_rgb, write_exr_rgb
from shinypartial.oracle import known_light
from shinypartial.oracle.known_light import find_light
from tests.support import synthetic_dataset
from tests.support.shiny_blender import make_shiny_blender_dataset
from tests.support.synthetic_dataset import make_plain_sphere_dataset, make_sphere_dataset

HEIGHT = 64
TURN_DEG, FACTOR = 130.3, 1.6


def seen_from(azimuth_deg: float, mirrored: bool = False) -> Float[np.ndarray, "H W 3"]:
    """Directions of a map's texels, in a world that is turned about +Z, or mirrored."""
    x, y, z = np.moveaxis(latlong_directions(HEIGHT), -1, 0)
    angle = np.radians(azimuth_deg)
    y = -y if mirrored else y
    return np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, z], -1)


def lamps(directions: Float[np.ndarray, "*S 3"]) -> Float[np.ndarray, "*S 3"]:
    """Sixty colored spots 15° wide, in [0, 1]."""
    random = np.random.default_rng(1)
    places = random.normal(size=(60, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    near = np.exp(30 * (directions @ places.T - 1))
    return np.minimum(0.05 + near @ random.random((60, 3)), 1)


@pytest.fixture(scope="module")
def worlds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The light of the ball, turned and darker; its mirror image; its negative; and patches."""
    folder = tmp_path_factory.mktemp("worlds")
    patches = np.kron(np.random.default_rng(0).random((8, 16, 3)), np.ones((8, 8, 1)))
    maps = {
        "right": lamps(seen_from(TURN_DEG)) / FACTOR,
        "mirrored": lamps(seen_from(TURN_DEG, mirrored=True)),
        "negative": 1 - lamps(seen_from(0)),
        "patches": patches,
    }
    for name, radiance in maps.items():
        write_exr_rgb(folder / f"{name}.exr", radiance.astype(np.float32))
    return {name: folder / f"{name}.exr" for name in maps}


def test_what_is_no_map_of_the_sphere_is_refused(source: Dataset, tmp_path: Path) -> None:
    write_exr_rgb(tmp_path / "wrong.exr", np.full((8, 12, 3), 0.5, np.float32))
    with pytest.raises(InputError, match="twice as wide as high"):
        find_light(source.root, tmp_path / "lit", {"wrong": tmp_path / "wrong.exr"})


@pytest.mark.parametrize("strength", [0.0, -1.0, float("nan")])
def test_a_strength_is_positive(strength: float, source: Dataset, worlds: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--strength"):
        find_light(source.root, tmp_path / "lit", worlds, strength=strength)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A ball in the layout of Shiny Blender, photographed from all around, in that light."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic_dataset, "environment_radiance", lamps)
        return make_shiny_blender_dataset(tmp_path_factory.mktemp("shiny") / "ball", 24, resolution=48)


def test_the_light_is_found_turned_and_as_bright_as_it_is(
    source: Dataset, worlds: dict[str, Path], tmp_path: Path
) -> None:
    found = find_light(source.root, tmp_path / "lit", worlds, strength=FACTOR)
    assert found.match.name == "right"
    # The ball is 20 px wide and normals have 8 bits.
    assert found.match.turn_deg == pytest.approx(TURN_DEG, abs=0.5)
    assert 2**found.match.stops == pytest.approx(FACTOR, rel=0.05)
    assert found.match.correlation > 0.7
    lit = open_dataset(tmp_path / "lit")
    assert np.abs(read_environment(lit) - lamps(latlong_directions(HEIGHT))).mean() < 0.01
    assert [frame.name for frame in lit.train] == [frame.name for frame in source.train]
    assert not validate(lit.root)
    assert unscored(lit.root) is None


def test_a_subset_keeps_what_it_states(source: Dataset, worlds: dict[str, Path], tmp_path: Path) -> None:
    part = make_subset(source.root, tmp_path / "part", SubsetOptions(around=(0.0, 0.0), radius_deg=60))
    find_light(part.root, tmp_path / "lit", worlds, link=True)
    assert not validate(tmp_path / "lit")
    recipe = open_dataset(tmp_path / "lit").manifest["recipe"]
    assert recipe["subset_of"]["name"] == "ball"
    assert recipe["light"]["name"] == "right"
    (tmp_path / "lit/environment/cube/px.exr").unlink()
    assert all("`shinypartial find-light` that made" in each.remedy for each in validate(tmp_path / "lit"))


def test_what_compression_left_below_zero_is_no_light(source: Dataset, worlds: dict[str, Path], tmp_path: Path) -> None:
    radiance = read_exr_rgb(worlds["right"]).copy()
    radiance[-1, :4] = -1e-3
    write_exr_rgb(tmp_path / "right.exr", radiance)
    find_light(source.root, tmp_path / "lit", {**worlds, "right": tmp_path / "right.exr"})
    assert not validate(tmp_path / "lit")


def test_where_none_is_the_light_none_is_taken(source: Dataset, worlds: dict[str, Path], tmp_path: Path) -> None:
    others = {name: path for name, path in worlds.items() if name in ("negative", "patches")}
    with pytest.raises(InputError, match="--worlds"):
        find_light(source.root, tmp_path / "lit", others)
    assert not (tmp_path / "lit").exists()


def test_what_can_tell_no_light_is_refused(worlds: dict[str, Path], tmp_path: Path) -> None:
    known = make_sphere_dataset(tmp_path / "known", 16, train=2, test=1)
    bare = make_plain_sphere_dataset(tmp_path / "bare", 16, train=2, test=1)
    for dataset, named in ((known, "environment"), (bare, "normals")):
        with pytest.raises(InputError, match=named):
            find_light(dataset.root, tmp_path / "lit", worlds)


@pytest.mark.parametrize("absolute", [False, True])
def test_pictures_outside_of_the_folder_are_refused(
    source: Dataset, worlds: dict[str, Path], tmp_path: Path, absolute: bool
) -> None:
    root = Path(shutil.copytree(source.root, tmp_path / "sets/ball"))
    (root / "train").rename(tmp_path / "train")
    content = read_json(root / "transforms_train.json", "cameras")
    for entry in content["frames"]:
        name = Path(entry["file_path"]).name
        entry["file_path"] = str(tmp_path / "train" / name) if absolute else f"../../train/{name}"
    write_json(root / "transforms_train.json", content)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match="within that folder"):
        find_light(root, tmp_path / "deeper/lit", worlds)
    assert sorted(tmp_path.rglob("*")) == before


def test_no_more_views_are_read_than_stated(source: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every second of 24 where 13 are the most: with all, there would be too many."""
    read: list[str] = []
    monkeypatch.setattr(known_light, "MOST_VIEWS", 13)
    monkeypatch.setattr(known_light, "read_view", lambda frame: (read.append(frame.name), read_view(frame))[1])
    known_light.mirrored_rays(source)
    assert read == [frame.name for frame in (*source.train, *source.test)][::2]


def test_maps_of_one_name_are_refused(
    source: Dataset, worlds: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other/right.exr"
    words = ["find-light", str(source.root), "--output", str(tmp_path / "lit"), "--worlds"]
    assert main([*words, str(worlds["right"]), str(other)]) == 2
    assert "different file names" in capsys.readouterr().err


def test_the_command_says_which_light_it_is(
    source: Dataset, worlds: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["find-light", str(source.root), "--output", str(tmp_path / "lit"), "--worlds"]
    assert main([*words, *(str(path) for path in worlds.values())]) == 0
    printed = capsys.readouterr().out
    assert "Lit by right, turned by 130." in printed
    assert "it shows 1.6" in printed
