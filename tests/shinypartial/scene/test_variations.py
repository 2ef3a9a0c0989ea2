"""Scenes varied from the command line: each option does what it says to the picture, and enters the recipe."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shinypartial.blender.assemble import world_radiance
from shinypartial.blender.render import RenderedView, open_renderer
from shinypartial.core.camera import ray_directions_world, reflect
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import sample_latlong
from shinypartial.core.trajectory import plan_cameras
from shinypartial.io.images import write_exr_rgb
from shinypartial.scene import STUDIO_LIGHTS, Room, SceneSpec, load_scene, override, variant_name
from shinypartial.scene.spec import World
from tests.support.tiny_scene import tiny_scene

OPTIONS = {
    "world": "night",
    "surroundings_distance": 5.0,
    "operator_height": 1.8,
    "f_number": 2.8,
    "motion_deg": 2.0,
    "exposure": 1.0,
    "roughness": 0.3,
    "base_color": (0.9, 0.5, 0.2),
    "metallic": 0.5,
    "deformation": 0.05,
    "object_scale": 0.7,
}


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> SceneSpec:
    """A mirror sphere in a world whose color is its direction."""
    return tiny_scene(tmp_path_factory.mktemp("sphere"), resolution=32, samples=32)


def render(spec: SceneSpec, **options) -> RenderedView:
    pytest.importorskip("bpy")
    varied = override(spec, **options)
    with open_renderer(varied) as renderer:
        return renderer.render(plan_cameras(varied.camera, varied.render.resolution).train[0])


def parallax(spec: SceneSpec, distance: float) -> float:
    """Median difference from what the far field would show."""
    view = render(spec, surroundings_distance=distance)
    camera = plan_cameras(spec.camera, spec.render.resolution).train[0]
    expected = sample_latlong(world_radiance(spec.world), reflect(ray_directions_world(camera), view.normals_world))
    return float(np.median(np.abs(view.radiance - expected)[view.alpha > SOLID_ALPHA]))


@pytest.mark.parametrize("option", OPTIONS)
def test_each_option_enters_recipe_and_folder_name(option: str) -> None:
    vase = load_scene("vase")
    varied = override(vase, **{option: OPTIONS[option]})
    assert varied.recipe() != vase.recipe()
    assert variant_name(vase, varied) != variant_name(vase, vase) == "vase-800"


def test_no_option_changes_nothing() -> None:
    vase = load_scene("vase")
    assert override(vase, **dict.fromkeys(OPTIONS)) == vase


def test_a_room_in_radii_grows_with_the_object_and_takes_the_place_of_one_in_scene_units() -> None:
    sphere = load_scene("sphere")
    near = override(sphere, surroundings_radii=10.0, object_scale=0.5)
    assert near.room is not None
    assert near.room.distance == pytest.approx(10 * 0.5 * sphere.object.extent)
    assert override(near, surroundings_distance=4.0).room == Room("sphere", 4.0, World.proportions)
    assert override(near, world="night").room == near.room


@given(chosen=st.lists(st.sampled_from(sorted(OPTIONS)), unique=True))
def test_different_variations_have_different_names(chosen: list[str]) -> None:
    vase = load_scene("vase")
    varied = override(vase, **{key: OPTIONS[key] for key in chosen})
    assert variant_name(vase, varied).count("-") >= 1 + len(chosen)


BAD = {
    "unknown world": ({"world": "kitchen"}, "--world"),
    "missing file": ({"world": "none.exr"}, "not there"),
    "room inside the object": ({"surroundings_distance": 0.5}, "world.distance"),
    "two distances": ({"surroundings_distance": 5.0, "surroundings_radii": 5.0}, "world.distance.*both"),
    "less than a radius": ({"surroundings_radii": 0.5}, "world.distance_radii"),
    "one radius": ({"surroundings_radii": 1.0}, "world.distance_radii"),
    "box infinitely far": ({"surroundings_room": "box"}, "world.room"),
    "unknown room": ({"surroundings_distance": 5.0, "surroundings_room": "tent"}, "world.room"),
    "proportions of a sphere": (
        {"surroundings_distance": 5.0, "surroundings_proportions": (1.0, 2.0, 1.0)},
        "world.proportions",
    ),
    "flat box": (
        {"surroundings_distance": 5.0, "surroundings_room": "box", "surroundings_proportions": (1.0, 0.0, 1.0)},
        "world.proportions.1",
    ),
    "operator without height": ({"operator_radiance": 0.1}, "operator.height"),
    "operator without size": ({"operator_height": 0.0}, "operator.height"),
    "operator darker than black": ({"operator_height": 1.8, "operator_radiance": -0.1}, "operator.radiance"),
    "operator in the wall": ({"operator_height": 1.8, "surroundings_distance": 3.3}, "operator.height.*room"),
    "feet in the wall": ({"operator_height": 8.0, "surroundings_distance": 6.0}, "operator.height.*room"),
    "operator in the object": ({"operator_height": 20.0}, "operator.height.*beside"),
    "aperture without end": ({"f_number": 0.0}, "camera.f_number"),
    "focus of a pinhole": ({"focus_distance": 3.0}, "camera.focus_distance"),
    "focus behind the camera": ({"f_number": 2.8, "focus_distance": -1.0}, "camera.focus_distance"),
    "motion backward": ({"motion_deg": -1.0}, "camera.motion_deg"),
    "half a turn": ({"motion_deg": 180.0}, "camera.motion_deg"),
    "negative distance": ({"surroundings_distance": -3.0}, "world.distance"),
    "rough": ({"roughness": 1.5}, "material.roughness"),
    "color": ({"base_color": (0.0, 2.0, 0.0)}, "material.base_color.1"),
    "metallic": ({"metallic": float("nan")}, "material.metallic"),
    "deformation": ({"deformation": -1.0}, "deformation.amplitude"),
    "scale of zero": ({"object_scale": 0.0}, "scale"),
    "too large for the cameras": ({"object_scale": 5.0}, "camera.radius"),
    "exposure": ({"exposure": 100.0}, "render.exposure"),
}


@pytest.mark.parametrize(("options", "named"), BAD.values(), ids=BAD.keys())
def test_bad_options_are_named(options: dict, named: str) -> None:
    with pytest.raises(InputError, match=named):
        override(load_scene("vase"), **options)


@pytest.mark.parametrize("name", STUDIO_LIGHTS)
def test_each_shipped_world_can_be_read(name: str) -> None:
    pytest.importorskip("bpy")
    assert world_radiance(override(load_scene("sphere"), world=name).world).shape == (512, 1024, 3)


def test_a_world_of_ones_own_lights_the_scene(sphere: SceneSpec, tmp_path: Path) -> None:
    write_exr_rgb(tmp_path / "mine.exr", np.full((8, 16, 3), (0.25, 0.5, 2.0), np.float32))
    view = render(sphere, world=str(tmp_path / "mine.exr"))
    # Half precision of the file is exact for these values.
    found = view.radiance[view.alpha == 1]
    np.testing.assert_allclose(found, np.broadcast_to([0.25, 0.5, 2.0], found.shape), rtol=1e-4)


def test_a_near_room_shows_parallax_that_vanishes_with_distance(sphere: SceneSpec) -> None:
    """The color is half the direction, and a point of the unit sphere sees the room turned by up to 1/distance."""
    near, far, farther = (parallax(sphere, distance) for distance in (2.0, 20.0, 2000.0))
    assert near > 0.05
    assert 0.002 < far < near / 5
    assert farther < 0.002


def test_exposure_multiplies_pictures_and_the_stored_map_alike(sphere: SceneSpec) -> None:
    plain, brighter = render(sphere), render(sphere, exposure=2.0)
    np.testing.assert_allclose(brighter.radiance, 4 * plain.radiance, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(world_radiance(sphere.world, 2.0), 4 * world_radiance(sphere.world))


def test_roughness_blurs(sphere: SceneSpec, tmp_path: Path) -> None:
    checks = (np.indices((16, 32)).sum(0) % 2)[..., None] * np.ones(3, np.float32)
    write_exr_rgb(tmp_path / "checks.exr", checks.astype(np.float32))
    sharp, rough = (render(sphere, world=str(tmp_path / "checks.exr"), roughness=r) for r in (0.0, 0.5))
    solid = sharp.alpha > SOLID_ALPHA
    assert rough.radiance[solid].std() < 0.5 * sharp.radiance[solid].std()


def test_color_tints_and_metal_gives_way_to_diffuse_light(sphere: SceneSpec) -> None:
    plain, red = render(sphere), render(sphere, base_color=(0.5, 0.0, 0.0))
    solid = plain.alpha > SOLID_ALPHA
    assert np.median((red.radiance / np.maximum(plain.radiance, 1e-3))[solid][:, 0]) == pytest.approx(0.5, abs=0.05)
    matte = render(sphere, metallic=0.0, roughness=1.0)
    assert matte.radiance[solid].std() < plain.radiance[solid].std()


def test_scale_changes_the_silhouette_by_its_square(sphere: SceneSpec) -> None:
    distance = sphere.camera.radius
    plain, half = render(sphere).alpha.sum(), render(sphere, object_scale=0.5).alpha.sum()
    # A sphere of radius r covers a disk of radius f r/√(d² − r²); measured 0.3 % off.
    assert half / plain == pytest.approx(0.25 * (distance**2 - 1) / (distance**2 - 0.25), rel=0.02)


def test_deformation_turns_normals_and_is_seeded(sphere: SceneSpec) -> None:
    plain, bumpy, again = render(sphere), render(sphere, deformation=0.02), render(sphere, deformation=0.02)
    both = (plain.alpha > SOLID_ALPHA) & (bumpy.alpha > SOLID_ALPHA)
    angle = np.degrees(np.arccos(np.clip(np.sum(plain.normals_world * bumpy.normals_world, -1), -1, 1)))[both]
    # The slope of 2 cm bumps every 80 cm is about 2π · 0.02/0.8 rad = 9°.
    assert 3 < np.median(angle) < 20
    np.testing.assert_allclose(bumpy.normals_world, again.normals_world, atol=1e-5)
    assert bumpy.self_reflection.sum() < plain.alpha.sum() / 20
