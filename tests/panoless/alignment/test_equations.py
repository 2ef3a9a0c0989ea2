"""Derivatives by poses, against surfaces that are seen by cameras which were moved."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from panoless.alignment.adjustment import adjusting_step
from panoless.alignment.equations import PoseRows, image_motion, light_rows, outline_rows
from panoless.alignment.options import PoseOptions
from panoless.capture.poses import moved_view
from panoless.capture.rays import pose_of, project
from panoless.capture.silhouettes import mask_distance_px
from panoless.capture.views import TrainView
from panoless.geometry.base import Geometry
from panoless.geometry.plane.kind import PlaneMirror
from panoless.geometry.revolution.kind import RevolutionMirror
from tests.support.mirror_plane import L_SHAPE, arc, plane_of, reflecting_views
from tests.support.mirror_revolution import around, goblet, known_environment, revolution_views

OPTIONS = PoseOptions()
SMALL = 1e-3
"""Change of a pose (rad, radii) over which differences are taken."""


def moved(view: TrainView, change: Float[np.ndarray, "6"]) -> TrainView:
    return moved_view(view, Rotation.from_rotvec(change[:3]).as_matrix(), change[3:])


def seen_goblet() -> tuple[TrainView, Geometry]:
    return revolution_views(goblet(), around(3)[1:2]).train[0], RevolutionMirror(goblet())


def seen_plane() -> tuple[TrainView, Geometry]:
    plane = plane_of(L_SHAPE)
    return reflecting_views(plane, arc(3)[1:2]).train[0], PlaneMirror(plane)


@pytest.mark.parametrize("axis", range(6))
def test_fixed_points_move_in_the_picture_as_the_derivative_says(axis: int) -> None:
    view, change = seen_plane()[0], SMALL * np.eye(6)[axis]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))

    def places(each: TrainView) -> Float[np.ndarray, "P 2"]:
        rotation, center = pose_of(each.camera)
        return np.stack(project(each.camera, (points - center) @ rotation.T), 1)

    rotation, center = pose_of(view.camera)
    expected = image_motion(view.camera, (points - center) @ rotation.T)[:, :, axis]
    found = (places(moved(view, change)) - places(moved(view, -change))) / (2 * SMALL)
    # Poses are float32: 1e-6 of some 100 px, over 2e-3.
    np.testing.assert_allclose(found, expected, atol=0.1)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("seen", [seen_goblet, seen_plane])
def test_what_is_mirrored_changes_as_the_derivative_says(seen: object, axis: int) -> None:
    """Depth and normals of one picture tell how those of a moved camera differ, for a bent surface and a flat one."""
    view, geometry = seen()  # type: ignore[operator]
    environment, change = known_environment(), SMALL * np.eye(6)[axis]
    pixels = np.arange(view.mask.numel())

    def shown(each: TrainView) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3 6"]]:
        """E(r) of all pixels, zero where none is told; the derivatives."""
        number = torch.arange(view.mask.numel()).float().reshape(1, *view.mask.shape)
        dark = replace(each, radiance=torch.zeros(3, *view.mask.shape))
        rows = light_rows(dark, pixels, geometry.buffers(each.camera), environment, OPTIONS)
        which = light_rows(
            replace(each, radiance=number.expand(3, -1, -1)),
            pixels,
            geometry.buffers(each.camera),
            environment,
            OPTIONS,
        )
        index = np.rint((rows.residual - which.residual)[:, 0]).astype(np.int64)
        values, slopes = np.full((view.mask.numel(), 3), np.nan), np.full((view.mask.numel(), 3, 6), np.nan)
        values[index], slopes[index] = rows.residual, rows.rows
        return values, slopes

    difference = (shown(moved(view, change))[0] - shown(moved(view, -change))[0]) / (2 * SMALL)
    expected = shown(view)[1][:, :, axis]
    both = np.isfinite(difference) & np.isfinite(expected)
    assert both.sum() > 1000
    error = np.abs(difference - expected)[both]
    # The map is piecewise linear, so its slope jumps at texels; half of the pixels are far from such a place.
    assert np.median(error) < 0.03 * max(np.abs(expected[both]).mean(), 0.05)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("seen", [seen_goblet, seen_plane])
def test_outlines_move_as_the_derivative_says(seen: object, axis: int) -> None:
    """An outline of a moved camera lies away from the mask by what the rows of the true one say."""
    view, geometry = seen()  # type: ignore[operator]
    distance = mask_distance_px(view.mask.numpy()).astype(np.float64)
    change = (0.01 if axis < 3 else 0.03) * np.eye(6)[axis]
    away = moved(view, change)
    rows = outline_rows(away, distance, geometry.buffers(away.camera))
    back = (rows.residual - rows.rows @ change)[:, 0]
    # Coverage by 4×4 rays and corners leave 0.09 px of up to 1.5 px.
    assert np.median(np.abs(back)) < 0.12
    assert np.abs(rows.residual).max() > 0.3


def test_a_texel_of_one_pixel_tells_nothing() -> None:
    """The map would follow it: only pixels that share a texel say how views lie to each other."""
    rng = np.random.default_rng(0)
    outline = PoseRows(np.zeros((0, 1)), np.zeros((0, 1, 6)))
    directions = rng.normal(size=(4, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    apart = [
        [outline, PoseRows(np.ones((2, 3)), rng.normal(size=(2, 3, 6)), part)]
        for part in (directions[:2], directions[2:])
    ]
    arguments = [0.1, 1.0], np.zeros((2, 6)), np.tile(np.eye(6), (2, 1, 1)), 64, OPTIONS
    np.testing.assert_allclose(adjusting_step(apart, *arguments), 0, atol=1e-12)
    shared = [[outline, replace(rows, directions=directions[:2])] for _, rows in apart]
    shared[1][1] = replace(shared[1][1], residual=-shared[1][1].residual)
    assert np.abs(adjusting_step(shared, *arguments)).min() > 1e-6
