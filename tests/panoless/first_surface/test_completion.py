"""The first surface is the object's own where silhouettes touch it, and bends no more than it must where none does."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.views import TrainView, Views
from panoless.first_surface.completion import complete_surface, completed, hull_surface, thin_plate, trusted_hull
from panoless.first_surface.contact import Contact, silhouette_contact
from panoless.first_surface.mesh import TriangleMesh
from panoless.first_surface.options import FirstSurfaceOptions
from panoless.first_surface.visual_hull import HULL_HALF_SIDE, Hull, carve_hull
from panoless.splats.options import SurfelConfig
from panoless.splats.placement import initial_surfels
from shinypartial.core.errors import InputError

CONFIG = SurfelConfig(count=800)
VOXEL = 2 * HULL_HALF_SIDE / 47


def square(divisions: int, height: np.ndarray | float = 0.0) -> TriangleMesh:
    """The unit square in divisions² squares, cut along alternating diagonals."""
    line = np.linspace(0, 1, divisions + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(line, line, indexing="ij"))
    rows = divisions + 1
    faces = []
    for i in range(divisions):
        for j in range(divisions):
            a, b, c, d = i * rows + j, (i + 1) * rows + j, (i + 1) * rows + j + 1, i * rows + j + 1
            faces += [(a, b, c), (a, c, d)] if (i + j) % 2 else [(a, b, d), (b, c, d)]
    return TriangleMesh(np.stack([x, y, np.broadcast_to(height, x.shape)], 1), np.array(faces))


def sphere_of(views: Views) -> tuple[np.ndarray, float]:
    """Center and radius of the unit sphere of the test data, in the normalized frame."""
    return -views.object_frame.center / views.object_frame.radius, 1 / views.object_frame.radius


def masked(view: TrainView, pixel: tuple[int, int] | None) -> TrainView:
    """A view whose mask is one pixel, or nothing."""
    mask = torch.zeros_like(view.mask)
    if pixel is not None:
        mask[pixel] = 1
    return replace(view, mask=mask)


def test_masks_that_contradict_each_other_leave_no_hull(views: Views) -> None:
    corners = tuple(masked(view, (0, 0) if i % 2 else (-1, -1)) for i, view in enumerate(views.train))
    with pytest.raises(InputError, match="no point in space"):
        initial_surfels(replace(views, train=corners), CONFIG, 0, FirstSurfaceOptions(hull_resolution=48))


def test_a_vote_forgives_one_wrong_mask(views: Views) -> None:
    damaged = replace(views, train=(masked(views.train[0], None), *views.train[1:]))
    whole = carve_hull(views, 32, votes=1.0).distance < 0
    forgiving = carve_hull(damaged, 32, votes=0.9).distance < 0
    assert whole.any()
    assert forgiving[whole].all()
    with pytest.raises(InputError, match="100% of the masks"):
        carve_hull(damaged, 32, votes=1.0)


def test_the_hull_is_a_signed_distance(views: Views) -> None:
    hull = carve_hull(views, 48, votes=1.0)
    points = np.stack(np.meshgrid(*[np.linspace(-HULL_HALF_SIDE, HULL_HALF_SIDE, 48)] * 3, indexing="ij"), -1)
    center = -views.object_frame.center / views.object_frame.radius
    truth = np.linalg.norm(points - center, axis=-1) - 1 / views.object_frame.radius
    # Along +X, where cameras bound the hull.
    line = truth[24:, 23:25, 23:25]
    np.testing.assert_allclose(hull.distance[24:, 23:25, 23:25], line, atol=3 * VOXEL)


def test_a_plate_through_trusted_borders_is_the_plane_whatever_lay_between() -> None:
    """Bending energy is zero for a plane only, so a roof between two flat strips goes."""
    flat = square(24)
    x = flat.vertices[:, 0]
    roof = replace(flat, vertices=flat.vertices + np.outer(np.maximum(0.25 - np.abs(x - 0.5), 0), [0, 0, 1]))
    trust = ((x < 0.2) | (x > 0.8)).astype(float) + 1e-7
    assert np.abs(roof.vertices[:, 2]).max() == pytest.approx(0.25)
    assert np.abs(thin_plate(roof, trust, 0.02).vertices[:, 2]).max() < 1e-3


def test_a_plate_continues_position_and_slope() -> None:
    """Across a gap of 30° in a cylinder the middle stays within a thousandth of the radius; the chord is 34 off."""
    flat = square(48)
    angle = np.radians(60) * (flat.vertices[:, 0] - 0.5)
    cylinder = replace(flat, vertices=np.stack([np.sin(angle), flat.vertices[:, 1], np.cos(angle)], 1))
    gap = np.abs(angle) < np.radians(15)
    bulged = replace(cylinder, vertices=cylinder.vertices + np.outer(gap * 0.03, [0, 0, 1]))
    plate = thin_plate(bulged, (~gap) + 1e-7, 0.01).vertices
    inner = gap & (np.abs(flat.vertices[:, 1] - 0.5) < 0.3)
    radius = np.hypot(plate[inner, 0], plate[inner, 2])
    assert np.abs(radius - 1).max() < 0.004
    assert np.abs(np.hypot(*bulged.vertices[inner][:, [0, 2]].T) - 1).max() > 0.02


def test_a_trusted_surface_stays() -> None:
    wavy = square(30)
    wavy = replace(wavy, vertices=wavy.vertices + np.outer(0.02 * np.sin(6 * wavy.vertices[:, 0]), [0, 0, 1]))
    plate = thin_plate(wavy, np.ones(len(wavy.vertices)), 0.01)
    inner = (np.abs(wavy.vertices[:, :2] - 0.5) < 0.45).all(1)
    assert np.abs(plate.vertices - wavy.vertices)[inner].max() < 1e-4


def test_shape_tensors_of_a_sphere_turn_the_normal_by_the_step_over_the_radius(views: Views) -> None:
    hull = hull_surface(carve_hull(views, 48, votes=1.0))
    center, radius = sphere_of(views)
    outward = hull.vertices - center
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    exact = TriangleMesh(center + radius * outward, hull.triangles)
    expected = (np.eye(3) - outward[:, :, None] * outward[:, None, :]) / radius
    assert np.median(np.abs(exact.shape_tensors() - expected).max((1, 2))) < 0.05 / radius


def test_the_offset_of_a_contact_is_the_distance_from_the_rim(views: Views) -> None:
    """In front, the hull of the sphere is a wedge between the cones of the two cameras that stand furthest out."""
    center, radius = sphere_of(views)
    surface = hull_surface(carve_hull(views, 48, votes=1.0))
    contact = silhouette_contact(surface, views)
    offset = surface.vertices - center
    azimuth, level = np.arctan2(offset[:, 1], offset[:, 0]), np.abs(offset[:, 2]) < 0.2 * radius
    last = max(np.arctan2(*(view.position - center)[[1, 0]]) for view in views.train)
    distance = np.linalg.norm(views.train[0].position - center)
    rim = last - np.arccos(radius / distance)
    edge, touched = level & (np.abs(azimuth) < 0.05), level & (np.abs(azimuth) > -rim + 0.25) & (np.abs(azimuth) < 1)
    assert edge.sum() > 3
    assert np.median(contact.offset[edge]) == pytest.approx(radius * np.tan(-rim), rel=0.2)
    assert np.median(contact.offset[touched]) < 0.25 * radius * np.tan(-rim)
    assert np.median(contact.margin[touched]) < VOXEL


def test_trust_falls_with_the_distance_from_rim_and_cone() -> None:
    trust = Contact(margin=np.array([0.0, 0.0, 0.03, 0.2]), offset=np.array([0.0, 0.03, 0.0, 0.0])).trust(0.02)
    assert trust[0] == 1
    assert 0 < trust[1] < 0.5
    assert 0 < trust[2] < 0.5
    assert trust[3] == 0


def test_the_completed_surface_has_the_normals_of_the_sphere_where_no_silhouette_touches_it(views: Views) -> None:
    """In front, between the rims of the first and the last camera, those of the hull are off by degrees."""
    hull = carve_hull(views, 48, votes=1.0)
    center, _ = sphere_of(views)
    errors = []
    for surface in (hull_surface(hull), complete_surface(hull, views)):
        outward = surface.vertices - center
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        front = outward[:, 0] > 0.95
        cosine = (outward * surface.vertex_normals()).sum(1)[front]
        errors.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())
    assert errors[1] < 0.5 * errors[0]


def test_a_taut_plate_is_flat_where_a_loose_one_bulges() -> None:
    """Beside two sloping strips a plate goes on with their slope; under tension it is straight between them."""
    flat = square(24)
    x = flat.vertices[:, 0]
    sloping = replace(flat, vertices=flat.vertices + np.outer(np.minimum(np.minimum(x, 1 - x), 0.25), [0, 0, 1]))
    trust = ((x < 0.2) | (x > 0.8)).astype(float) + 1e-7
    middle = np.abs(x - 0.5) < 1e-9
    loose, taut = (thin_plate(sloping, trust, 0.02, tension=tension).vertices[middle, 2] for tension in (0.0, 1e3))
    assert loose.min() > 0.25, "It rises above the strips, which end at 0.2."
    assert taut.max() < 0.2


TETRAHEDRON = TriangleMesh(
    np.concatenate([np.zeros((1, 3)), np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
)


@pytest.mark.parametrize("trust", [1e-7, 1e-12, 1e-16, 1e-30, 0.0])
@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-6])
def test_a_part_that_hardly_anything_holds_stays_where_it_is(size: float, trust: float) -> None:
    """Solved for its place itself, it went to the origin: the trust is lost beside the stiffness by rounding."""
    speck = replace(TETRAHEDRON, vertices=np.array([0.5, -0.4, 0.3]) + size * TETRAHEDRON.vertices)
    plate = thin_plate(speck, np.full(4, trust), 0.1).vertices
    assert (plate >= speck.vertices.min(0) - 1e-3 * size).all()
    assert (plate <= speck.vertices.max(0) + 1e-3 * size).all()


def test_a_speck_changes_nothing_of_another_part() -> None:
    """Up to what its share in the mean area of a vertex does, which bounds areas from below."""
    flat = square(12)
    bent = replace(flat, vertices=flat.vertices + np.outer(0.05 * np.sin(5 * flat.vertices[:, 0]), [0, 0, 1]))
    count, speck = len(bent.vertices), 2 + 0.1 * TETRAHEDRON.vertices
    both = TriangleMesh(
        np.concatenate([bent.vertices, speck]), np.concatenate([bent.triangles, count + TETRAHEDRON.triangles])
    )
    alone = thin_plate(bent, np.full(count, 0.3), 0.05).vertices
    beside = thin_plate(both, np.append(np.full(count, 0.3), np.zeros(4)), 0.05).vertices
    np.testing.assert_allclose(beside[:count], alone, atol=1e-9)


DEGENERATE = {
    "nothing": TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)),
    "points alone": TriangleMesh(np.eye(3), np.zeros((0, 3), int)),
    "one place": replace(TETRAHEDRON, vertices=np.zeros((4, 3))),
    "a line": TriangleMesh(np.outer(np.arange(3.0), [1, 0, 0]), np.array([[0, 1, 2]])),
    "one triangle": TriangleMesh(np.eye(3), np.array([[0, 1, 2]])),
    "a corner twice": replace(TETRAHEDRON, triangles=np.array([[0, 0, 1], [0, 1, 2]])),
    "an isolated vertex": replace(TETRAHEDRON, vertices=np.concatenate([TETRAHEDRON.vertices, np.ones((1, 3))])),
    "three faces at an edge": TriangleMesh(
        np.concatenate([TETRAHEDRON.vertices, -np.ones((1, 3))]), np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    ),
    "faces that disagree": replace(TETRAHEDRON, triangles=np.array([[0, 2, 1], [0, 3, 1], [0, 3, 2], [1, 2, 3]])),
}


@pytest.mark.parametrize("trust", [0.0, 1e-7, 1.0])
@pytest.mark.parametrize("name", DEGENERATE)
def test_a_degenerate_mesh_has_a_finite_plate(name: str, trust: float) -> None:
    mesh = DEGENERATE[name]
    plate = thin_plate(mesh, np.full(len(mesh.vertices), trust), 0.05)
    assert plate.vertices.shape == mesh.vertices.shape
    assert np.isfinite(plate.vertices).all()
    assert np.abs(plate.vertices).max(initial=0) < 10


def test_a_vertex_that_is_nowhere_is_refused() -> None:
    vertices = TETRAHEDRON.vertices.copy()
    vertices[1, 2] = np.nan
    with pytest.raises(InputError, match="finite equations for the first surface"):
        thin_plate(replace(TETRAHEDRON, vertices=vertices), np.ones(4), 0.05)


HULLS = {
    "specks": lambda x: (
        np.minimum(np.linalg.norm(x - [0.4, 0.3, 0.2], axis=-1), np.linalg.norm(x - [-0.5, -0.2, -0.3], axis=-1))
        - 1.2 * VOXEL
    ),
    "one voxel thick": lambda x: np.maximum(
        np.abs(x[..., :2]).max(-1) - 0.5, np.abs(x[..., 2] - VOXEL / 2) - 0.6 * VOXEL
    ),
    "up to the side of the cube": lambda x: np.abs(x).max(-1) - (HULL_HALF_SIDE - 0.5 * VOXEL),
    "one point": lambda x: np.linalg.norm(x - VOXEL / 2, axis=-1) - 1e-3,
}


@pytest.mark.parametrize("name", HULLS)
@pytest.mark.parametrize("is_touched", [True, False])
def test_a_thin_or_torn_hull_has_a_surface_within_its_cube(name: str, is_touched: bool, views: Views) -> None:
    """Also where no silhouette comes near it, because masks are of something else."""
    line = np.linspace(-HULL_HALF_SIDE, HULL_HALF_SIDE, 48)
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1)
    hull = Hull(HULLS[name](points), HULL_HALF_SIDE, VOXEL)
    known = trusted_hull(hull, views)
    known = known if is_touched else replace(known, trust=np.full_like(known.trust, 1e-7))
    for tension in (0.0, 100.0):
        surface = completed(known, tension=tension)
        assert np.isfinite(surface.vertices).all()
        # Newton steps end within a voxel of the hull, whose function is no distance within a voxel of its middle.
        assert np.abs(surface.vertices).max() <= HULL_HALF_SIDE
        assert hull.at(surface.vertices).max() < VOXEL


def test_a_hull_that_no_silhouette_touches_is_all_that_is_known(views: Views) -> None:
    line = np.linspace(-HULL_HALF_SIDE, HULL_HALF_SIDE, 48)
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1)
    hull = Hull(np.linalg.norm(points, axis=-1) - 2 * VOXEL, HULL_HALF_SIDE, VOXEL / 20)
    assert trusted_hull(hull, views).trust.min() > 0.5
