"""One plane from silhouettes: coverage is area, depth lies on the plane, and silhouettes alone give the normal."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from matplotlib.path import Path as PolygonPath

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import pose_of, unit_rays_camera
from panoless.capture.silhouettes import mask_contours
from panoless.capture.views import Views
from panoless.geometry.plane.fit import MAX_VERTICES, PlaneFit, _descend, fit_plane
from panoless.geometry.plane.model import Plane, plane_buffers, unoccluded_share
from panoless.geometry.plane.silhouette import apply_plane_step, boundary_residuals
from shinypartial.core.errors import InputError
from tests.support.mirror_plane import (
    L_SHAPE,
    NORMAL,
    RECTANGLE,
    SIZE_PX,
    arc,
    camera_at,
    mirror_views,
    plane_of,
    seen,
    train_view,
)


def angle_deg(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@pytest.mark.parametrize("frame_height", [0.0, 0.15])
def test_buffers_are_those_of_the_plane(frame_height: float) -> None:
    """Alpha as traced; n·x = d at every depth; one normal, unit over alpha, against the ray; nothing elsewhere."""
    plane, camera = plane_of(L_SHAPE, frame_height), arc(5)[0]
    buffers = plane_buffers(plane, camera)
    fine = seen(plane, camera, 16).reshape(SIZE_PX, 16, SIZE_PX, 16).mean((1, 3))
    difference = np.abs(buffers.alpha.numpy() - fine)
    # With a frame, pixels that both silhouettes cut are approximate; where the two silhouettes cross there are a few.
    assert np.quantile(difference, 0.999) < 0.05
    assert difference.max() < (0.05 if frame_height == 0 else 0.3)
    rotation, center = pose_of(camera)
    row, column = np.nonzero(buffers.alpha.numpy() == 1)
    z = buffers.depth.numpy()[row, column].astype(np.float64)
    rays = np.stack([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, np.ones(len(row))], 1)
    np.testing.assert_allclose((center + z[:, None] * rays @ rotation) @ plane.normal, plane.offset, atol=1e-5)
    normals = buffers.normals_camera.numpy()[:, row, column].T
    np.testing.assert_allclose(normals @ rotation, np.tile(plane.normal, (len(row), 1)), atol=1e-5)
    assert ((normals * rays).sum(1) < 0).all()
    nothing = buffers.alpha == 0
    for image in (
        buffers.depth,
        buffers.normals_camera[0],
    ):
        assert (image[nothing] == 0).all()


def test_a_mirror_has_no_back() -> None:
    behind = camera_at(-3.0 * NORMAL)
    buffers = plane_buffers(plane_of(RECTANGLE), behind)
    assert not buffers.alpha.any()
    assert not buffers.depth.any()


def test_a_plane_that_reaches_behind_the_camera_ends_at_the_horizon() -> None:
    """A floor without end below a camera that looks level fills the picture's lower half."""
    frame = (np.array([0.0, 0.0, 1.0]), -0.5, np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    floor = Plane(*frame, 1e6 * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]))
    level = replace(camera_at(np.array([0.0, -3.0, 0.0]), 20), near=0.01)
    alpha = plane_buffers(floor, level).alpha.numpy()
    np.testing.assert_allclose(alpha[:10], 0, atol=1e-3)
    # The nearest row of pixels would have to see beyond the near plane only if it looked steeply down.
    np.testing.assert_allclose(alpha[10:], 1, atol=1e-3)


@pytest.fixture(scope="module")
def flat_fit() -> PlaneFit:
    return fit_plane(mirror_views(plane_of(L_SHAPE), arc(12)))


def test_silhouettes_give_the_normal(flat_fit: PlaneFit) -> None:
    """From masks alone, with pixels of 0.023 units, 23° between the mean view and the normal."""
    plane = flat_fit.plane
    assert angle_deg(plane.normal, NORMAL) < 0.1
    assert plane.offset == pytest.approx(0.07, abs=1e-3)
    np.testing.assert_allclose(np.cross(plane.tangent_u, plane.tangent_v), plane.normal, atol=1e-9)
    assert plane.frame_height == 0
    assert float(np.median(flat_fit.median_px)) < 0.1
    assert float(flat_fit.iou.min()) > 0.995


def test_the_silhouette_is_that_of_the_mirror(flat_fit: PlaneFit) -> None:
    """The L's six corners and no others, each within a tenth of a pixel."""
    found, true = (p.points(p.boundary) for p in (flat_fit.plane, plane_of(L_SHAPE)))
    gaps = np.linalg.norm(found[:, None] - true[None], axis=-1)
    assert len(found) == len(true)
    assert gaps.min(0).max() < 0.005


def test_the_stated_uncertainty_is_that_of_the_error() -> None:
    """Over mirrors shifted against the pixels, the error in units of its stated deviation is neither huge nor nil."""
    ratios = []
    for shift in (0.0, 0.013, 0.031, -0.017):
        fit = fit_plane(mirror_views(plane_of(RECTANGLE + shift), arc(9)))
        ratios.append(angle_deg(fit.plane.normal, NORMAL) / fit.normal_sigma_deg)
    assert max(ratios) < 4
    assert np.sqrt(np.mean(np.square(ratios))) > 0.1


@pytest.mark.parametrize("frame_height", [0.06, 0.15])
def test_a_frame_that_hides_part_of_the_mirror_does_not_tilt_it(frame_height: float) -> None:
    """All cameras stand beyond some side of the mirror, so that its frame hides that side in most views."""
    fit = fit_plane(mirror_views(plane_of(RECTANGLE, frame_height), arc(12)))
    assert angle_deg(fit.plane.normal, NORMAL) < 0.1
    assert fit.plane.frame_height == pytest.approx(frame_height, rel=0.05)
    assert float(fit.iou.min()) > 0.99
    assert float(fit_plane_iou(replace(fit.plane, frame_height=0.0), frame_height).mean()) < 0.98


def fit_plane_iou(plane: Plane, frame_height: float) -> Float[np.ndarray, "V"]:
    """Overlap of a plane's alpha with the masks of the framed mirror."""
    result = []
    for view in mirror_views(plane_of(RECTANGLE, frame_height), arc(12)).train:
        alpha = plane_buffers(plane, view.camera).alpha
        result.append(float(alpha.minimum(view.mask).sum() / alpha.maximum(view.mask).sum()))
    return np.array(result)


def test_rays_that_meet_the_frame_are_known() -> None:
    """A pixel is unobstructed if the mirrored ray, followed from the mirror to the height of the frame, is inside
    it.
    """
    plane, camera = plane_of(RECTANGLE, 0.15), arc(12)[0]
    rotation, center = pose_of(camera)
    covered = plane_buffers(plane, camera).alpha == 1
    row, column = np.nonzero(covered.numpy())
    rays = np.stack([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, np.ones(len(row))], 1)
    rays = rays @ rotation
    hit = center + ((plane.offset - center @ NORMAL) / (rays @ NORMAL))[:, None] * rays
    reflect = rays - 2 * (rays @ NORMAL)[:, None] * NORMAL
    leaving = hit + (plane.frame_height / (reflect @ NORMAL))[:, None] * reflect
    passes = PolygonPath(RECTANGLE).contains_points(np.stack([leaving @ plane.tangent_u, leaving @ plane.tangent_v], 1))
    share = unoccluded_share(plane, camera)[covered].numpy()
    assert 0.02 < 1 - passes.mean() < 0.5
    assert passes[share > 0.999].all()
    assert not passes[share < 0.001].any()
    # What is left are the pixels along two sides of the frame's image, out of a mirror some forty pixels wide.
    assert ((share > 0.001) & (share < 0.999)).mean() < 0.1
    assert (unoccluded_share(replace(plane, frame_height=0.0), camera) == 1).all()


def test_wrong_poses_do_not_bias_the_normal() -> None:
    """Each camera turned by 0.3° about a random axis, half a pixel; the error stays near the stated deviation."""
    generator = np.random.default_rng(2)
    views, turned = mirror_views(plane_of(RECTANGLE), arc(24)), []
    for view in views.train:
        x, y, z = np.radians(0.3) * generator.normal(size=3) / np.sqrt(3)
        turn = torch.eye(4)
        turn[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])).float()
        camera = replace(view.camera, world_to_camera=turn @ view.camera.world_to_camera)
        turned.append(replace(view, camera=camera))
    fit = fit_plane(replace(views, train=tuple(turned)))
    assert angle_deg(fit.plane.normal, NORMAL) < 0.5
    assert angle_deg(fit.plane.normal, NORMAL) < 5 * fit.normal_sigma_deg
    assert float(np.median(fit.median_px)) > 0.1


def test_a_round_mirror_needs_only_so_many_vertices() -> None:
    angles = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    fit = fit_plane(mirror_views(plane_of(np.stack([0.6 * np.cos(angles), 0.5 * np.sin(angles)], 1)), arc(12)))
    assert len(fit.plane.boundary) <= MAX_VERTICES
    assert angle_deg(fit.plane.normal, NORMAL) < 0.2
    assert float(fit.iou.min()) > 0.99


def test_a_sphere_is_no_plane(views: Views, flat_fit: PlaneFit) -> None:
    """Its silhouettes are circles from everywhere, which no plane carries into each other."""
    fit = fit_plane(views)
    assert float(np.median(fit.median_px)) > 5 * float(np.median(flat_fit.median_px))
    assert float(fit.iou.mean()) < 0.95
    assert all(np.isfinite(value).all() for value in (fit.plane.normal, fit.plane.boundary, fit.median_px))


def test_giving_up_early_changes_no_plane(flat_fit: PlaneFit) -> None:
    """A ball is left after the first round, pixels away from any boundary; a plane is found to the last bit."""
    balls = []
    for camera in arc(12, half_angle_deg=60.0, size=128):
        rotation, center = pose_of(camera)
        across = np.cross(rotation @ -center, unit_rays_camera(camera).numpy(), axisb=0)
        balls.append(train_view(camera, (np.linalg.norm(across, axis=-1) < 0.8).astype(np.float64)))
    given_up = fit_plane(Views(tuple(balls), ObjectFrame(np.zeros(3), 1.0), 0.3), thorough=False)
    assert np.isinf(given_up.normal_sigma_deg)
    assert float(np.median(given_up.median_px)) > 2.0
    quick = fit_plane(mirror_views(plane_of(L_SHAPE), arc(12)), thorough=False)
    np.testing.assert_array_equal(quick.plane.normal, flat_fit.plane.normal)
    np.testing.assert_array_equal(quick.plane.boundary, flat_fit.plane.boundary)


@pytest.mark.parametrize("tilt_deg", [2.0, 40.0])
def test_no_step_raises_the_cost_that_it_minimizes(tilt_deg: float) -> None:
    """At the robust scale, and over the points, of where the step starts."""
    contours, true = mask_contours(mirror_views(plane_of(L_SHAPE), arc(8))), plane_of(L_SHAPE)
    plane = apply_plane_step(true, np.append([np.tan(np.radians(tilt_deg)), 0, 0.1, 0], np.zeros(true.boundary.size)))
    medians = []
    for _ in range(8):
        before = boundary_residuals(contours, plane)
        scale = before.scale(2.0)
        plane = _descend(contours, plane, (2.0,))
        after = boundary_residuals(contours, plane)
        assert after.cost(scale, before.counted) <= before.cost(scale, before.counted)
        medians.append(np.median(np.abs(after.pixels)))
    assert medians[-1] < medians[0] / 2


def test_views_from_behind_are_not_explained() -> None:
    front, behind = arc(8), camera_at(-3.0 * NORMAL)
    ghost = mirror_views(plane_of(RECTANGLE), [camera_at(3.0 * NORMAL)]).train[0]
    views = mirror_views(plane_of(RECTANGLE), front)
    fit = fit_plane(replace(views, train=(*views.train, train_view(behind, ghost.mask.numpy().astype(np.float64)))))
    assert angle_deg(fit.plane.normal, NORMAL) < 0.2
    assert fit.iou[-1] == 0
    assert np.isinf(fit.median_px[-1])
    assert np.isfinite(fit.median_px[:-1]).all()


def test_three_distinct_views_are_needed() -> None:
    plane, cameras = plane_of(L_SHAPE), arc(3)
    assert angle_deg(fit_plane(mirror_views(plane, cameras)).plane.normal, NORMAL) < 1.0
    views = mirror_views(plane, cameras[:2])
    everywhere = train_view(cameras[2], np.ones((SIZE_PX, SIZE_PX)))
    for train in (views.train, views.train[:1] * 9, (*views.train, everywhere), (everywhere,) * 3):
        with pytest.raises(InputError, match="at least 3 distinct places"):
            fit_plane(replace(views, train=train))
