"""A prediction in Blender's own numbers, as the extension for Blender loads it: cameras, surface, light, ground, walls.

All conventions end here: the extension copies numbers into Blender. `scene.json` names the other files.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from shinypartial.conversion.light import filled, seen_mask
from shinypartial.core.camera import Camera, opencv_to_opengl
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions, sample_latlong
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import Frame
from shinypartial.io.events import warn
from shinypartial.io.files import atomic_write, write_json
from shinypartial.io.images import write_exr_rgb, write_png
from shinypartial.io.records import write_record
from shinypartial.prediction.format import (
    PredictionInfo,
    read_environment_map,
    read_info,
    read_inverse_distance,
    read_visibility,
)
from shinypartial.prediction.postprocess import BlurOptions, blur_hardly_seen
from shinypartial.prediction.surface import PredictedSurface, surface_of

FORMAT, FORMAT_VERSION = "panoless-blender", 1
SCENE, SURFACE, WALLS = "scene.json", "surface.npz", "walls.npz"
FILLED, BLURRED, SEEN, CONFIDENCE = "light_filled.exr", "light_blurred.exr", "seen.png", "confidence.png"
SENSOR_MM = 36.0
#: Width of the border between what was seen and what was not.
FEATHER_DEG = 2.0
#: Rows of the mesh of the walls.
WALL_ROWS = 64
#: How far walls stand that were found to be infinitely far, in distances of the farthest that were not.
FAR = 20.0
#: Directions this near to straight down see the ground.
DOWN_DEG = 30.0


@dataclass(frozen=True)
class BlenderCamera:
    """A camera with Blender's axes and in Blender's words."""

    name: str
    picture: str
    """Path of its photograph."""
    width: int
    height: int
    matrix_world: list[list[float]]
    lens_mm: float
    sensor_mm: float
    """Along the width, whatever the picture's shape."""
    shift_x: float
    shift_y: float
    pixel_aspect: tuple[float, float]


@dataclass(frozen=True)
class Ground:
    """What the object stands on, a plane of the world."""

    point: tuple[float, float, float]
    normal: tuple[float, float, float]
    origin: Literal["found by the fit", "below the object"]


def write_for_extension(prediction: Path, output: Path) -> list[Path]:
    """Write the files into `output`; return them, `scene.json` last.

    Raises InputError for a prediction that can't be read. A dataset that is gone leaves its cameras out, with a
    warning.
    """
    info = read_info(prediction)
    surface = surface_of(prediction, clouds=True)
    cameras = _cameras(info)
    written = _write_light(prediction, output)
    if surface is not None and surface.faces:
        written.append(_write_surface(output / SURFACE, surface, cameras))
    walls = read_inverse_distance(prediction)
    if walls is not None and walls.max() > 0:
        written.append(_write_walls(output / WALLS, walls))
    content: dict[str, Any] = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "prediction": str(prediction.resolve()),
        "dataset": info.dataset,
        "method": info.method,
        "verdict": None if info.verdict is None else write_record(info.verdict),
        "files": [path.name for path in written],
        "mirror": {"base_color": list(info.reflectance or (1.0, 1.0, 1.0)), "roughness": info.roughness or 0.0},
        "bounds": None if surface is None else [surface.vertices.min(0).tolist(), surface.vertices.max(0).tolist()],
        "cameras": [write_record(each) for each in cameras],
        "ground": None if (ground := _ground(info, walls, surface)) is None else write_record(ground),
    }
    write_json(output / SCENE, content)
    return [*written, output / SCENE]


def blender_camera(name: str, picture: Path, camera: Camera) -> BlenderCamera:
    """A pinhole in Blender's words; the inverse of what its renderer does with them, to the pixel.

    The lens counts along the width. Pixels that are not square are the scene's aspect a = f_x/f_y, and shifts are in
    widths, upward with that aspect.
    """
    aspect = camera.fx / camera.fy
    return BlenderCamera(
        name,
        str(picture.resolve()),
        camera.width,
        camera.height,
        opencv_to_opengl(camera.camera_to_world).tolist(),
        camera.fx * SENSOR_MM / camera.width,
        SENSOR_MM,
        (camera.width / 2 - camera.cx) / camera.width,
        (camera.cy - camera.height / 2) * aspect / camera.width,
        (max(1 / aspect, 1.0), max(aspect, 1.0)),
    )


def found_cameras(info: PredictionInfo, frames: Iterable[Frame]) -> list[Camera]:
    """Cameras of training views as the method found them: turned about their centers, then shifted, with its focal
    length.
    """
    chosen = (
        [one for one in info.model_selection.candidates if one.kind == info.model_selection.chosen]
        if (info.model_selection)
        else []
    )
    factor = (chosen[0].focal_factor if chosen else None) or 1.0
    by_name = {Path(each.name).name: each for each in info.cameras or ()}
    cameras = []
    for frame in frames:
        found, pose = by_name.get(Path(frame.name).name), frame.camera.camera_to_world.copy()
        if found is not None and found.turn_deg is not None:
            pose[:3, :3] = Rotation.from_rotvec(found.turn_deg, degrees=True).as_matrix() @ pose[:3, :3]
        if found is not None and found.shift is not None:
            pose[:3, 3] += found.shift
        fx, fy = factor * frame.camera.fx, factor * frame.camera.fy
        cameras.append(replace(frame.camera, camera_to_world=pose, fx=fx, fy=fy))
    return cameras


def _cameras(info: PredictionInfo) -> list[BlenderCamera]:
    try:
        frames = open_dataset(Path(info.dataset)).train
    except InputError as error:
        warn(f"no cameras and photographs: {error}")
        return []
    pictures = (frame.png if frame.png.exists() else frame.photograph for frame in frames)
    return [
        blender_camera(Path(frame.name).name, picture, camera)
        for frame, picture, camera in zip(frames, pictures, found_cameras(info, frames), strict=True)
    ]


def _write_light(prediction: Path, output: Path) -> list[Path]:
    """The map with unseen directions filled and blurred, what was seen, and how well."""
    radiance, visibility = np.maximum(read_environment_map(prediction), 0), read_visibility(prediction)
    if visibility is None:
        visibility = np.ones(radiance.shape[:2])
        seen = visibility
    else:
        seen = seen_mask(prediction, FEATHER_DEG, float(np.finfo(np.float32).tiny))
        fine = sample_latlong(visibility[..., None], latlong_directions(len(radiance)))[..., 0]
        radiance = filled(radiance, fine > 0)
    blurred = radiance
    if np.ptp(visibility) > 0:
        blurred = blur_hardly_seen(radiance, visibility, BlurOptions(8.0, FEATHER_DEG)).radiance
    write_exr_rgb(output / FILLED, radiance)
    write_exr_rgb(output / BLURRED, blurred)
    for name, share in ((SEEN, seen), (CONFIDENCE, visibility)):
        write_png(output / name, np.rint(255 * share).astype(np.uint8))
    return [output / name for name in (FILLED, BLURRED, SEEN, CONFIDENCE)]


def _write_surface(path: Path, surface: PredictedSurface, cameras: Sequence[BlenderCamera]) -> Path:
    """The mesh, with the method's confidence in its vertices, and whether some camera sees their front."""
    sizes = [len(face) for face in surface.faces]
    arrays = {
        "vertices": surface.vertices,
        "normals": surface.normals,
        "corners": np.concatenate([np.array(face) for face in surface.faces]),
        "sizes": np.array(sizes),
    }
    if surface.confidence is not None:
        arrays["confidence"] = surface.confidence
    places = [np.array(each.matrix_world)[:3, 3] for each in cameras]
    fronts = [((place - surface.vertices) * surface.normals).sum(1) > 0 for place in places]
    arrays["seen"] = np.any(fronts, axis=0).astype(np.float64) if fronts else np.ones(len(surface.vertices))
    return _write_arrays(path, arrays)


def _write_walls(path: Path, inverse_distance: Float[np.ndarray, "H W"]) -> Path:
    """A closed mesh about the origin whose point in each direction is as far as the prediction says."""
    directions = latlong_directions(WALL_ROWS)
    inverse = sample_latlong(inverse_distance[..., None].astype(np.float64), directions)[..., 0]
    least = inverse[inverse > 0].min() / FAR
    ring = (directions / np.maximum(inverse, least)[..., None]).reshape(-1, 3)
    poles = [ring[: 2 * WALL_ROWS].mean(0), ring[-2 * WALL_ROWS :].mean(0)]
    index = np.arange(len(ring)).reshape(WALL_ROWS, 2 * WALL_ROWS)
    beside = np.roll(index, -1, axis=1)
    quads = np.stack([index[:-1], index[1:], beside[1:], beside[:-1]], -1).reshape(-1, 4)
    top = np.stack([index[0], beside[0], np.full_like(index[0], len(ring))], -1)
    bottom = np.stack([beside[-1], index[-1], np.full_like(index[-1], len(ring) + 1)], -1)
    arrays = {
        "vertices": np.concatenate([ring, np.array(poles)]),
        "corners": np.concatenate([quads.ravel(), top.ravel(), bottom.ravel()]),
        "sizes": np.repeat([4, 3], [len(quads), len(top) + len(bottom)]),
    }
    return _write_arrays(path, arrays)


def _write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """Single precision and 32 bits, as Blender has them."""
    packed = {name: each.astype("<i4" if each.dtype.kind == "i" else "<f4") for name, each in arrays.items()}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **packed)
    return path


def _ground(
    info: PredictionInfo, inverse_distance: Float[np.ndarray, "H W"] | None, surface: PredictedSurface | None
) -> Ground | None:
    """The floor that the fit found, by the distances of its map, or a level plane below the object."""
    floor = info.surroundings.floor if info.surroundings else None
    if floor is not None and inverse_distance is not None:
        up, directions = np.array(floor.normal), latlong_directions(len(inverse_distance))
        down = -(directions @ up)
        meets = (down > np.cos(np.radians(DOWN_DEG))) & (inverse_distance > 0)
        if meets.any():
            x, y, z = (-float(np.median(down[meets] / inverse_distance[meets])) * up).tolist()
            return Ground((x, y, z), floor.normal, "found by the fit")
    if surface is None:
        return None
    x, y = surface.vertices[:, :2].mean(0).tolist()
    return Ground((x, y, float(surface.vertices[:, 2].min())), (0.0, 0.0, 1.0), "below the object")
