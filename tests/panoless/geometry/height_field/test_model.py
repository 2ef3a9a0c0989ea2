"""A bent mirror: where rays meet it, what a camera sees of it, and surfels that follow from it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float

from panoless.capture.rays import pixel_rays, reflect
from panoless.config import FitConfig
from panoless.geometry.height_field.kind import HeightFieldMirror
from panoless.geometry.height_field.model import (
    HeightField,
    edge_points,
    flat_height_field,
    height_field_buffers,
    visible_reflections,
)
from panoless.geometry.plane.kind import PlaneMirror
from panoless.geometry.plane.model import plane_buffers, unoccluded_share
from panoless.splats.kernels.reference.rasterize import rotation_matrices
from panoless.splats.model import Surfels
from panoless.splats.options import SurfelConfig
from tests.support.mirror_height_field import bumpy
from tests.support.mirror_plane import L_SHAPE, NORMAL, RECTANGLE, arc, mirror_views, plane_of, train_view

CONFIG = replace(FitConfig(), splats=replace(FitConfig().splats, surfels=SurfelConfig(count=300)))
PLANE = plane_of(RECTANGLE)


def normals_of(surfels: Surfels) -> Float[np.ndarray, "K 3"]:
    return rotation_matrices(surfels.quats)[:, :, 2].numpy().astype(np.float64)


def coordinates_of(points: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 2"]:
    return points @ np.stack([PLANE.tangent_u, PLANE.tangent_v], 1)


def parabolic(cells: int, bend: Float[np.ndarray, "2 2"]) -> HeightField:
    """h = ½ pᵀ bend p: a cubic B-spline of a quadratic is its value less spacing²/6 of each bend."""
    height_field = flat_height_field(PLANE, cells)
    rows, columns = height_field.coefficients.shape
    u = height_field.low[0] + height_field.spacing * (np.arange(rows) - 1)
    v = height_field.low[1] + height_field.spacing * (np.arange(columns) - 1)
    height = (bend[0, 0] * u[:, None] ** 2 + bend[1, 1] * v**2) / 2 + bend[0, 1] * u[:, None] * v
    return replace(height_field, coefficients=height - np.trace(bend) * height_field.spacing**2 / 6)


def test_a_quadratic_has_its_heights_slopes_and_bends() -> None:
    bend = np.array([[0.1, 0.03], [0.03, -0.08]])
    p = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    h, h_u, h_v, *bends = parabolic(8, bend).heights(p)
    assert np.allclose(h, (p @ bend * p).sum(1) / 2, atol=1e-12)
    assert np.allclose(np.stack([h_u, h_v], 1), p @ bend, atol=1e-12)
    assert np.allclose(np.stack(bends, 1), [0.1, 0.03, -0.08], atol=1e-12)


def test_rays_end_on_the_surface_with_its_normal() -> None:
    height_field, camera = bumpy(PLANE, 0.02), arc(5)[1]
    pixels = np.flatnonzero(height_field_buffers(height_field, camera).alpha.numpy() > 0.5)
    origins, directions = pixel_rays(camera, pixels)
    hits = height_field.hits(origins, directions)
    points = origins + hits.distance[:, None] * directions
    h, h_u, h_v, *_ = height_field.heights(coordinates_of(points))
    assert hits.met.all()
    assert np.allclose(points @ NORMAL - PLANE.offset, h, atol=1e-9)
    assert np.allclose(hits.places, coordinates_of(points), atol=1e-9)
    expected = NORMAL - h_u[:, None] * PLANE.tangent_u - h_v[:, None] * PLANE.tangent_v
    assert np.allclose(
        hits.normals @ height_field.frame, expected / np.linalg.norm(expected, axis=1)[:, None], atol=1e-8
    )


def test_beyond_its_knots_a_height_field_goes_on_straight() -> None:
    """A tilted plane is met where a plane is, however far out; its back and what runs along it never."""
    slope = np.array([0.03, -0.02])
    tilted = flat_height_field(PLANE, 8)
    rows, columns = (np.arange(count) - 1.0 for count in tilted.coefficients.shape)
    places = np.stack(np.meshgrid(rows, columns, indexing="ij"), -1) * tilted.spacing + tilted.low
    tilted = replace(tilted, coefficients=places @ slope)
    normal = NORMAL - slope[0] * PLANE.tangent_u - slope[1] * PLANE.tangent_v
    ends = PLANE.points(np.array([[5.0, -4.0], [-3.0, 0.1], [0.2, 0.1]]))
    origins = np.tile(4 * NORMAL, (3, 1))
    hits = tilted.hits(origins, ends - origins)
    points = origins + hits.distance[:, None] * (ends - origins)
    assert np.allclose(points @ normal, PLANE.offset, atol=1e-9)
    assert not tilted.hits(-origins, ends + origins).met.any()
    assert not tilted.hits(origins, np.tile(PLANE.tangent_u, (3, 1))).met.any()


@pytest.mark.parametrize("frame_height", [0.0, 0.1])
@pytest.mark.parametrize("boundary", [RECTANGLE, L_SHAPE], ids=["rectangle", "L"])
def test_without_height_it_is_seen_as_its_plane(boundary: np.ndarray, frame_height: float) -> None:
    plane = plane_of(boundary, frame_height)
    for camera in arc(3):
        flat, expected = height_field_buffers(flat_height_field(plane, 6), camera), plane_buffers(plane, camera)
        assert torch.allclose(flat.alpha, expected.alpha, atol=1e-5)
        inside = expected.alpha > 0.99
        assert torch.allclose(flat.depth[inside], expected.depth[inside], atol=1e-5)
        assert torch.allclose(flat.normals_camera, expected.normals_camera, atol=1e-5)


def test_its_edge_bounds_what_is_seen() -> None:
    """Every point of the edge in space lies on the contour of the coverage, within the size of a pixel."""
    height_field, camera = bumpy(PLANE, 0.03), arc(5)[4]
    matrix = camera.world_to_camera.double().numpy()
    seen = edge_points(height_field) @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = seen[:, :2] / seen[:, 2:] * camera.fx + [camera.cx, camera.cy]
    alpha = height_field_buffers(height_field, camera).alpha.numpy()
    for column, row in np.floor(pixels).astype(int):
        around = alpha[row - 1 : row + 2, column - 1 : column + 2]
        assert around.min() < 0.5 < around.max()


def test_mirrored_rays_that_meet_the_rim_are_left_out() -> None:
    """For a flat mirror these are the pixels in which the plane sees its frame from within; the margin is a pixel of a
    mean depth, so a tenth of one may be missing.
    """
    plane = plane_of(RECTANGLE, frame_height=0.1)
    height_field = flat_height_field(plane, 6)
    for view in mirror_views(plane, arc(3)).train:
        share = unoccluded_share(plane, view.camera).flatten()[view.solid]
        kept = torch.isin(view.solid, visible_reflections(height_field, view, view.solid).pixels)
        assert (share[kept] > 0.9).all()
        assert kept.sum() > 0.95 * (share > 0.99).sum() - view.camera.width - view.camera.height
        assert (share < 0.5).any()


def test_the_map_leaves_out_as_wide_a_margin_at_the_rim_as_the_fit() -> None:
    """Of 1 px; one of 4 px leaves less."""
    plane = plane_of(RECTANGLE, frame_height=0.1)
    height_field, view = flat_height_field(plane, 6), mirror_views(plane, arc(1)).train[0]
    fitted = visible_reflections(height_field, view, view.solid).pixels
    mirror = HeightFieldMirror(height_field)
    assert torch.equal(mirror.usable_pixels(view), fitted)
    assert torch.equal(mirror.seen(view, view.solid)[0], fitted)
    assert len(visible_reflections(height_field, view, view.solid, clear_px=4.0).pixels) < len(fitted)


def test_where_no_frame_stands_out_every_solid_pixel_is_seen_along_the_mirrored_ray() -> None:
    height_field, camera = bumpy(PLANE, 0.01), arc(3)[0]
    view = train_view(camera, height_field_buffers(height_field, camera).alpha.double().numpy())
    found = visible_reflections(height_field, view, view.solid)
    assert torch.equal(found.pixels, view.solid)
    normals = found.hits.normals @ height_field.frame
    assert np.allclose(found.outgoing, unit(reflect(pixel_rays(camera, view.solid.numpy())[1], normals)), atol=1e-9)


def unit(vectors: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_only_planes_do_not_bend() -> None:
    """The energy of a tilt is zero; that of h = ½ κ u² is κ² spacing⁴ for each interior coefficient."""
    curved, rows = parabolic(8, np.diag([0.2, 0.0])), flat_height_field(PLANE, 8).coefficients.shape
    energy = curved.coefficients.ravel() @ curved.bending() @ curved.coefficients.ravel()
    assert energy == pytest.approx((rows[0] - 2) * rows[1] * 0.2**2 * curved.spacing**4)
    tilt = np.add.outer(0.3 * np.arange(rows[0]), -0.2 * np.arange(rows[1])).ravel()
    assert abs(tilt @ curved.bending() @ tilt) < 1e-12


def test_the_mesh_lies_on_the_height_field_within_the_silhouette() -> None:
    height_field = bumpy(plane_of(L_SHAPE), 0.02)
    points, faces = height_field.quadrilaterals()
    assert np.allclose(points @ NORMAL - height_field.plane.offset, height_field.heights(coordinates_of(points))[0])
    corners = coordinates_of(points)[faces]
    across, up = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    area = (across[:, 0] * up[:, 1] - across[:, 1] * up[:, 0]).sum()
    assert area == pytest.approx(1.2 * 1.0 - 0.6 * 0.4, rel=0.1)


@pytest.mark.parametrize("mirror", [PlaneMirror(PLANE), HeightFieldMirror(bumpy(PLANE, 0.02))])
def test_an_area_is_what_four_pixels_of_half_the_width_see(mirror: PlaneMirror | HeightFieldMirror) -> None:
    """In row-major order, and only where a camera with twice as many pixels sees the surroundings in all four."""
    camera = arc(3)[1]
    fine = replace(
        camera,
        **{name: 2 * getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")},
    )
    coarse_view, fine_view = (train_view(each, mirror.buffers(each).alpha.double().numpy()) for each in (camera, fine))
    numbered = torch.arange(coarse_view.mask.numel()).reshape(1, *coarse_view.mask.shape).expand(3, -1, -1).float()
    views = replace(mirror_views(PLANE, [camera]), train=(replace(coarse_view, radiance=numbered),))
    areas = mirror.footprints(views, 10**6)
    assert areas is not None
    pixels = areas.smooth[0].radiance[:, 0].long()
    assert len(pixels) > 0.9 * len(coarse_view.solid)
    row, column = pixels // camera.width, pixels % camera.width
    quarters = torch.stack([(2 * row + down) * fine.width + 2 * column + right for down in (0, 1) for right in (0, 1)])
    for index, quarter in enumerate(quarters):
        seen = mirror.observe(fine_view, quarter)
        torch.testing.assert_close(areas.smooth[0].directions[:, index], seen.directions, rtol=0, atol=2e-6)
