"""The ground past an object: a ray-traced sheet of tiles below a mirror ball, which knows nothing of maps."""

from pathlib import Path

import numpy as np
import pytest

from panoless.capture.ground import Ground
from panoless.capture.views import load_views
from shinypartial.core.camera import Similarity
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset, read_statement
from shinypartial.dataset.schema import GroundPlane, Statement
from shinypartial.io.files import read_json, write_json
from tests.support.ball_on_tiles import CENTER, GROUND, RADIUS, linear_tiles, write_ball_on_tiles


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ball_on_tiles(tmp_path_factory.mktemp("ball"))


def ground_of(folder: Path) -> Ground | None:
    return load_views(open_dataset(folder), 8).ground


def test_its_light_is_that_of_the_sheet_in_the_directions_from_the_object(folder: Path) -> None:
    views = load_views(open_dataset(folder), 8)
    ground, frame = views.ground, views.object_frame
    assert ground is not None
    np.testing.assert_allclose(frame.center, CENTER, atol=0.03 * RADIUS)
    assert ground.depth == pytest.approx(frame.center[2] / frame.radius)
    directions = ground.light.directions.numpy().astype(np.float64)
    places = frame.to_world(ground.depth / -directions[:, 2:] * directions)
    np.testing.assert_allclose(places[:, 2], 0, atol=1e-5)
    off = np.abs(ground.light.radiance.numpy() - linear_tiles(places[:, :2])).max(1)
    assert len(off) > 3000
    # At the edges of tiles a direction has the color of the one that fills more of it.
    assert np.quantile(off, 0.75) < 0.02
    assert (ground.light.weight > 0).all()


def test_what_masks_lack_of_the_object_is_no_ground(folder: Path) -> None:
    """A ball of whose lower half masks lack a strip is seen before another tile by each view."""
    lacking = write_ball_on_tiles(folder.parent / "lacking", lacked_px=6)
    seen = ground_of(lacking)
    assert seen is not None
    directions = seen.light.directions.numpy().astype(np.float64)
    views = load_views(open_dataset(lacking), 8)
    places = views.object_frame.to_world(seen.depth / -directions[:, 2:] * directions)
    off = np.abs(seen.light.radiance.numpy() - linear_tiles(places[:, :2])).max(1)
    assert np.quantile(off, 0.7) < 0.02


def test_without_a_statement_none_is_looked_for(folder: Path, tmp_path: Path) -> None:
    plain = write_ball_on_tiles(tmp_path)
    stated = read_json(plain / "transforms_train.json", "cameras")
    write_json(plain / "transforms_train.json", {key: stated[key] for key in stated if key != "ground"})
    assert ground_of(plain) is None


def test_a_plane_above_the_object_is_none(folder: Path, tmp_path: Path) -> None:
    above = write_ball_on_tiles(tmp_path)
    stated = read_json(above / "transforms_train.json", "cameras")
    write_json(above / "transforms_train.json", {**stated, "ground": {"normal": [0, 0, 1], "offset": 1.5}})
    assert ground_of(above) is None


def test_a_plane_moves_with_its_points() -> None:
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    world = Similarity(2.5, turn, np.array([0.3, -0.7, 1.1]))
    plane = GroundPlane((0.6, 0.0, 0.8), 0.4)
    points = np.array([[0.6, 0.0, 0.8]]) * 0.4 + np.random.default_rng(1).normal(size=(9, 2)) @ [
        [0, 1, 0],
        [0.8, 0, -0.6],
    ]
    moved = plane.moved(world)
    np.testing.assert_allclose(world(points) @ np.array(moved.normal), moved.offset)
    assert np.linalg.norm(moved.normal) == pytest.approx(1)


@pytest.mark.parametrize(
    ("stated", "found"),
    [
        ({"ground": {"normal": [0, 0, 2], "offset": 0}}, "normal of length 1"),
        ({"ground": {"normal": [0, 0], "offset": 0}}, "ground"),
        ({"focal_sigma": -1}, "focal_sigma"),
        ({"focal_sigma": "sure"}, "focal_sigma"),
        ({"mask_sigma_px": -0.5}, "mask_sigma_px"),
    ],
)
def test_statements_without_a_meaning_are_refused(tmp_path: Path, stated: dict, found: str) -> None:
    folder = write_ball_on_tiles(tmp_path)
    path = folder / "transforms_train.json"
    write_json(path, {**read_json(path, "cameras"), **stated})
    dataset = open_dataset(folder)
    with pytest.raises(InputError, match=found):
        read_statement(dataset)


def test_what_is_stated_is_read(folder: Path) -> None:
    dataset = open_dataset(folder)
    assert read_statement(dataset) == Statement(0.001, 0.0, GROUND)
