"""What Blender hands back: radiance without a display transform, exact normals, z-depth, area-averaged alpha."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Bool, Float

from shinypartial.blender.assemble import world_radiance
from shinypartial.blender.geometry import profile_outlines
from shinypartial.blender.render import RenderedView, open_renderer
from shinypartial.core.camera import Camera, ray_directions_world, reflect
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.core.sphere import sample_latlong
from shinypartial.core.trajectory import plan_cameras
from shinypartial.io.images import write_exr_rgb
from shinypartial.scene import SceneSpec, SurfaceOfRevolution, load_scene, override
from tests.support.tiny_scene import tiny_scene

pytest.importorskip("bpy")

RESOLUTION = 128


@dataclass(frozen=True)
class Rendered:
    """A view of a scene, its camera, and the pixels whose reflection hit the object again."""

    spec: SceneSpec
    camera: Camera
    view: RenderedView
    self_reflected: Bool[np.ndarray, "H W"]

    @property
    def solid(self) -> Bool[np.ndarray, "H W"]:
        """Pixels wholly on the object."""
        return self.view.alpha > SOLID_ALPHA

    @property
    def center_depth_to_points(self) -> Float[np.ndarray, "H W 3"]:
        """World points on the rays through pixel centers at the stored z-depth."""
        rays = ray_directions_world(self.camera)
        along_axis = rays @ self.camera.camera_to_world[:3, 2]
        return self.camera.position_world + rays * (self.view.depth / along_axis)[..., None]


def render_middle(spec: SceneSpec) -> Rendered:
    """Render the view in the middle of the path, and once more with the object invisible to reflected rays.

    Where the two differ, a reflected ray met the object again: that pixel does not show the environment alone.
    """
    cameras = plan_cameras(spec.camera, spec.render.resolution).train
    camera = cameras[len(cameras) // 2]
    with open_renderer(spec) as renderer:
        view = renderer.render(camera)
        for each in renderer.bpy.data.objects:
            each.visible_glossy = False
        alone = renderer.render(camera)
    return Rendered(spec, camera, view, np.abs(view.radiance - alone.radiance).max(-1) > 1e-4)


@pytest.fixture(scope="module")
def vase() -> Rendered:
    return render_middle(override(load_scene("vase"), resolution=RESOLUTION, samples=32))


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Rendered:
    shape = '{ kind = "plane", size = [2.5, 2.5], normal = [1.0, 0.5, 0.4] }'
    return render_middle(tiny_scene(tmp_path_factory.mktemp("plane"), shape=shape, samples=64, resolution=48))


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> Rendered:
    return render_middle(tiny_scene(tmp_path_factory.mktemp("sphere"), samples=64, resolution=48))


@pytest.fixture(params=["vase", "plane", "sphere"])
def rendered(request: pytest.FixtureRequest) -> Iterator[Rendered]:
    return request.getfixturevalue(request.param)


def test_a_mirror_shows_the_environment_as_it_is(vase: Rendered) -> None:
    """|pixel − E(ω_r)| over pixels on the object that a single reflection colors, both clipped to [0, 1]."""
    chosen = vase.solid & ~vase.self_reflected
    assert 0 < (vase.solid & vase.self_reflected).sum() < 0.25 * vase.solid.sum()
    mirrored = reflect(ray_directions_world(vase.camera), vase.view.normals_world)
    expected = sample_latlong(world_radiance(vase.spec.world), mirrored)
    error = np.abs(np.clip(vase.view.radiance, 0, 1) - np.clip(expected, 0, 1))[chosen]
    # Measured 0.0037 at 128 pixels, where a pixel spans several texels; 0.001 at 400.
    assert np.median(error) < 0.005


def test_radiance_is_not_clipped(vase: Rendered) -> None:
    assert vase.view.radiance.max() > 10


def test_normals_are_those_of_the_smooth_surface(vase: Rendered) -> None:
    """Against the profile's own normal at the point that depth gives: no facets, no wrong frame."""
    from scipy.spatial import cKDTree

    surface = vase.spec.object
    assert isinstance(surface, SurfaceOfRevolution)
    (silhouette,) = profile_outlines(replace(surface, rings=100_000))
    points = vase.center_depth_to_points[vase.solid]
    radius = np.hypot(points[:, 0], points[:, 1])
    _, nearest = cKDTree(silhouette.points).query(np.stack([radius, points[:, 2]], -1))
    outward, upward = silhouette.normals[nearest].T
    exact = np.column_stack([outward[:, None] * points[:, :2] / radius[:, None], upward])
    found = vase.view.normals_world[vase.solid]
    exact *= np.sign(np.sum(exact * found, -1, keepdims=True))  # The inside of the vase is seen too.
    error_deg = np.degrees(np.arctan2(np.linalg.norm(np.cross(exact, found), axis=-1), np.sum(exact * found, -1)))
    # Measured 0.014° at 128 pixels (the mean over a pixel against its center), 0.008° at 400.
    assert np.median(error_deg) < 0.05


def test_depth_of_a_tilted_plane_is_along_the_optical_axis(plane: Rendered) -> None:
    normal = np.array([1.0, 0.5, 0.4])
    rays, position = ray_directions_world(plane.camera), plane.camera.position_world
    distance = -(position @ normal) / (rays @ normal)
    depth = distance * (rays @ plane.camera.camera_to_world[:3, 2])
    solid = plane.solid
    assert solid.sum() > 100
    # Over a pixel, depth averages to that of the center but for sampling; measured 0.0052 where it recedes fastest.
    np.testing.assert_allclose(plane.view.depth[solid], depth[solid], atol=1e-2)
    # Distance from the camera would be distinguished.
    assert np.abs(distance - depth)[solid].max() > 0.1
    np.testing.assert_allclose(plane.view.normals_world[solid] @ normal, np.linalg.norm(normal), rtol=1e-5)


def test_points_of_a_sphere_lie_on_it(sphere: Rendered) -> None:
    inner = sphere.solid & (np.sum(sphere.view.normals_world * -ray_directions_world(sphere.camera), -1) > 0.5)
    points = sphere.center_depth_to_points[inner]
    # The mean depth of a pixel of a curved surface lies behind that of its center; measured 0.0009.
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1), 1, atol=4e-3)
    # Measured 0.0009.
    np.testing.assert_allclose(points, sphere.view.normals_world[inner], atol=5e-3)


def test_alpha_is_the_covered_area(sphere: Rendered) -> None:
    """The silhouette of the unit sphere is a cone of half-angle asin(1/d) about the axis: a disk in the image."""
    distance = np.linalg.norm(sphere.camera.position_world)
    radius = sphere.camera.fx / np.sqrt(distance**2 - 1)
    # Measured 0.03% off; a filter wider than a pixel would show in the next test, not here.
    assert sphere.view.alpha.sum() == pytest.approx(np.pi * radius**2, rel=5e-3)


def test_a_pixel_averages_its_own_area_alone(sphere: Rendered) -> None:
    x = np.arange(sphere.camera.width) + 0.5 - sphere.camera.cx
    distance = np.linalg.norm(sphere.camera.position_world)
    radius = sphere.camera.fx / np.sqrt(distance**2 - 1)
    offset = np.hypot(*np.meshgrid(x, x)) - radius
    half_diagonal = np.sqrt(0.5)
    assert (sphere.view.alpha[offset < -half_diagonal - 0.02] == 1).all()
    assert (sphere.view.alpha[offset > half_diagonal] == 0).all()


def test_what_is_not_the_object_is_zero(rendered: Rendered) -> None:
    view = rendered.view
    outside, inside = view.alpha == 0, view.alpha > 0
    assert outside.any()
    for array in (view.radiance, view.normals_world, view.depth):
        assert (array[outside] == 0).all()
        assert np.isfinite(array).all()
    assert (view.depth[inside] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(view.normals_world[inside], axis=-1), 1, atol=1e-6)
    facing = np.sum(view.normals_world * ray_directions_world(rendered.camera), -1)
    assert facing[inside].max() < 0.02


def test_nothing_is_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    spec = tiny_scene(tmp_path)
    with open_renderer(spec) as renderer:
        renderer.render(plan_cameras(spec.camera, spec.render.resolution).train[0])
    assert capfd.readouterr() == ("", "")


BOWL = '{ kind = "surface_of_revolution", profile = [[0.9, 0.5], [0.8, -0.1], [0.5, -0.4], [0.0, -0.5]] }'


def test_max_bounces_is_the_recipe_s(tmp_path: Path) -> None:
    """Without a bounce after the first reflection a bowl is black where it mirrors itself, and elsewhere the same."""
    from scipy.ndimage import binary_erosion

    spec = tiny_scene(tmp_path, shape=BOWL, elevation="[45, 55]", samples=16, resolution=48)
    camera = plan_cameras(spec.camera, spec.render.resolution).train[0]

    def render(bounces: int, path_traced: bool = False) -> RenderedView:
        limited = replace(spec, render=replace(spec.render, max_bounces=bounces))
        with open_renderer(limited, path_traced=path_traced) as renderer:
            assert (renderer.mirror is None) == (path_traced or bounces > 21), "Paths count up to 22 reflections."
            return renderer.render(camera)

    many, none, traced, more = render(16), render(0), render(0, path_traced=True), render(64)
    # Away from the edges of what is mirrored, where pixels hold some of both.
    inner, outer = (binary_erosion((many.alpha == 1) & (many.self_reflection == each)) for each in (1, 0))
    assert min(inner.sum(), outer.sum()) > 20
    assert (many.radiance[inner].mean(-1) > 0.1).all()
    np.testing.assert_allclose(more.radiance[inner].mean(), many.radiance[inner].mean(), rtol=0.02)
    for single in (none, traced):
        assert (single.radiance[inner] == 0).mean() > 0.95
        assert np.median(np.abs(single.radiance - many.radiance)[outer]) < 1e-2


def test_a_world_that_dips_below_zero_gives_no_negative_light(tmp_path: Path) -> None:
    """Compression leaves such values in Blender's own maps; the stored environment has none either."""
    spec = tiny_scene(tmp_path)
    write_exr_rgb(tmp_path / "dark.exr", np.full((8, 16, 3), -0.005, np.float32))
    dark = override(spec, world=str(tmp_path / "dark.exr"))
    with open_renderer(dark, path_traced=True) as renderer:
        view = renderer.render(plan_cameras(dark.camera, dark.render.resolution).train[0])
    assert view.alpha.max() == 1
    assert (view.radiance == 0).all()
