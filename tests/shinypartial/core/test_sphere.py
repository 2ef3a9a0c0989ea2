"""Directions ⇄ lat-long ⇄ cubemap: inverse pairs, exact solid angles, and the conventions they must follow."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shinypartial.core.conventions import FACES
from shinypartial.core.sphere import (
    cube_directions,
    cube_solid_angles,
    cube_to_directions,
    cube_to_latlong,
    directions_to_cube,
    directions_to_latlong,
    latlong_directions,
    latlong_laplacian,
    latlong_solid_angles,
    latlong_to_cube,
    latlong_to_directions,
    sample_cube,
    sample_latlong,
    tangents,
)

units = st.floats(0, 1)
signed_units = st.floats(-1, 1)
AXES = {"+X": [1, 0, 0], "-X": [-1, 0, 0], "+Y": [0, 1, 0], "-Y": [0, -1, 0], "+Z": [0, 0, 1], "-Z": [0, 0, -1]}


def directions_of(seed: int, number: int = 50) -> np.ndarray:
    """Unit directions uniform on the sphere."""
    directions = np.random.default_rng(seed).normal(size=(number, 3))
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


@given(st.integers(0, 10_000))
def test_latlong_inverts_on_directions(seed: int) -> None:
    directions = directions_of(seed)
    np.testing.assert_allclose(latlong_to_directions(directions_to_latlong(directions)), directions, atol=1e-14)
    np.testing.assert_allclose(directions_to_latlong(7 * directions), directions_to_latlong(directions), atol=1e-15)


@given(st.floats(0, 0.999), st.floats(0.001, 0.999))
def test_latlong_inverts_on_coordinates(u: float, v: float) -> None:
    uv = np.array([u, v])
    # u = 0 and u = 1 are the same meridian.
    found = directions_to_latlong(latlong_to_directions(uv))
    wrapped = (found - uv + [0.5, 0]) % 1 - [0.5, 0]
    assert abs(wrapped[0]) < 1e-12
    assert found[1] == pytest.approx(v, abs=1e-12)


@pytest.mark.parametrize(
    ("axis", "uv"),
    [("+X", (0.5, 0.5)), ("+Y", (0.25, 0.5)), ("-Y", (0.75, 0.5)), ("+Z", (0.5, 0.0)), ("-Z", (0.5, 1.0))],
)
def test_latlong_of_the_axes(axis: str, uv: tuple[float, float]) -> None:
    np.testing.assert_allclose(directions_to_latlong(np.array(AXES[axis], float)), uv, atol=1e-15)


def test_minus_x_is_the_seam() -> None:
    above, below = directions_to_latlong(np.array([[-1.0, 1e-9, 0], [-1.0, -1e-9, 0]]))
    assert above[0] == pytest.approx(0.0, abs=1e-9)
    assert below[0] == pytest.approx(1.0, abs=1e-9)


def test_latlong_follows_the_formula_of_cycles() -> None:
    directions = directions_of(0)
    x, y, z = directions.T
    uv = directions_to_latlong(directions)
    np.testing.assert_allclose(uv[:, 0], 0.5 - np.arctan2(y, x) / (2 * np.pi), atol=1e-15)
    np.testing.assert_allclose(uv[:, 1], np.arccos(z) / np.pi, atol=1e-14)


def test_latlong_grid_has_row_zero_up_and_its_center_along_x() -> None:
    grid = latlong_directions(64)
    assert grid.shape == (64, 128, 3)
    assert (grid[0, :, 2] > 0.999).all()
    assert (grid[-1, :, 2] < -0.999).all()
    np.testing.assert_allclose(grid[31:33, 63:65].mean((0, 1)) @ [1, 0, 0], 1.0, atol=2e-3)
    assert grid[32, 96] @ [0, -1, 0] > 0.999, "u grows to the right, toward −Y."


#: Written out from the OpenGL 4.6 core specification, table 8.19: sc, tc and ma as functions of (rx, ry, rz).
TABLE_8_19 = {
    "px": lambda rx, ry, rz: (-rz, -ry, rx),
    "nx": lambda rx, ry, rz: (rz, -ry, rx),
    "py": lambda rx, ry, rz: (rx, rz, ry),
    "ny": lambda rx, ry, rz: (rx, -rz, ry),
    "pz": lambda rx, ry, rz: (rx, -ry, rz),
    "nz": lambda rx, ry, rz: (-rx, -ry, rz),
}


@pytest.mark.parametrize("name", FACES)
def test_faces_follow_table_8_19_of_opengl(name: str) -> None:
    assert tuple(TABLE_8_19) == FACES
    directions = directions_of(1, 2000)
    face, coordinates = directions_to_cube(directions)
    mine = face == FACES.index(name)
    sc, tc, ma = TABLE_8_19[name](*directions[mine].T)
    axis, sign = "xyz".index(name[1]), 1 if name[0] == "p" else -1
    assert (np.abs(directions[mine]).argmax(-1) == axis).all()
    assert (np.sign(directions[mine][:, axis]) == sign).all()
    np.testing.assert_allclose(coordinates[mine], np.stack([sc, tc], -1) / np.abs(ma)[:, None], atol=1e-15)


@given(st.integers(0, 10_000))
def test_cube_inverts_on_directions(seed: int) -> None:
    directions = directions_of(seed)
    face, coordinates = directions_to_cube(directions)
    assert (np.abs(coordinates) <= 1).all()
    np.testing.assert_allclose(cube_to_directions(face, coordinates), directions, atol=1e-14)


@given(st.integers(0, 5), signed_units, signed_units)
def test_cube_inverts_on_coordinates_inside_a_face(face: int, s: float, t: float) -> None:
    inside = np.array([s, t]) * (1 - 1e-9)
    found_face, found = directions_to_cube(cube_to_directions(np.array(face), inside))
    assert found_face == face
    np.testing.assert_allclose(found, inside, atol=1e-14)


@pytest.mark.parametrize("face", range(6))
@pytest.mark.parametrize(("s", "t"), [(s, t) for s in (-1, 0, 1) for t in (-1, 0, 1) if s or t])
def test_edges_and_corners_keep_their_direction(face: int, s: int, t: int) -> None:
    """On an edge the face is a matter of rounding; the direction is not."""
    direction = cube_to_directions(np.array(face), np.array([s, t], float))
    found_face, found = directions_to_cube(direction)
    np.testing.assert_allclose(cube_to_directions(found_face, found), direction, atol=1e-14)
    assert np.abs(found).max() == pytest.approx(1.0, abs=1e-14)


def test_ties_go_to_x_before_y_before_z() -> None:
    face, _ = directions_to_cube(np.array([[1.0, 1, 1], [-1, -1, -1], [0, 1, 1], [0, -1, 1], [1, 0, -1]]))
    assert [FACES[i] for i in face] == ["px", "nx", "py", "ny", "px"]


@pytest.mark.parametrize("size", [1, 2, 7, 64])
def test_solid_angles_sum_to_the_sphere(size: int) -> None:
    assert latlong_solid_angles(size).sum() == pytest.approx(4 * np.pi, rel=1e-13)
    assert 6 * cube_solid_angles(size).sum() == pytest.approx(4 * np.pi, rel=1e-13)
    assert cube_solid_angles(size).min() > 0


def test_solid_angles_match_the_jacobian_at_the_texel_center() -> None:
    size = 256
    s = 2 * (np.arange(size) + 0.5) / size - 1
    jacobian = (2 / size) ** 2 / (1 + s[:, None] ** 2 + s[None] ** 2) ** 1.5
    # The midpoint rule is off by O(1/size²): measured 1.0e-5 here.
    np.testing.assert_allclose(cube_solid_angles(size), jacobian, rtol=3e-5)
    polar = (np.arange(size) + 0.5) * np.pi / size
    np.testing.assert_allclose(latlong_solid_angles(size)[:, 0], np.sin(polar) * (np.pi / size) ** 2, rtol=3e-5)


@pytest.mark.parametrize("moment", [(0, 0), (1, 1), (2, 2), (0, 1)])
def test_both_grids_integrate_second_moments_of_the_sphere(moment: tuple[int, int]) -> None:
    """∫ ωᵢ ωⱼ dω = 4π/3 δᵢⱼ."""
    i, j = moment
    expected = 4 * np.pi / 3 * (i == j)
    for grid, weight in [(latlong_directions(128), latlong_solid_angles(128)), (cube_directions(64), None)]:
        weights = cube_solid_angles(64) if weight is None else weight
        # Midpoint quadrature: measured error 6e-4 for the cube at 64.
        assert np.sum(grid[..., i] * grid[..., j] * weights) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("height", [2, 5, 16])
def test_latlong_lookup_is_exact_at_texel_centers(height: int) -> None:
    image = np.random.default_rng(0).normal(size=(height, 2 * height, 3))
    np.testing.assert_allclose(sample_latlong(image, latlong_directions(height)), image, atol=1e-12)


@pytest.mark.parametrize("resolution", [1, 2, 5, 16])
def test_cube_lookup_is_exact_at_texel_centers(resolution: int) -> None:
    cube = np.random.default_rng(0).normal(size=(6, resolution, resolution, 3))
    np.testing.assert_allclose(sample_cube(cube, cube_directions(resolution)), cube, atol=1e-12)


@given(st.integers(0, 10_000))
def test_lookups_stay_within_the_range_of_the_map_and_keep_constants(seed: int) -> None:
    directions = np.concatenate([directions_of(seed), np.array(list(AXES.values()), float)])
    generator = np.random.default_rng(seed)
    latlong, cube = generator.uniform(size=(4, 8, 2)), generator.uniform(size=(6, 3, 3, 2))
    for image, sample in ((latlong, sample_latlong), (cube, sample_cube)):
        values = sample(image, directions)
        assert image.min() - 1e-12 <= values.min() <= values.max() <= image.max() + 1e-12
        np.testing.assert_allclose(sample(np.full_like(image, 3.0), directions), 3.0, atol=1e-14)


def test_latlong_lookup_wraps_around_the_seam() -> None:
    image = np.zeros((4, 8, 1))
    image[:, 0], image[:, -1] = 1.0, 3.0
    np.testing.assert_allclose(sample_latlong(image, np.array([[-1.0, 0.0, 0.0]])), [[2.0]], atol=1e-12)


def smooth(directions: np.ndarray) -> np.ndarray:
    """A smooth function on the sphere with a different value on each axis."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.stack([x + 0.3 * y * z, y - 0.5 * x * z, z + 0.2 * x * y], -1)


def test_latlong_to_cube_to_latlong_keeps_smooth_maps() -> None:
    latlong = smooth(latlong_directions(128))
    cube = latlong_to_cube(latlong, 64)
    # Bilinear lookups are off by O(1/N²) inside a face and by O(1/L) where sample_cube clamps: measured 1.3e-2 at most.
    assert np.abs(cube - smooth(cube_directions(64))).max() < 2e-3
    error = np.abs(cube_to_latlong(cube, 128) - latlong)
    assert error.max() < 3e-2
    assert error.mean() < 1e-3


@pytest.mark.parametrize("name", AXES)
def test_axis_colors_survive_both_resamplings(name: str) -> None:
    direction = np.array([AXES[name]], float)
    cube = latlong_to_cube(smooth(latlong_directions(64)), 32)
    np.testing.assert_allclose(sample_cube(cube, direction), smooth(direction), atol=2e-2)
    np.testing.assert_allclose(sample_latlong(cube_to_latlong(cube, 64), direction), smooth(direction), atol=5e-2)


def test_the_laplacian_is_the_energy_of_a_linear_function_in_any_direction() -> None:
    """∫‖∇(d·a)‖² = 8π/3 for unit a; a constant has none."""
    laplacian, directions = latlong_laplacian(64), latlong_directions(64).reshape(-1, 3)
    # Steps of 2.8°: measured 3e-4.
    np.testing.assert_allclose(directions.T @ (laplacian @ directions), 8 * np.pi / 3 * np.eye(3), atol=5e-3)
    np.testing.assert_allclose(laplacian.sum(0), 0, atol=1e-12)


@pytest.mark.parametrize("shape", [(3,), (50, 3), (4, 5, 3)])
def test_tangents_and_their_direction_are_a_right_handed_frame(shape: tuple[int, ...]) -> None:
    directions = np.random.default_rng(0).normal(size=shape)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    first, second = tangents(directions)
    frames = np.stack([first, second, directions], -2)
    np.testing.assert_allclose(
        frames @ np.swapaxes(frames, -1, -2), np.broadcast_to(np.eye(3), frames.shape), atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(frames), 1)
