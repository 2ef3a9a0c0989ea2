"""Near rooms, an operator, aperture and motion: each against a calculation by hand that knows nothing of Blender."""

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Bool, Float

from shinypartial.blender.render import RenderedView, open_renderer
from shinypartial.core.camera import Camera, project, ray_directions_world, reflect
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.core.sphere import latlong_directions
from shinypartial.core.trajectory import plan_cameras
from shinypartial.io.images import write_exr_rgb
from shinypartial.scene import Room, SceneSpec, override
from tests.support.tiny_scene import tiny_scene

pytest.importorskip("bpy")

MIRROR = '{ kind = "plane", size = [1.6, 1.6], normal = [1.0, 0.0, 0.0] }'
#: Half the diagonal of the mirror: the radius of the smallest ball about its center.
MIRROR_RADIUS = 0.8 * np.sqrt(2)
PROPORTIONS = np.array([1.6, 1.3, 1.0])


def views(spec: SceneSpec, **options) -> list[tuple[Camera, RenderedView]]:
    varied = override(spec, **options)
    cameras = plan_cameras(varied.camera, varied.render.resolution).train
    with open_renderer(varied) as renderer:
        return [(camera, renderer.render(camera)) for camera in cameras]


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> SceneSpec:
    """A square mirror that its only training camera looks at along its normal, from four units away."""
    folder = tmp_path_factory.mktemp("plane")
    ahead = {"azimuth": "[0, 0]", "elevation": "[0, 0]", "sweeps": 1}
    return tiny_scene(folder, shape=MIRROR, **ahead, train=1, test=1, samples=32, resolution=64)


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> SceneSpec:
    """A unit mirror sphere in a world whose color is (d + 1)/2 of its direction d."""
    return tiny_scene(tmp_path_factory.mktemp("sphere"), samples=16, resolution=64)


@pytest.fixture(scope="module")
def spot(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Float[np.ndarray, "3"]]:
    """A black world with a single bright texel, and the direction of that texel."""
    height = 128
    path, directions = tmp_path_factory.mktemp("spot") / "spot.exr", latlong_directions(height)
    row, column = np.unravel_index(np.argmax(directions @ [0.97, 0.12, 0.1]), directions.shape[:2])
    latlong = np.zeros((height, 2 * height, 3), np.float32)
    latlong[row, column] = 100.0
    write_exr_rgb(path, latlong)
    return path, directions[row, column]


def brightest(view: RenderedView) -> Float[np.ndarray, "2"]:
    """Center of mass of the light, in pixels (x, y)."""
    light = view.radiance[..., 0].astype(np.float64)
    y, x = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    return np.array([(x * light).sum(), (y * light).sum()]) / light.sum()


@pytest.mark.parametrize("room", ["sphere", "box"])
def test_a_mirrored_point_of_the_wall_appears_where_its_mirror_image_is_seen(
    plane: SceneSpec, spot: tuple[Path, Float[np.ndarray, "3"]], room: str
) -> None:
    """Behind the mirror x = 0 the point (x, y, z) of the wall has its image at (−x, y, z)."""
    path, direction = spot
    found, expected = [], []
    for radii in (2.0, 10.0):
        ((camera, view),) = views(plane, world=str(path), surroundings_radii=radii, surroundings_room=room)
        distance = radii * MIRROR_RADIUS
        if room == "box":
            distance /= (np.abs(direction) / PROPORTIONS).max()
        image = distance * direction * [-1, 1, 1]
        found.append(brightest(view))
        expected.append(project(camera, image[None])[0, :2])
    # Measured 0.04; the point moves by 3 pixels between the two rooms.
    np.testing.assert_allclose(found, expected, atol=0.15)
    assert np.linalg.norm(expected[1] - expected[0]) > 2


@pytest.mark.parametrize("options", [{}, {"surroundings_room": "box"}], ids=["sphere", "box"])
def test_seen_from_the_center_the_room_is_the_stored_map(sphere: SceneSpec, options: dict) -> None:
    """A mirror of radius a sees the wall turned by at most 2a/D, so a tiny one sees the map; half that is its color."""
    tiny = override(sphere, object_scale=0.01, radius=0.04, samples=4)
    for distance, limit in ((1.0, 0.01), (0.02, None)):
        camera, view = views(tiny, surroundings_distance=distance, **options)[0]
        mirrored = reflect(ray_directions_world(camera), view.normals_world)
        error = np.abs(view.radiance - (mirrored + 1) / 2)[view.alpha > SOLID_ALPHA]
        # Curvature within a pixel adds 0.01 at the silhouette.
        assert np.quantile(error, 0.95) < limit if limit else error.max() > 0.1


def test_inverse_distances_of_a_box_by_hand() -> None:
    box = Room("box", 2.0, (1.0, 0.5, 2.0))  # From −4 to 4, −2 to 2 and −8 to 8.
    directions = np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1], [0.6, 0.8, 0], [0.8, 0, -0.6]])
    np.testing.assert_allclose(box.inverse_distance(directions), [1 / 4, 1 / 2, 1 / 8, 0.4, 0.2])
    np.testing.assert_allclose(Room("sphere", 2.0, (1.0, 0.5, 2.0)).inverse_distance(directions), 0.5)
    assert box.holds(np.array([[3.0, 1.0, -7.0]]), 0.9)
    assert not box.holds(np.array([[3.0, 1.0, -7.0]]), 1.1)


def assert_same_silhouette(first: RenderedView, second: RenderedView) -> None:
    """All but noise of the pixels on the silhouette; 16 samples have a standard deviation of up to 1/8."""
    assert first.alpha.sum() == pytest.approx(second.alpha.sum(), rel=3e-3)
    np.testing.assert_allclose(first.alpha, second.alpha, atol=0.45)


def sees_the_operator(camera: Camera, height: float) -> Bool[np.ndarray, "H W"]:
    """Where the ray through a pixel's center, mirrored by the unit sphere, meets head or body below that camera."""
    rays, position = ray_directions_world(camera), camera.position_world
    half = rays @ position
    inside = half**2 - position @ position + 1
    points = position + (-half - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    mirrored = rays - 2 * np.sum(rays * points, -1, keepdims=True) * points
    met = np.zeros(half.shape, bool)
    head = height / 14
    for center, radii in (((0, 0, 0), (head,) * 3), ((0, 0, -height / 2), (height / 7, height / 7, height / 2 - head))):
        start, along = (points - position - center) / radii, mirrored / radii
        a, b, c = (along**2).sum(-1), (start * along).sum(-1), (start**2).sum(-1) - 1
        met |= (b**2 > a * c) & (b < 0)
    return met & (inside > 0)


def test_the_operator_is_mirrored_at_each_camera_and_never_seen_directly(sphere: SceneSpec) -> None:
    height = 4.0
    plain = views(sphere)
    for (camera, alone), (_, view) in zip(
        plain, views(sphere, operator_height=height, operator_radiance=9.0), strict=True
    ):
        expected = sees_the_operator(camera, height)
        assert 20 < expected.sum() < 200
        assert expected[31:33, 31:33].all(), "The ray through the middle comes straight back."
        found = view.radiance[..., 0] > 4.5
        assert (found != expected).sum() <= 8, "All but pixels on the figure's silhouette."
        # One sample through the center of each pixel, on a mesh and not the exact ellipsoid.
        assert (view.self_reflection != expected).sum() <= 2
        np.testing.assert_allclose(view.radiance[found & expected & (view.self_reflection > 0)].max(), 9.0, rtol=1e-4)
        assert_same_silhouette(view, alone)
        assert (view.radiance[view.alpha == 0] == 0).all()


def test_exposure_multiplies_the_operator_as_it_does_the_world(sphere: SceneSpec) -> None:
    (_, view), *_ = views(sphere, operator_height=4.0, operator_radiance=3.0, exposure=-1.0)
    assert view.radiance.max() == pytest.approx(1.5, rel=1e-4)


def edge_moments(view: RenderedView, left: bool) -> tuple[float, float]:
    """Mean position in pixels and variance of an edge of the plane, from how alpha rises across it.

    The rise holds the pixel twice (alpha is its average, and differences are taken a pixel apart): 1/6 of variance.
    """
    width = view.alpha.shape[1]
    across = view.alpha[width // 2 - 6 : width // 2 + 6].mean(0, dtype=np.float64)
    half = across[: width // 2] if left else across[: width // 2 - 1 : -1]
    rise = np.diff(half, prepend=0.0)
    place = np.arange(len(rise))
    mean = float((rise * place).sum() / rise.sum())
    variance = float((rise * (place - mean) ** 2).sum() / rise.sum()) - 1 / 6
    return (mean if left else width - mean), variance


@pytest.mark.parametrize("focus", [2.5, 8.0])
def test_an_silhouette_is_blurred_over_the_circle_of_confusion(plane: SceneSpec, focus: float) -> None:
    """Diameter c = A f |1/z − 1/z_f| with aperture A = 50 mm/N; a uniform disk has the variance c²/16 across."""
    ((camera, view),) = views(plane, f_number=0.1, focus_distance=focus, samples=256)
    diameter = 0.5 * camera.fx * abs(1 / 4.0 - 1 / focus)
    for left in (True, False):
        mean, variance = edge_moments(view, left)
        assert mean == pytest.approx(camera.cx + (-1 if left else 1) * camera.fx * 0.8 / 4, abs=0.15)
        # The edge lies anywhere in a pixel, which adds up to ±1/12.
        assert 4 * np.sqrt(variance) == pytest.approx(diameter, rel=0.04)


def test_the_plane_of_focus_is_sharp_and_it_is_the_target_s_by_default(plane: SceneSpec) -> None:
    ((_, pinhole),) = views(plane)
    for options in ({}, {"focus_distance": 4.0}):
        ((_, view),) = views(plane, f_number=0.1, **options)
        np.testing.assert_allclose(view.alpha, pinhole.alpha, atol=0.1)
        np.testing.assert_allclose(view.depth[view.alpha == 1], 4.0, atol=1e-3)


def test_motion_spreads_an_edge_over_the_way_that_it_goes(plane: SceneSpec) -> None:
    """The camera turns by 15° around a point before the mirror; an edge is where it is projected meanwhile."""
    moved = override(plane, target=(2.0, 0.0, 0.0), samples=256)
    ((camera, view),) = views(moved, motion_deg=15.0)
    angle = np.radians(np.linspace(-7.5, 7.5, 1001))
    for left, y in ((True, -0.8), (False, 0.8)):
        # Seen from a camera that stands at that angle, its axis through (2, 0), image x along +Y at angle zero.
        lateral = y * np.cos(angle) + 2 * np.sin(angle)
        depth = 4 + 2 * np.cos(angle) - y * np.sin(angle)
        path = camera.cx + camera.fx * lateral / depth
        mean, variance = edge_moments(view, left)
        assert mean == pytest.approx(path.mean(), abs=0.15)
        assert np.sqrt(variance) == pytest.approx(path.std(), rel=0.03)
        assert np.ptp(path) > 5


def test_a_sphere_at_the_target_keeps_its_silhouette_in_motion_and_the_operator_moves_along(sphere: SceneSpec) -> None:
    figure = {"operator_height": 4.0, "operator_radiance": 9.0}
    pairs = zip(views(sphere, **figure), views(sphere, **figure, motion_deg=20.0), strict=True)
    for (camera, still), (_, moving) in pairs:
        assert_same_silhouette(moving, still)
        assert np.sum(moving.normals_world * ray_directions_world(camera), -1).max() < 1e-5
        for light in (still, moving):  # The head covers most of these four pixels; at rest, it would sweep across five.
            assert light.radiance[31:33, 31:33].mean() > 6
        assert np.abs(moving.radiance - still.radiance)[:, 31:33].max() < 2
        np.testing.assert_array_equal(moving.self_reflection, still.self_reflection)
