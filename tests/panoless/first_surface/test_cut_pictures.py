"""Pictures that cut the object carve nothing away beyond their borders, and every kind of geometry starts on them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.masks import cut_sides
from panoless.capture.silhouettes import mask_contours
from panoless.capture.views import TrainView, Views, cropped, views_of
from panoless.first_surface.completion import complete_surface, hull_surface
from panoless.first_surface.mesh import TriangleMesh
from panoless.first_surface.options import FirstSurfaceOptions
from panoless.first_surface.visual_hull import HULL_HALF_SIDE, Hull, carve_hull
from panoless.geometry.plane.fit import fit_plane
from panoless.geometry.revolution.fit import propose_revolution
from panoless.kernels.camera import RasterCamera
from panoless.splats.options import SurfelConfig
from panoless.splats.placement import initial_surfels
from shinypartial.core.camera import Camera
from tests.panoless.first_surface.test_visual_hull import RADIUS, RESOLUTION, SIDE, VOXEL, all_around, deviation
from tests.support.synthetic_dataset import render_sphere, sphere_cameras

__all__ = ["all_around"]


def cut(view: TrainView, side: int, at: int) -> TrainView:
    """The picture as if it began, or ended, at that line: side 0 is left, 1 top, 2 right, 3 bottom."""
    kept = (np.s_[:, at:], np.s_[at:], np.s_[:, :at], np.s_[:at])[side]
    camera, mask = view.camera, view.mask[kept]
    height, width = mask.shape
    shifted = RasterCamera(
        camera.world_to_camera,
        camera.fx,
        camera.fy,
        camera.cx - at * (side == 0),
        camera.cy - at * (side == 1),
        width,
        height,
        camera.near,
        camera.far,
    )
    return TrainView(
        shifted, view.radiance[:, *kept] if side in (0, 2) else view.radiance[:, kept], mask, view.solid[:0]
    )


def cut_through(views: Views, every: int) -> Views:
    """The views, every k-th of them cut through the middle of the object, on one side after the other."""
    train = list(views.train)
    for turn, index in enumerate(range(0, len(train), every)):
        train[index] = cut(train[index], turn % 4, SIDE // 2 + (turn % 5 - 2))
        assert sum(cut_sides(train[index].mask.numpy())) == 1
    return replace(views, train=tuple(train))


def volume(hull: Hull) -> float:
    return float((hull.distance < 0).sum()) * hull.voxel**3


def mean_deviation(surface: TriangleMesh) -> float:
    return float(np.abs(deviation(surface.vertices)).mean())


@pytest.mark.parametrize("every", [10, 3])
def test_the_hull_of_cut_views_is_nearly_that_of_whole_ones(all_around: Views, every: int) -> None:
    """Its volume is no smaller and at most 3 % larger, though all views have to agree; half of it went before."""
    whole, kept = (carve_hull(views, RESOLUTION, votes=1.0) for views in (all_around, cut_through(all_around, every)))
    assert volume(whole) <= volume(kept) < 1.03 * volume(whole)
    assert deviation(hull_surface(kept).vertices).min() > -0.1 * VOXEL
    first, second = (complete_surface(whole, all_around), complete_surface(kept, cut_through(all_around, every)))
    assert mean_deviation(second) < mean_deviation(first) + 0.2 * VOXEL


def test_without_any_view_of_one_side_the_hull_goes_on_there(all_around: Views) -> None:
    """All pictures end at the sphere's waist: above it the hull is the sphere, below it what the cube allows."""
    level = tuple(view for view in all_around.train if abs(view.position[2]) < 1)
    waist = replace(all_around, train=tuple(cut(view, 3, SIDE // 2) for view in level))
    surface = hull_surface(carve_hull(waist, 32, votes=1.0)).vertices
    assert surface[:, 2].min() < -HULL_HALF_SIDE + 0.2
    assert RADIUS - 0.1 < surface[:, 2].max() < RADIUS + 0.2


def test_a_cube_for_a_long_object_is_larger_with_the_same_voxels(all_around: Views) -> None:
    """The unit ball of a median mask a third as large: the usual cube would cut the sphere."""
    small = 0.3

    def shrunk(view: TrainView) -> TrainView:
        matrix = view.camera.world_to_camera.clone()
        matrix[:3, 3] /= small
        return replace(view, camera=replace(view.camera, world_to_camera=matrix))

    frame = replace(all_around.object_frame, reach=0.75 / small)
    views = Views(tuple(shrunk(view) for view in all_around.train), frame, 0.1 / small)
    hull = carve_hull(views, 24, votes=1.0)
    assert hull.voxel == pytest.approx(2 * HULL_HALF_SIDE / 23, rel=0.1)
    assert deviation(small * hull_surface(hull).vertices).min() > -0.2 * small * hull.voxel
    cube = carve_hull(replace(views, object_frame=replace(frame, reach=1.0)), 24, votes=1.0)
    assert deviation(small * hull_surface(cube).vertices).min() < -0.1


def photographs_cut_through(every: int) -> Views:
    """The mirror sphere of the test data in 14 photographs, every k-th of which shows one half of it."""
    photographs = []
    for index, camera in enumerate(sphere_cameras("train", 14, 48)):
        view, margin = render_sphere(camera), 3
        radiance, alpha = np.clip(view.radiance, 0, 1), view.alpha
        if index % every == 0:
            radiance, alpha = radiance[:, 24:], alpha[:, 24:]
            camera = Camera(camera.camera_to_world, camera.fx, camera.fy, camera.cx - 24, camera.cy, 24, 48)
        photographs.append(cropped(camera, radiance, alpha, margin))
    return views_of(photographs)


@pytest.mark.parametrize("every", [4, 1])
def test_every_kind_of_geometry_can_start_on_cut_views(every: int) -> None:
    """Whether or not it is proposed in the end; surfels lie on the sphere unless no view shows its other half."""
    views = photographs_cut_through(every)
    assert views.object_frame.radius == pytest.approx(1.1, rel=0.1)
    assert np.linalg.norm(views.object_frame.center) < 0.1
    assert set(mask_contours(views).view) == set(range(14))
    assert np.isfinite(fit_plane(views, thorough=False).plane.offset)
    surface = propose_revolution(views)
    assert surface is None or np.isfinite(surface.surface.profile).all()
    surfels = initial_surfels(views, SurfelConfig(count=300), 0, FirstSurfaceOptions(hull_resolution=40))
    points = surfels.means.double().numpy() * views.object_frame.radius + views.object_frame.center
    assert torch.isfinite(surfels.means).all()
    assert every == 1 or np.median(np.abs(np.linalg.norm(points[points[:, 0] > 0.3], axis=1) - 1)) < 0.05
