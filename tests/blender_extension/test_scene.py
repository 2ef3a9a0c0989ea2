"""What a prediction becomes in Blender, against photographs that were traced without it."""

import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shinypartial.conversion.extension import blender_camera, found_cameras
from shinypartial.core.camera import Camera, look_at, project
from shinypartial.core.color import srgb_to_linear
from shinypartial.core.sphere import latlong_directions
from shinypartial.dataset.read import read_view
from shinypartial.dataset.schema import Dataset
from shinypartial.io.images import read_exr, stack_channels, write_png
from shinypartial.prediction.format import (
    FoundCamera,
    FoundFloor,
    NearSurroundings,
    read_environment_map,
    read_info,
    write_environment_map,
    write_info,
    write_inverse_distance,
    write_visibility,
)

Render = Callable[..., np.ndarray]
pytestmark = pytest.mark.usefixtures("programs")


def imported(bpy: Any, prediction: Path) -> Any:
    """The scene of a prediction."""
    assert bpy.ops.panoless.import_prediction(filepath=str(prediction / "prediction.json")) == {"FINISHED"}
    return bpy.context.scene


def no_ground(scene: Any) -> None:
    scene.objects["PanoLess ground"].hide_render = True


def test_a_mirror_looks_as_in_its_photographs(
    blender: Any, prediction: Path, ball_dataset: Dataset, picture: Render
) -> None:
    """To 40 dB and more: the photographs have 5×5 points a pixel, and the map has texels."""
    scene = imported(blender, prediction)
    no_ground(scene)
    from blender_extension.build import photograph_cameras, show_photograph

    cameras = photograph_cameras(scene)
    assert [each.name for each in cameras] == [f"PanoLess camera {frame.stem.name}" for frame in ball_dataset.train]
    for camera, frame in zip(cameras, ball_dataset.train, strict=True):
        show_photograph(scene, camera)
        found, truth = picture(blender), read_view(frame)
        assert found.shape[:2] == truth.alpha.shape
        assert np.abs(found[..., 3] - truth.alpha).mean() < 3e-3
        solid = truth.alpha > 0.99
        error = (found[..., :3] - truth.radiance)[solid].clip(-1, 1)
        assert -10 * np.log10((error**2).mean()) > 40


LENSES = {
    "off center": (150.0, 150.0, 70.0, 20.0, 96, 64),
    "upright": (150.0, 150.0, 30.0, 50.0, 48, 96),
    "wide pixels": (150.0, 100.0, 40.0, 40.0, 96, 64),
    "high pixels": (100.0, 150.0, 40.0, 40.0, 96, 64),
}


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
def test_points_project_to_the_same_pixels(lens: tuple, blender: Any, tmp_path: Path) -> None:
    """Blender's own projection against ours."""
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    from blender_extension.build import _add_camera, show_photograph

    camera = Camera(look_at(np.array([3.0, 2.0, 1.0]), np.array([0.2, 0.1, 0.0])), *lens)
    write_png(tmp_path / "one.png", np.zeros((camera.height, camera.width, 3), np.uint8))
    scene = blender.context.scene
    stated = asdict(blender_camera("one", tmp_path / "one.png", camera))
    _add_camera(scene.collection, stated, Vector(), 1.0)
    show_photograph(scene, scene.objects["PanoLess camera one"])
    blender.context.view_layer.update()
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    seen = np.array([world_to_camera_view(scene, scene.camera, Vector(point)) for point in points])
    pixels = seen[:, :2] * [camera.width, -camera.height] + [0, camera.height]
    np.testing.assert_allclose(pixels, project(camera, points)[:, :2], atol=2e-3)


def test_cameras_stand_where_the_fit_found_them(prediction: Path, ball_dataset: Dataset) -> None:
    """A dataset turned wrongly is turned back."""
    truth = ball_dataset.train
    wrong = []
    for frame in truth:
        pose = frame.camera.camera_to_world.copy()
        quarter = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # −90° about Z.
        pose[:3, :3] = quarter @ pose[:3, :3]
        pose[:3, 3] -= [0.1, 0.2, 0.3]
        wrong.append(replace(frame, camera=replace(frame.camera, camera_to_world=pose)))
    found = tuple(FoundCamera(frame.name, (0.0, 0.0, 90.0), (0.1, 0.2, 0.3)) for frame in truth)
    info = replace(read_info(prediction), cameras=found)
    for camera, frame in zip(found_cameras(info, wrong), truth, strict=True):
        np.testing.assert_allclose(camera.camera_to_world, frame.camera.camera_to_world, atol=1e-12)


def seen_along(bpy: Any, direction: tuple[float, float, float], picture: Render) -> np.ndarray:
    """What a narrow camera at the origin sees, without objects."""
    from mathutils import Vector

    scene = bpy.context.scene
    for each in scene.objects:
        each.hide_render = True
    eye = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    eye.data.angle = np.radians(1.0)
    eye.rotation_euler = Vector(direction).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(eye)
    scene.camera, scene.render.film_transparent = eye, False
    scene.render.resolution_x = scene.render.resolution_y = 4
    return picture(bpy, samples=4)[..., :3].mean((0, 1))


def test_the_light_turns_and_unseen_directions_are_shown(blender: Any, prediction: Path, picture: Render) -> None:
    """The light of +X is seen along +Y after a quarter turn; what was not seen is filled, gray, or of a color."""
    directions = latlong_directions(64)
    x_axis, up = directions[..., 0] > 0.9, directions[..., 2] > 0.5
    radiance = np.where(x_axis[..., None], [4.0, 2.0, 1.0], np.where(up[..., None], [0.0, 8.0, 0.0], 0.25))
    write_environment_map(prediction, radiance.astype(np.float32))
    write_visibility(prediction, np.where(up, 0.0, 1.0))
    scene, settings = imported(blender, prediction), blender.context.scene.panoless
    settings.rotation, settings.strength = np.pi / 2, 2.0
    np.testing.assert_allclose(seen_along(blender, (0, 1, 0), picture), [8.0, 4.0, 2.0], rtol=1e-2)
    np.testing.assert_allclose(seen_along(blender, (0.2, 0.1, -1), picture), 0.5, rtol=1e-2)
    above = 0.2, 0.1, 1.0  # Beside the pole, about which Blender blends the first row of a map with the last.
    filled = seen_along(blender, above, picture)
    assert 0.4 < filled[1] < 8.0, "Filled from around, not the 16 that nobody saw."
    settings.unseen, settings.unseen_color = "COLOR", (1.0, 0.0, 0.5)
    np.testing.assert_allclose(seen_along(blender, above, picture), [2.0, 0.0, 1.0], rtol=1e-2, atol=1e-3)
    settings.unseen = "GRAY"
    gray = seen_along(blender, above, picture)
    assert np.ptp(gray) < 1e-3 * gray.max()
    assert 0.5 < gray[0] < 2.0, "Twice the mean of what was seen."
    settings.unseen = "BLURRED"
    assert scene.world.node_tree.nodes["Light"].image.name.endswith("light_blurred.exr")


def test_near_walls_move_with_the_place(blender: Any, prediction: Path, picture: Render) -> None:
    """A mirror by a wall at 3 radii shows each point of the wall where it is: the map's direction is that from the
    origin, and a far world would show another color.
    """
    height = 64
    radiance = ((latlong_directions(height) + 1) / 2).astype(np.float32)
    write_environment_map(prediction, radiance)
    write_visibility(prediction, np.ones(radiance.shape[:2]))
    write_inverse_distance(prediction, np.full(radiance.shape[:2], 1 / 3))
    scene = imported(blender, prediction)
    no_ground(scene)
    scene.objects["PanoLess mirror"].hide_render = True
    walls = scene.objects["PanoLess walls"]
    assert not walls.visible_camera
    walls.visible_camera = True
    from mathutils import Vector

    eye = blender.data.objects.new("eye", blender.data.cameras.new("eye"))
    eye.data.angle, eye.location = np.radians(1.0), (0.0, 1.5, 0.0)
    eye.rotation_euler = Vector((1, 0, 0)).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(eye)
    scene.camera, scene.render.resolution_x, scene.render.resolution_y = eye, 4, 4
    meets = np.array([np.sqrt(9 - 1.5**2), 1.5, 0.0]) / 3
    found = picture(blender, samples=8)[..., :3].mean((0, 1))
    np.testing.assert_allclose(found, (meets + 1) / 2, atol=5e-3)


def test_the_ground_is_where_the_fit_found_it(blender: Any, prediction: Path) -> None:
    """A floor 1.25 below the origin and a world infinitely far; without one, a plane below the object."""
    from blender_extension.build import ground_of

    np.testing.assert_allclose(ground_of(imported(blender, prediction)).matrix_world.translation.z, -1, atol=1e-6)
    down = -latlong_directions(64)[..., 2]
    inverse = np.where(down > 0.4, down, 0) / 1.25
    write_inverse_distance(prediction, inverse)
    floor = NearSurroundings("sphere", None, None, [], FoundFloor((0.0, 0.0, 1.0), 1.25, 3.0))
    write_info(prediction, replace(read_info(prediction), surroundings=floor))
    scene = imported(blender, prediction)
    ground = ground_of(scene)
    assert ground.is_shadow_catcher
    np.testing.assert_allclose(ground.matrix_world.translation, [0, 0, -1.25], atol=1e-5)
    below = min(scene.objects["PanoLess walls"].data.vertices, key=lambda vertex: vertex.co.normalized().z)
    np.testing.assert_allclose(below.co.z, -1.25, atol=1e-2)


def colored_ball(bpy: Any, *, radius: float, emission: float) -> Any:
    """One that shines red and is black otherwise."""
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius)
    ball = bpy.context.object
    red = bpy.data.materials.new("red")
    shader = red.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = 0, 0, 0, 1
    shader.inputs["Emission Color"].default_value = 1, 0, 0, 1
    shader.inputs["Emission Strength"].default_value = emission
    shader.inputs["Specular IOR Level"].default_value = 0
    ball.data.materials.append(red)
    return ball


def composed(bpy: Any) -> np.ndarray:
    """The picture that the compositor makes, linear."""
    scene = bpy.context.scene
    scene.cycles.samples, scene.cycles.use_denoising, scene.render.use_compositing = 128, False, True
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
    path = Path(bpy.data.filepath).parent / "over.exr"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return stack_channels(read_exr(path), ("R", "G", "B"), path)


def test_an_inserted_object_stands_beside_the_mirror_and_in_it(
    blender: Any, prediction: Path, ball_dataset: Dataset, picture: Render
) -> None:
    """A red ball: on the ground, beside the mirror, seen in it."""
    scene = imported(blender, prediction)
    blender.ops.panoless.photograph(step="NEXT")
    photograph = read_view(ball_dataset.train[ball_dataset_index(scene, ball_dataset)])
    ball = colored_ball(blender, radius=0.4, emission=50)
    assert blender.ops.panoless.insert() == {"FINISHED"}
    blender.context.view_layer.update()
    np.testing.assert_allclose(ball.matrix_world.translation.z, -0.6, atol=1e-2)
    assert np.linalg.norm(ball.matrix_world.translation.xy) > 1.2
    scene.render.use_compositing = False
    red_gain = picture(blender)[..., 0] - photograph.radiance[..., 0]
    assert (red_gain[photograph.alpha > 0.99] > 5).sum() > 3, "The mirror shows it."


def above_ground(bpy: Any, prediction: Path, folder: Path) -> Any:
    """A camera of 48 × 48 pixels with a gray photograph, level, 1 above the ground; under a uniform sky."""
    from mathutils import Vector

    from blender_extension.build import _add_camera, show_photograph

    write_environment_map(prediction, np.ones((64, 128, 3), np.float32))
    scene = imported(bpy, prediction)
    camera = Camera(look_at(np.array([0.0, -6.0, 0.0]), np.zeros(3)), 48.0, 48.0, 24.0, 24.0, 48, 48)
    write_png(folder / "gray.png", np.full((48, 48, 3), 128, np.uint8))
    _add_camera(scene.collection, asdict(blender_camera("gray", folder / "gray.png", camera)), Vector(), 1.0)
    show_photograph(scene, scene.objects["PanoLess camera gray"])
    return scene


#: A photograph of this color, as light.
GRAY = srgb_to_linear(np.array(128 / 255))


def test_without_an_inserted_object_the_photograph_stays(blender: Any, prediction: Path, tmp_path: Path) -> None:
    """All but the mirror: its shadow and its image on the ground are in the photograph already."""
    from blender_extension.insert import over_photograph

    scene = above_ground(blender, prediction, tmp_path)
    assert over_photograph(scene, scene.camera)
    pixels = composed(blender)
    assert pixels[20, 24].min() > 1.5 * GRAY, "The mirror shows the sky."
    np.testing.assert_allclose(pixels[35:], GRAY, rtol=1e-3)


@pytest.mark.parametrize("gloss", [0.0, 1.0])
def test_a_glossy_ground_mirrors_what_is_inserted(gloss: float, blender: Any, prediction: Path, tmp_path: Path) -> None:
    """A ball floats 1 above the ground and shines red; its mirrored image lies 1 below. There the ground gains the red
    and lacks the sky's green where it is glossy; else it lacks green in the shadow only, under the ball.
    """
    from blender_extension.insert import over_photograph

    scene = above_ground(blender, prediction, tmp_path)
    scene.objects["PanoLess mirror"].hide_render = scene.objects["PanoLess mirror met by light"].hide_render = True
    scene.panoless.ground_gloss = gloss
    colored_ball(blender, radius=0.4, emission=50)
    assert over_photograph(scene, scene.camera)
    red, green, _ = np.moveaxis(composed(blender) / GRAY, -1, 0)
    image, aside, shadow = slice(38, 42), slice(2, 6), slice(31, 33)  # Rows, columns; rows 1 below the ball's center.
    assert green[shadow, 22:26].mean() < 0.96
    assert green[image, aside].mean() == pytest.approx(1, abs=0.02)
    if gloss:
        assert green[image, 22:26].mean() < 0.75, "Measured: 0.69."
        assert red[image, 22:26].mean() > 8 * red[image, aside].mean(), "Measured: 15 times."
    else:
        assert green[image, 22:26].mean() > 0.97
        assert red[image, 22:26].mean() < 1.5 * red[image, aside].mean()


def ball_dataset_index(scene: Any, dataset: Dataset) -> int:
    """The number of the photograph that the scene's camera took."""
    return [frame.stem.name for frame in dataset.train].index(scene.camera.name.rpartition(" ")[2])


def test_confidence_is_an_image_and_a_color_of_vertices(blender: Any, prediction: Path) -> None:
    scene = imported(blender, prediction)
    image = blender.data.images["PanoLess confidence.png"]
    assert image.packed_file is not None
    seen = np.empty(4 * len(scene.objects["PanoLess mirror"].data.vertices), np.float32)
    scene.objects["PanoLess mirror"].data.color_attributes["seen"].data.foreach_get("color", seen)
    normals = np.empty(3 * (len(seen) // 4), np.float32)
    scene.objects["PanoLess mirror"].data.vertices.foreach_get("co", normals)
    front = normals.reshape(-1, 3)[:, 0]
    assert (seen.reshape(-1, 4)[front > 0.7, 0] == 1).all(), "Cameras stand around +X."
    assert (seen.reshape(-1, 4)[front < -0.9, 0] == 0).all()


def test_a_second_import_replaces_the_first(blender: Any, prediction: Path) -> None:
    """A folder is as good as its prediction.json; the file browser ends one that was entered with a slash."""
    names = {each.name for each in imported(blender, prediction).objects}
    assert blender.ops.panoless.import_prediction(filepath=f"{prediction}/") == {"FINISHED"}
    assert {each.name for each in blender.context.scene.objects} == names


def test_the_scene_outlives_its_files(blender: Any, prediction: Path, tmp_path: Path, picture: Render) -> None:
    """Light is packed, so that a moved prediction changes nothing in the .blend."""
    imported(blender, prediction)
    blender.ops.wm.save_mainfile()
    shutil.rmtree(prediction)
    shutil.rmtree(tmp_path / "file-panoless")
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "file.blend"))
    scene = blender.context.scene
    no_ground(scene)
    assert picture(blender)[..., :3].max() > 0.1


def test_without_its_dataset_a_prediction_has_no_cameras(blender: Any, prediction: Path) -> None:
    write_info(prediction, replace(read_info(prediction), dataset=str(prediction / "gone")))
    scene = imported(blender, prediction)
    assert scene.camera is None
    assert read_environment_map(prediction).shape[0] == blender.data.images["PanoLess light_filled.exr"].size[1]
