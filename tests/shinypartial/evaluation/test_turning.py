"""The turning picture of a surface: errors at its points, and what its frames show."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shinypartial.core.camera import Camera, look_at, ray_directions_world
from shinypartial.dataset.schema import View
from shinypartial.evaluation.turning import SurfacePoints, errors_on_surface, turning_frames, turning_panels
from shinypartial.prediction.surface import PredictedSurface

SIDE_PX, DISTANCE = 96, 4.0


def globe(turn_deg: float = 0.0, confidence: bool = False) -> PredictedSurface:
    """A unit sphere of latitudes and longitudes whose normals are turned about +Z."""
    polar, azimuth = np.meshgrid(np.linspace(0.02, np.pi - 0.02, 60), np.linspace(0, 2 * np.pi, 120), indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    index = np.arange(points.size // 3).reshape(polar.shape)
    corners = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = [tuple(face) for face in np.stack(corners, -1).reshape(-1, 4).tolist()]
    points = points.reshape(-1, 3)
    normals = Rotation.from_rotvec([0, 0, np.radians(turn_deg)]).apply(points)
    return PredictedSurface(points, normals, faces, np.abs(points[:, 2]) if confidence else None)


def true_view(azimuth_deg: float, *, with_depth: bool = True) -> tuple[Camera, View]:
    """A unit sphere from the side, intersected in closed form."""
    position = DISTANCE * np.array([np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg)), 0.0])
    middle, focal = SIDE_PX / 2, 0.45 * SIDE_PX * DISTANCE
    camera = Camera(look_at(position, np.zeros(3)), focal, focal, middle, middle, SIDE_PX, SIDE_PX)
    rays = ray_directions_world(camera)
    along, square = rays @ position, DISTANCE**2 - 1
    met = along**2 > square
    distance = -along - np.sqrt(np.where(met, along**2 - square, 0))
    points = position + distance[..., None] * rays
    depth = distance * (rays @ (-position / DISTANCE))
    alpha = met.astype(np.float32)
    normals = np.where(met[..., None], points, 0).astype(np.float32)
    radiance = np.zeros((SIDE_PX, SIDE_PX, 3), np.float32)
    known = (depth * met).astype(np.float32) if with_depth else None
    return camera, View(radiance, alpha, normals, known, high_dynamic_range=True)


@pytest.mark.parametrize("with_depth", [True, False])
def test_errors_are_those_of_the_normals(with_depth: bool) -> None:
    """Normals turned by 5° about +Z are wrong by 5° at the equator; true ones by less than the mesh is coarse."""
    views = [true_view(azimuth, with_depth=with_depth) for azimuth in (0, 60)]
    for turn, expected in ((0.0, 0.0), (5.0, 5.0)):
        points = SurfacePoints.spread(globe(turn), 4000)
        errors = errors_on_surface(points, views)
        equator = np.abs(points.points[:, 2]) < 0.1
        assert np.nanmedian(errors[equator]) == pytest.approx(expected, abs=0.15)


def test_points_that_no_view_sees_have_no_error() -> None:
    points = SurfacePoints.spread(globe(), 4000)
    errors = errors_on_surface(points, [true_view(0)])
    assert np.isnan(errors[points.points[:, 0] < 0.2]).all()
    assert not np.isnan(errors[points.points[:, 0] > 0.5]).any()


def test_points_are_spread_by_area() -> None:
    """A sphere's height is evenly distributed (Archimedes)."""
    heights = SurfacePoints.spread(globe(), 20_000).points[:, 2]
    share, _ = np.histogram(heights, 10, (-1, 1))
    np.testing.assert_allclose(share / 20_000, 0.1, atol=0.01)


def test_frames_show_the_near_side_without_gaps() -> None:
    """Each panel is a disc; the first frame looks along −X, so that its middle shows normals near +X."""
    points = SurfacePoints.spread(globe(confidence=True), 20_000)
    panels = turning_panels(points, None)
    frames = turning_frames(points, panels, frames=4, side=100)
    assert [frame.shape for frame in frames] == [(100, 200, 3)] * 4
    rows, columns = np.mgrid[:100, :100] - 49.5
    disc = np.hypot(rows, columns) < 44
    first = frames[0][:, :100].astype(float) / 255 * 2 - 1
    assert (first[disc] @ np.array([np.cos(np.radians(20)), 0, np.sin(np.radians(20))]) > -0.1).all()
    assert (frames[0][:10, :10] == frames[0][0, 0]).all()
