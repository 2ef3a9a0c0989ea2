"""Meshes: outward faces that agree with the exact normals, closed where they should be, smooth at the axis."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import KDTree

from shinypartial.blender.geometry import make_mesh, make_part, profile_outlines
from shinypartial.blender.mesh import deformed, displacement_field
from shinypartial.core.errors import InputError
from shinypartial.core.mesh import Mesh, polygon_normals
from shinypartial.scene import (
    Blob,
    Deformation,
    Frame,
    Panes,
    Part,
    Plane,
    RadialHarmonics,
    Ring,
    Shape,
    SoftBalls,
    Sphere,
    Superquadric,
    SurfaceOfRevolution,
    Tube,
    load_scene,
    scene_names,
)
from tests.support.coarse_scene import coarse_scene, parts_of


def face_normals(mesh: Mesh) -> np.ndarray:
    corners = np.array([face[:3] for face in mesh.faces])
    a, b, c = mesh.vertices[corners].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, -1)))


def edge_uses(mesh: Mesh) -> tuple[np.ndarray, int]:
    """How many faces each edge has, and Euler's number."""
    edges = [tuple(sorted(pair)) for face in mesh.faces for pair in pairwise((*face, face[0]))]
    unique, uses = np.unique(edges, axis=0, return_counts=True)
    return uses, len(mesh.vertices) - len(unique) + len(mesh.faces)


def volume(mesh: Mesh) -> float:
    """Of a closed mesh; negative where its faces point inward."""
    triangles = np.array([(face[0], *pair) for face in mesh.faces for pair in pairwise(face[1:])])
    a, b, c = mesh.vertices[triangles].transpose(1, 0, 2)
    return float(np.sum(a * np.cross(b, c)) / 6)


#: Closed forms, and Euler's number of each.
CLOSED_FORMS: dict[str, tuple[RadialHarmonics | Superquadric | Ring, int]] = {
    "radial harmonics": (RadialHarmonics(seed=7, degree=6, variation=0.1), 2),
    "box": (Superquadric(size=(1.4, 1.0, 1.2), exponents=(4.0, 3.0)), 2),
    "ellipsoid": (Superquadric(size=(1.4, 1.0, 1.2), exponents=(2.0, 2.0)), 2),
    "twisted": (Superquadric(size=(0.9, 1.1, 1.8), exponents=(3.0, 5.0), twist_deg=-120.0), 2),
    "torus": (Ring(), 0),
    "wavy ring": (Ring(waves=4, bend=0.15, swell=0.25, phase_deg=40.0), 0),
}
TWO_BALLS = SoftBalls(balls=((0, 0, 0.3, 0.5, 1.0), (0, 0, -0.4, 0.4, 1.0), (0.4, 0, 0.4, 0.2, -1.0)), resolution=48)

SHAPES = {
    "vase": load_scene("vase").object,
    "sphere": Sphere(radius=2.0, segments=64, rings=32),
    "plane": Plane(normal=(0.3, -1.0, 0.2)),
    "floor": Plane(normal=(0.0, 0.0, 1.0)),
    "frame": Frame(profile=((0.0, 0.0), (0.0, 0.1), (0.1, 0.1)), normal=(0.3, -1.0, 0.2)),
    "tube": Tube(path=((0, 0, 0), (1, 0, 0), (1, 1, 0.5)), radii=(0.1, 0.2, 0.1)),
    "ring": Tube(path=((1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)), radii=(0.2,) * 4, closed=True, flatness=0.5),
    "blob": Blob(resolution=48),
    "soft balls": TWO_BALLS,
    **{name: replace(shape, segments=64, rings=48) for name, (shape, _) in CLOSED_FORMS.items()},
    "can": SurfaceOfRevolution(profile=((0, 0), (1, 0), (1, 2), (0, 2)), creases=(1, 2), segments=64, rings=40),
    "cone": SurfaceOfRevolution(profile=((1.0, 0.0), (0.6, 0.4), (0.2, 0.8)), segments=64),
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())
def test_faces_turn_the_way_the_normals_point(shape: Shape) -> None:
    mesh = make_mesh(shape)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-12)
    corners = np.array([mesh.normals[list(face)].mean(0) for face in mesh.faces])
    # Slivers of a level set's coarse grid lie up to 40° askew.
    least = 0.7 if isinstance(shape, Blob | SoftBalls) else 0.9
    assert (np.sum(corners * face_normals(mesh), -1) > least).all()


@pytest.mark.parametrize("name", scene_names())
def test_every_part_of_every_scene_is_sound(name: str) -> None:
    spec = coarse_scene(name)
    for part in (*parts_of(spec), *spec.props):
        mesh = make_part(part)
        assert np.isfinite(mesh.vertices).all()
        # Between its points a spline may bulge; measured 0.5 %.
        assert np.linalg.norm(mesh.vertices, axis=-1).max() <= 1.01 * part.extent


@pytest.mark.parametrize(("shape", "euler"), CLOSED_FORMS.values(), ids=CLOSED_FORMS.keys())
def test_a_closed_form_is_closed_and_its_normals_are_those_of_its_surface(shape: Shape, euler: int) -> None:
    mesh = make_mesh(replace(shape, segments=192, rings=144))
    uses, found = edge_uses(mesh)
    assert (uses == 2).all()
    assert found == euler
    assert volume(mesh) > 0.1, "Faces and normals point outward."
    assert np.linalg.norm(mesh.vertices, axis=-1).max() <= shape.extent + 1e-9
    # Against differences of the vertices, but near the poles, where triangles are slender.
    inner = np.ones(len(mesh.vertices), bool)
    if not isinstance(shape, Ring):
        inner[: 16 * 192] = inner[-16 * 192 :] = False
    assert angles_deg(mesh.normals, polygon_normals(mesh.vertices, mesh.faces))[inner].max() < 0.5


@pytest.mark.parametrize("shape", [shape for shape, _ in CLOSED_FORMS.values()], ids=CLOSED_FORMS.keys())
def test_faces_are_so_fine_that_interpolated_normals_are_exact(shape: RadialHarmonics | Superquadric | Ring) -> None:
    """The mean of a face's normals against the exact one at the middle of its parameters, at half the fineness."""
    is_ring = isinstance(shape, Ring)

    def grid(mesh: Mesh, segments: int) -> np.ndarray:
        return (mesh.normals if is_ring else mesh.normals[1:-1]).reshape(-1, segments, 3)

    half = replace(shape, segments=shape.segments // 2, rings=shape.rings // 2)
    coarse, fine = grid(make_mesh(half), half.segments), grid(make_mesh(shape), shape.segments)
    sides = coarse + np.roll(coarse, -1, 1)
    means = sides + np.roll(sides, -1, 0) if is_ring else sides[:-1] + sides[1:]
    exact = fine[1::2, 1::2] if is_ring else fine[2:-1:2, 1::2]
    # The error falls with the square of a face's size: below 0.02° on the faces of the defaults.
    assert angles_deg(means, exact).max() < 4 * 0.02


def test_refinements_make_interpolated_normals_of_the_sculpture_exact() -> None:
    """The mean of an edge's normals against the exact one where a refinement divides it, on coarse cells."""
    recipe = load_scene("sculpture").object
    assert isinstance(recipe, Blob)

    def error(refinements: int) -> float:
        mesh, finer = (make_mesh(replace(recipe, resolution=32, refinements=refinements + more)) for more in (0, 1))
        faces = np.array(mesh.faces)
        first, second = np.unique(np.sort(np.concatenate([faces[:, :2], faces[:, 1:]]), -1), axis=0).T
        nearest = KDTree(finer.vertices).query((mesh.vertices[first] + mesh.vertices[second]) / 2)[1]
        means = mesh.normals[first] + mesh.normals[second]
        return float(np.median(angles_deg(means, finer.normals[nearest])))

    coarse, refined = error(0), error(1)
    assert refined == pytest.approx(coarse / 4, rel=0.3), "It falls with the square of a face's size."
    assert refined * (32 / recipe.resolution) ** 2 / 4 ** (recipe.refinements - 1) < 0.01


def test_closed_forms_have_the_volumes_of_their_formulas() -> None:
    """Of the torus 2π²Rr², of an ellipsoid 4/3 π abc, also when it is twisted; a mesh of chords is a little smaller."""
    torus = Ring(radius=0.8, thickness=0.3, segments=128, rings=256)
    assert volume(make_mesh(torus)) == pytest.approx(2 * np.pi**2 * 0.8 * 0.3**2, rel=1e-3)
    ellipsoid = Superquadric(size=(1.0, 2.0, 1.5), exponents=(2.0, 2.0), segments=256, rings=128)
    for shape in (ellipsoid, replace(ellipsoid, twist_deg=90.0)):
        assert volume(make_mesh(shape)) == pytest.approx(np.pi / 6 * 3.0, rel=1e-3)


def test_radial_harmonics_vary_as_much_as_they_should() -> None:
    mesh = make_mesh(RadialHarmonics(seed=3, degree=5, variation=0.1, segments=192, rings=96))
    radii = np.linalg.norm(mesh.vertices, axis=-1)
    # Each latitude counts by its area.
    area = np.hypot(*mesh.vertices[:, :2].T) / radii
    mean = np.average(radii, weights=area)
    assert np.sqrt(np.average((radii / mean - 1) ** 2, weights=area)) == pytest.approx(0.1, rel=1e-3)
    other = make_mesh(RadialHarmonics(seed=4, degree=5, variation=0.1, segments=192, rings=96))
    assert np.abs(other.vertices - mesh.vertices).max() > 0.05


def test_a_ball_alone_is_a_sphere_and_one_of_negative_strength_carves() -> None:
    ball = make_mesh(SoftBalls(balls=((0.3, 0.0, -0.2, 0.4, 1.0),), radius=2.0, resolution=32))
    np.testing.assert_allclose(ball.vertices, 2 * ball.normals, atol=2e-3)
    assert (edge_uses(ball)[0] == 2).mean() > 0.999, "But for slivers without area, which are left out."
    whole = replace(TWO_BALLS, balls=TWO_BALLS.balls[:2])
    assert volume(make_mesh(TWO_BALLS)) < 0.97 * volume(make_mesh(whole))


def test_balls_without_a_surface_are_refused() -> None:
    with pytest.raises(InputError, match="strength"):
        make_mesh(SoftBalls(balls=((0.0, 0.0, 0.0, 0.5, 1.0), (0.0, 0.0, 0.0, 0.6, -3.0))))


def test_a_part_is_stretched_turned_and_moved_with_its_normals() -> None:
    shape = SHAPES["sphere"]
    part = Part(shape, stretch=(1.0, 2.0, 0.5), turn_deg=(90.0, 0.0, 90.0), offset=(0.0, 0.0, 3.0))
    mesh = make_part(part)
    # About X by 90°: y to z and z to −y; then about Z: x to y and y to −x.
    middle = mesh.vertices - [0.0, 0.0, 3.0]
    np.testing.assert_allclose(np.abs(middle).max(0), [0.5 * 2, 2, 2 * 2], rtol=1e-3)
    quadric = middle / np.array([0.5, 1.0, 2.0]) ** 2
    np.testing.assert_allclose(mesh.normals, quadric / np.linalg.norm(quadric, axis=-1, keepdims=True), atol=1e-9)
    assert np.linalg.norm(mesh.vertices, axis=-1).max() <= part.extent
    plain = make_part(Part(shape))
    np.testing.assert_array_equal(plain.vertices, make_mesh(shape).vertices)


def test_a_crease_is_sharp_and_a_wall_between_two_points_is_straight() -> None:
    mesh = make_mesh(SHAPES["can"])
    at_edge = np.hypot(*mesh.vertices[:, :2].T) == 1
    wall = mesh.normals[at_edge & (np.abs(mesh.vertices[:, 2] - 1) < 0.5)]
    np.testing.assert_allclose(wall[:, 2], 0, atol=1e-12)
    corner = mesh.normals[at_edge & (mesh.vertices[:, 2] == 2)]
    assert len(corner) == 2 * 64, "Both sides keep their own normal."
    assert {tuple(sorted(np.abs(np.round([np.hypot(n[0], n[1]), n[2]], 9)))) for n in corner} == {(0.0, 1.0)}


def test_a_ring_is_closed_and_a_blob_lies_within_its_radius() -> None:
    for name, characteristic in (("ring", 0), ("blob", None)):
        mesh = make_mesh(SHAPES[name])
        edges = [frozenset((a, b)) for face in mesh.faces for a, b in zip(face, (*face[1:], face[0]), strict=True)]
        if characteristic is not None:
            seam = 48  # The last ring of vertices repeats the first.
            assert len(mesh.vertices) - seam - (len(set(edges)) - seam) + len(mesh.faces) == characteristic
        else:
            assert all(edges.count(edge) == 2 for edge in edges[:50]), "No edge of a closed surface is free."
    assert np.linalg.norm(make_mesh(SHAPES["blob"]).vertices, axis=-1).max() == pytest.approx(1)


def test_blobs_are_seeded() -> None:
    first, again, other = (make_mesh(Blob(seed=seed, resolution=24)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    assert first.vertices.shape != other.vertices.shape


def test_a_displacement_has_its_amplitude_and_normals_of_its_own_surface() -> None:
    waves = Deformation(amplitude=0.02, wavelength=1.0, seed=5)
    points = np.random.default_rng(0).uniform(-50, 50, (20_000, 3))
    assert np.sqrt(np.mean(displacement_field(points, waves) ** 2)) == pytest.approx(1, rel=0.03)
    mesh = make_mesh(Plane(normal=(0.0, 0.0, 1.0)), fine=True)
    moved = deformed(mesh, waves)
    np.testing.assert_allclose(moved.vertices[:, :2], mesh.vertices[:, :2], atol=1e-12)
    step = 1e-5
    slopes = [
        0.02
        * (displacement_field(mesh.vertices + d, waves) - displacement_field(mesh.vertices - d, waves))
        / (2 * step)
        for d in np.eye(3)[:2] * step
    ]
    exact = np.stack([-slopes[0], -slopes[1], np.ones(len(mesh.vertices))], -1)
    exact /= np.linalg.norm(exact, axis=-1, keepdims=True)
    inner = np.abs(mesh.vertices[:, :2]).max(-1) < 0.79
    # Measured 2e-4 inside, and 5e-3 at the border, where a vertex has faces on one side only.
    np.testing.assert_allclose(moved.normals[inner], exact[inner], atol=1e-3)
    np.testing.assert_allclose(moved.normals, exact, atol=1e-2)


def test_no_gap_opens_at_a_crease() -> None:
    mesh = make_mesh(SHAPES["can"])
    moved = deformed(mesh, Deformation(amplitude=0.02))
    edge = np.flatnonzero((np.hypot(*mesh.vertices[:, :2].T) == 1) & (mesh.vertices[:, 2] == 2))
    assert len(np.unique(np.round(moved.vertices[edge], 9), axis=0)) == len(edge) / 2


def test_a_sphere_is_closed_and_its_normals_are_its_points() -> None:
    mesh = make_mesh(SHAPES["sphere"])
    np.testing.assert_allclose(mesh.vertices, 2 * mesh.normals, atol=1e-12)
    edges = {frozenset((a, b)) for face in mesh.faces for a, b in zip(face, (*face[1:], face[0]), strict=True)}
    assert len(mesh.vertices) - len(edges) + len(mesh.faces) == 2, "Euler's formula of a closed surface."


def test_the_spline_goes_through_its_points_and_is_level_at_the_axis() -> None:
    vase = load_scene("vase").object
    (silhouette,) = profile_outlines(replace(vase, rings=20_000))
    for radius, z in vase.profile:
        distance = np.hypot(silhouette.points[:, 0] - radius, silhouette.points[:, 1] - z - vase.offset_z).min()
        assert distance < 1e-4  # half the spacing of the samples
    np.testing.assert_allclose(silhouette.normals[0], [0, -1], atol=1e-12)
    assert (silhouette.points[1:, 0] > 0).all()


def test_spline_normals_are_perpendicular_to_the_curve() -> None:
    (silhouette,) = profile_outlines(replace(load_scene("vase").object, rings=20_000))
    tangents = np.gradient(silhouette.points, axis=0)[1:-1]
    tangents /= np.linalg.norm(tangents, axis=-1, keepdims=True)
    # Central differences at this spacing are good to 2e-6; the knots, where the third derivative jumps, to 1e-4.
    assert np.abs(np.sum(tangents * silhouette.normals[1:-1], -1)).max() < 1e-4


def test_a_plane_has_its_size_and_a_level_side() -> None:
    mesh = make_mesh(Plane(size=(2.0, 3.0), normal=(0.3, -1.0, 0.2)))
    sides = np.diff(mesh.vertices[list(mesh.faces[0])], axis=0)
    np.testing.assert_allclose(np.linalg.norm(sides, axis=-1), [2, 3, 2])
    assert sides[0, 2] == pytest.approx(0)


@pytest.mark.parametrize("gap", [0.0, 0.02])
def test_panes_are_tilted_within_bounds_and_bulge_alike(gap: float) -> None:
    """Least squares over the vertices of each pane: slopes, curvature and place; normals are those of the faces."""
    panes = Panes(size=(1.6, 1.2), count=(4, 3), gap=gap, tilt_deg=0.5, bulge=0.002, seed=5)
    mesh = make_mesh(panes)
    slopes = []
    for points, normals in zip(np.split(mesh.vertices, 12), np.split(mesh.normals, 12), strict=True):
        x, z, out = points[:, 0], points[:, 2], -points[:, 1]
        half = np.ptp(x) / 2, np.ptp(z) / 2
        assert half == pytest.approx(((0.4 - gap) / 2, (0.4 - gap) / 2), rel=1e-6)
        u, v = x - (x.max() + x.min()) / 2, z - (z.max() + z.min()) / 2
        terms = np.stack([np.ones_like(u), u, v, (u / half[0]) ** 2, (v / half[1]) ** 2], 1)
        found, left, *_ = np.linalg.lstsq(terms, out, rcond=None)
        assert left.sum() < 1e-12
        assert abs(found[3]) == pytest.approx(0.002, rel=1e-6)
        assert found[4] == pytest.approx(found[3], rel=1e-6)
        slopes.append(np.degrees(np.arctan(found[1:3])))
        expected = np.stack(
            [-found[1] - 2 * found[3] * u / half[0] ** 2, -found[2] - 2 * found[4] * v / half[1] ** 2], 1
        )
        np.testing.assert_allclose(normals[:, [0, 2]] / -normals[:, 1:2], expected, atol=1e-7)
    assert np.abs(slopes).max() <= 0.5
    assert np.std(slopes) > 0.2
