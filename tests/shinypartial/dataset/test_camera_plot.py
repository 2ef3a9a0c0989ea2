"""The picture of the cameras: colors of both splits where the cameras are, small, and drawn along the right axes."""

from pathlib import Path

import numpy as np
import pytest

from shinypartial.core.trajectory import PATHS, CameraPath, plan_cameras
from shinypartial.dataset.camera_plot import (
    SIZE_INCHES,
    TEST_COLOR,
    TRAIN_COLOR,
    hemisphere_boundary,
    plot_cameras,
    side_view,
    top_view,
)
from shinypartial.io.images import read_png


def pixels_like(picture: np.ndarray, color: str) -> int:
    """How many pixels have a color, give or take the palette."""
    wanted = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])
    return int((np.abs(picture[..., :3].astype(int) - wanted).max(-1) < 12).sum())


@pytest.mark.parametrize("path", PATHS)
def test_the_picture_shows_both_splits_and_is_small(tmp_path: Path, path: str) -> None:
    file = tmp_path / "cameras.png"
    plot_cameras(file, plan_cameras(CameraPath(path=path), 64))
    assert file.stat().st_size < 150_000
    picture = read_png(file)
    assert picture.shape[1] == 100 * SIZE_INCHES[0]
    # 300 dots of some 10 pixels each, drawn twice, some on top of others (least: the plus, seen edge-on).
    assert pixels_like(picture, TRAIN_COLOR) > 200
    assert pixels_like(picture, TEST_COLOR) > 200


def test_thousands_of_cameras_still_make_a_small_picture(tmp_path: Path) -> None:
    plot_cameras(tmp_path / "cameras.png", plan_cameras(CameraPath(path="golden_spiral", train=1000, test=2000), 64))
    assert (tmp_path / "cameras.png").stat().st_size < 150_000


@pytest.mark.parametrize("axis", [[0.0, -1.0, 0.0], [0.6, 0.0, 0.8], [0.0, 0.0, 1.0]])
def test_the_side_view_shows_the_axis_in_full_and_the_boundary_edge_on(axis: list[float]) -> None:
    direction = np.array(axis)
    view = side_view(direction)
    assert np.linalg.norm(view.project(direction)) == pytest.approx(1)
    circle = hemisphere_boundary(direction, 2.0)
    np.testing.assert_allclose(np.linalg.norm(circle, axis=-1), 2)
    np.testing.assert_allclose(circle @ direction, 0, atol=1e-12)
    np.testing.assert_allclose(view.project(circle) @ view.project(direction), 0, atol=1e-12)


def test_the_top_view_is_a_map() -> None:
    np.testing.assert_array_equal(top_view().project(np.array([1.0, 2.0, 3.0])), [1, 2])
