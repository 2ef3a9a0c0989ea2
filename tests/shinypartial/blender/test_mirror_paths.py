"""Perfect mirrors without path tracing: the picture that path tracing gives, and no lamp lost or counted twice."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float

from shinypartial.blender import render as render_module
from shinypartial.blender.directions import GRID, LOST, MARKED, MISSED, MirrorPaths, render_directions
from shinypartial.blender.footprint import FarWorld, smooth_light
from shinypartial.blender.passes import PASSES
from shinypartial.blender.region import image_region
from shinypartial.blender.render import MOST_SAMPLES_OF_MIRRORS, Renderer, open_renderer
from shinypartial.blender.runtime import quiet
from shinypartial.blender.sparse_pixels import nearest_depth, render_sparse
from shinypartial.core.camera import Camera, opencv_to_opengl, ray_directions_world, reflect
from shinypartial.core.sphere import directions_to_latlong, latlong_directions, latlong_solid_angles, sample_latlong
from shinypartial.core.trajectory import plan_cameras
from shinypartial.io.images import write_exr_rgb
from shinypartial.scene import Frame, Material, Part, SceneSpec, Sphere, load_scene, override
from tests.support.tiny_scene import tiny_scene

HEIGHT = 64
RESOLUTION = 40
LAMP = 1e4


def paths_of(directions: Float[np.ndarray, "h w 3"]) -> MirrorPaths:
    """Paths of one reflection each."""
    shape = directions.shape[:2]
    unit = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)
    nothing = np.zeros(shape, np.float32)
    return MirrorPaths(np.ones(shape, np.int32), unit, np.zeros_like(unit), nothing, np.zeros(shape, bool))


def sweep(pixels: int, half_width: float, shift: tuple[float, float]) -> tuple[MirrorPaths, np.ndarray]:
    """Directions over a square of the plane x = 1, and the solid angle of each pixel."""
    fine = ((np.arange(GRID * pixels) + 0.5) / (GRID * pixels) * 2 - 1) * half_width
    y, z = np.meshgrid(fine + shift[0], fine + shift[1])
    cosine = (1 + y**2 + z**2) ** -0.5
    solid = cosine**3 * (2 * half_width / (GRID * pixels)) ** 2
    return paths_of(np.stack([np.ones_like(y), y, z], -1)), solid.reshape(pixels, GRID, pixels, GRID).sum((1, 3))


@cache
def one_lamp() -> tuple[Float[np.ndarray, "H 2*H 3"], float]:
    """A dark map but for one texel, and the light of its first channel, ∫ L dω."""
    latlong = np.zeros((HEIGHT, 2 * HEIGHT, 3), np.float32)
    latlong[HEIGHT // 2, HEIGHT] = LAMP
    fine = 16 * HEIGHT
    shown = sample_latlong(latlong[..., :1], latlong_directions(fine))[..., 0]
    return latlong, float((shown * latlong_solid_angles(fine)).sum())


@given(seed=st.integers(0, 2**31))
def test_the_far_world_is_the_lat_long_map(seed: int) -> None:
    random = np.random.default_rng(seed)
    latlong = random.random((8, 16, 3), np.float32)
    directions = random.normal(size=(200, 3)).astype(np.float32)
    # Single precision of the place in the map.
    np.testing.assert_allclose(FarWorld(latlong)(directions), sample_latlong(latlong, directions), atol=2e-5)


@given(dx=st.floats(-0.05, 0.05), dy=st.floats(-0.05, 0.05))
def test_a_lamp_of_one_texel_keeps_its_energy_wherever_it_falls(dx: float, dy: float) -> None:
    """Σ pixel radiance · pixel solid angle = ∫ L dω, though a pixel spans many times the lamp."""
    latlong, energy = one_lamp()
    paths, solid = sweep(9, 1.0, (dx, dy))
    light = smooth_light(FarWorld(latlong), paths)
    found = (light.radiance[..., 0] * solid).sum()
    # Half a texel or less apart, directions catch a bilinear texel to 2/(2.5π)² = 3.3 % in either axis; measured 6.7 %.
    assert found == pytest.approx(energy, rel=0.08)


def test_points_alone_would_lose_it() -> None:
    """What the previous theorem would be worth nothing without."""
    latlong, _ = one_lamp()
    sums = []
    for shift in np.linspace(-0.05, 0.05, 9):
        paths, solid = sweep(9, 1.0, (shift, shift))
        points = sample_latlong(latlong, paths.directions_world)[..., 0].reshape(9, GRID, 9, GRID).mean((1, 3))
        sums.append((points * solid).sum())
    assert max(sums) > 1.3 * min(sums)


@pytest.mark.parametrize("other", [MISSED, LOST, MARKED, 2])
def test_a_pixel_with_another_kind_of_path_in_or_beside_it_is_not_smooth(other: int) -> None:
    paths, _ = sweep(5, 0.2, (0.0, 0.0))
    bounces = paths.bounces.copy()
    bounces[GRID * 2 : GRID * 3, GRID * 2] = other
    smooth = smooth_light(FarWorld(np.ones((8, 16, 3), np.float32)), replace(paths, bounces=bounces)).smooth
    assert smooth[1:4, 3].all()
    assert not smooth[2, 1:3].any()
    assert not smooth[0].any(), "Nothing is known beyond the edge."


def test_a_sudden_turn_is_not_smooth() -> None:
    paths, _ = sweep(5, 0.2, (0.0, 0.0))
    directions = paths.directions_world.copy()
    directions[:, 2 * GRID :] *= (-1, 1, 1)
    light = smooth_light(FarWorld(np.ones((8, 16, 3), np.float32)), replace(paths, directions_world=directions))
    assert light.smooth[1:4, 3].all()
    assert not light.smooth[1:4, 1:3].any()


@pytest.fixture(scope="module")
def lit(tmp_path_factory: pytest.TempPathFactory) -> SceneSpec:
    """A mirror sphere before a rough ring that it reflects, in a colored world with a small lamp."""
    pytest.importorskip("bpy")
    folder = tmp_path_factory.mktemp("lit")
    spec = tiny_scene(folder, samples=128, resolution=RESOLUTION)
    latlong = ((latlong_directions(HEIGHT) + 1) / 2).astype(np.float32)
    uv = directions_to_latlong(np.array([0.8, -0.3, 0.5]))
    latlong[int(uv[1] * HEIGHT), int(uv[0] * 2 * HEIGHT)] = 3.0
    write_exr_rgb(folder / "world.exr", latlong)
    ring = Frame(profile=((0.0, -0.2), (0.0, 0.2), (0.3, 0.2)), size=(3.0, 3.0), normal=(1.0, 0.0, 0.0))
    return replace(spec, props=(Part(ring, Material((0.5, 0.3, 0.1), 0.0, 0.5)),))


def camera_of(spec: SceneSpec) -> Camera:
    return plan_cameras(spec.camera, spec.render.resolution).train[0]


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt((difference**2).mean()))


def test_the_picture_is_that_of_path_tracing(lit: SceneSpec) -> None:
    """Every pass, against 1,024 samples, no farther than 128 samples of path tracing are but for chance."""
    camera = camera_of(lit)
    with open_renderer(lit) as renderer:
        assert renderer.mirror
        ours = renderer.render(camera)
    with open_renderer(lit, path_traced=True) as renderer:
        assert not renderer.mirror
        traced = renderer.render(camera)
        renderer.bpy.context.scene.cycles.samples, renderer.bpy.context.scene.cycles.seed = 1024, 7
        truth = renderer.render(camera)
    np.testing.assert_array_equal(ours.self_reflection, truth.self_reflection)
    assert truth.self_reflection.sum() > 20, "The sphere reflects the ring."
    for name in ("alpha", "normals_world", "depth"):
        inside = truth.alpha > 0.5
        errors = [rms((getattr(each, name) - getattr(truth, name))[inside]) for each in (ours, traced)]
        assert errors[0] < 1.5 * errors[1], name
    errors = [rms(np.clip(each.radiance, 0, 1) - np.clip(truth.radiance, 0, 1)) for each in (ours, traced)]
    assert errors[0] < 1.1 * errors[1]


def test_a_wide_view_is_the_middle_of_a_square_one(lit: SceneSpec) -> None:
    """As a film has it, before and after one of the recipe's size; silhouettes are path traced, by chance."""
    square = camera_of(lit)
    wide = replace(square, cy=square.cy - 5, height=square.height - 10)
    with open_renderer(replace(lit, props=())) as renderer:
        assert renderer.mirror
        views = [renderer.render(camera) for camera in (wide, square, wide)]
    seen = views[1].alpha[5:-5] > 0
    for view in (views[0], views[2]):
        for name in ("radiance", "alpha", "normals_world", "depth"):
            error = np.abs(getattr(view, name) - getattr(views[1], name)[5:-5])[seen]
            assert np.median(error) < 1e-5, name
        # Measured 0.006 with 16 samples.
        assert np.abs(view.alpha - views[1].alpha[5:-5])[seen].mean() < 0.02


def test_picked_pixels_are_those_of_the_whole_view(lit: SceneSpec) -> None:
    """In all passes, whatever the material, where chance leaves them the same: the mean difference is none."""
    camera = camera_of(lit)
    with open_renderer(lit) as renderer:
        whole = renderer.bpy.context.scene
        view = renderer._path_traced(place(renderer, camera), image_region(camera, renderer.body_vertices_world))
        chosen = view.alpha > 0
        assert renderer.mirror
        depth = nearest_depth(camera, renderer.mirror.vertices_world)
        with quiet():
            picked = render_sparse(renderer.bpy, renderer.scratch / "picked.exr", chosen, depth)
        assert whole.name != "picked"
    assert set(PASSES) <= picked.keys()
    # Both sample 128 times: at the silhouette, alpha differs by about 0.02 a pixel.
    np.testing.assert_allclose(picked["Combined.A"], view.alpha[chosen], atol=0.1)
    assert picked["Combined.A"].mean() == pytest.approx(view.alpha[chosen].mean(), abs=1e-3)
    green = np.clip(picked["Combined.G"], 0, 1), np.clip(view.radiance[chosen][:, 1], 0, 1)
    assert np.median(np.abs(green[0] - green[1])) < 2e-3
    assert green[0].mean() == pytest.approx(green[1].mean(), abs=2e-3)
    solid = view.alpha[chosen] == 1
    np.testing.assert_allclose(picked["z_depth.X"][solid], view.depth[chosen][solid], atol=0.05)


def place(renderer: Renderer, camera: Camera) -> Camera:
    """Move Blender's camera there."""
    renderer.bpy.context.scene.camera.matrix_world = opencv_to_opengl(camera.camera_to_world).T.tolist()
    return camera


def test_paths_of_a_sphere_are_its_mirror_rays(lit: SceneSpec) -> None:
    spec = replace(lit, props=())
    camera = camera_of(spec)
    with open_renderer(spec) as renderer:
        region = image_region(place(renderer, camera), renderer.body_vertices_world)
        with quiet():
            paths = render_directions(renderer.bpy, renderer.scratch / "directions.exr", region, camera)
    assert paths.bounces.shape == (GRID * (region.bottom - region.top), GRID * (region.right - region.left))
    fine = replace(
        camera,
        fx=GRID * camera.fx,
        fy=GRID * camera.fy,
        cx=GRID * (camera.cx - region.left),
        cy=GRID * (camera.cy - region.top),
        height=paths.bounces.shape[0],
        width=paths.bounces.shape[1],
    )
    expected = reflect(ray_directions_world(fine), paths.normals_world)
    once = paths.bounces == 1
    assert once.sum() > 1000
    assert set(np.unique(paths.bounces)) == {MISSED, 1}
    # Measured 4e-6.
    np.testing.assert_allclose(paths.directions_world[once], expected[once], atol=5e-5)
    assert not paths.meets_scene.any()


FALLBACKS = {
    "rough": {"roughness": 0.2},
    "tinted": {"base_color": (0.9, 1.0, 1.0)},
    "no metal": {"metallic": 0.5},
    "near room": {"surroundings_distance": 5.0},
    "near box": {"surroundings_radii": 5.0, "surroundings_room": "box"},
    "operator": {"operator_height": 1.0},
    "aperture": {"f_number": 2.8},
    "motion": {"motion_deg": 1.0},
    "many samples": {"samples": MOST_SAMPLES_OF_MIRRORS + 1},
}


@pytest.mark.parametrize("options", FALLBACKS.values(), ids=FALLBACKS.keys())
def test_what_is_no_perfect_mirror_in_a_far_world_is_path_traced(options: dict) -> None:
    pytest.importorskip("bpy")
    spec = override(load_scene("sphere"), resolution=16, **options)
    with open_renderer(spec) as renderer:
        assert renderer.mirror is None
        scenes = {each.name for each in renderer.bpy.data.scenes}
    assert not scenes & {"directions", "picked"}


def test_an_object_that_is_mostly_diffuse_is_path_traced() -> None:
    pytest.importorskip("bpy")
    with open_renderer(override(load_scene("teapot"), resolution=16)) as renderer:
        assert renderer.mirror is None


def test_a_camera_beside_a_prop_gets_a_path_traced_view(lit: SceneSpec) -> None:
    """Where something reaches behind the camera, no plane fits before it."""
    behind = Part(Sphere(radius=0.1), Material(roughness=1.0))
    spec = replace(lit, props=(behind,), render=replace(lit.render, samples=1))
    camera = camera_of(spec)
    near = replace(camera, camera_to_world=camera.camera_to_world.copy())
    near.camera_to_world[:3, 3] = 0.0
    with open_renderer(spec) as renderer:
        assert renderer.render(near).alpha.shape == (RESOLUTION, RESOLUTION)


def test_a_pixel_that_got_the_sample_of_another_place_is_traced_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = tiny_scene(tmp_path, resolution=32, samples=64)
    camera = plan_cameras(spec.camera, spec.render.resolution).train[0]
    traced: list[int] = []

    def mixed_up_at_first(bpy, path, chosen, depth):
        passes = render_sparse(bpy, path, chosen, depth)
        traced.append(int(chosen.sum()))
        if len(traced) == 1:  # The pixel of least alpha gets one sample of a normal that can't be seen there.
            number = np.argmin(passes["Combined.A"])
            away = ray_directions_world(camera)[chosen][number] / spec.render.samples
            for channel, value in zip("XYZ", away, strict=True):
                passes[f"Normal.{channel}"][number] = value
            passes["Combined.A"][number] = 1 / spec.render.samples
        return passes

    with open_renderer(spec) as renderer:
        expected = renderer.render(camera)
        monkeypatch.setattr(render_module, "render_sparse", mixed_up_at_first)
        view = renderer.render(camera)
    assert traced[0] > 10
    assert traced[1:] == [1]
    # Its samples lie elsewhere in the pixel than before; measured one of 64.
    np.testing.assert_allclose(view.alpha, expected.alpha, atol=0.1)
    assert np.sum(view.normals_world * ray_directions_world(camera), -1).max() < 0.02
