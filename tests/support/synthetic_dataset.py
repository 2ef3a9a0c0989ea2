"""A mirror sphere under an analytic environment, traced in numpy and written in the dataset format within a second.

The sphere has radius 1 and stands at the origin; cameras lie on an arc around +X. Everything is known in closed form:
normals and depth are those of the ray through the pixel center, alpha is the covered share of the pixel, and the
premultiplied radiance is alpha · E(ω_r), with E = `environment_radiance` and ω_r the mirror direction.
"""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.camera import Camera, look_at, opencv_to_opengl, ray_directions_world, reflect
from shinypartial.core.color import linear_to_srgb
from shinypartial.core.sphere import latlong_directions
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import Dataset, Frame, View
from shinypartial.dataset.write import (
    claim_folder,
    complete_dataset,
    make_frames,
    write_environment,
    write_transforms,
    write_view,
)
from shinypartial.io.files import write_json
from shinypartial.io.images import write_png

CAMERA_DISTANCE = 4.0
FIELD_OF_VIEW_RAD = math.radians(36.0)
ARC_HALF_ANGLE_DEG = 60.0
SAMPLES_PER_SIDE = 5
SUN_DIRECTION = np.array([0.6, 0.0, 0.8])
#: Rows of the lat-long map of datasets that need no larger one.
MAP_HEIGHT = 32


def environment_radiance(directions: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Linear radiance of unit directions: each channel a ramp along one axis, and a soft white sun (peak 3)."""
    sun = 3.0 * np.exp(20.0 * (directions @ SUN_DIRECTION - 1.0))
    return 0.45 + 0.35 * directions + sun[..., None]


def environment_latlong(height: int) -> Float[np.ndarray, "H 2*H 3"]:
    """The environment at the texel centers of a lat-long map."""
    return environment_radiance(latlong_directions(height)).astype(np.float32)


def sphere_cameras(split: str, number: int, resolution: int) -> list[Camera]:
    """Cameras on the arc: training views at 10° and 30° of elevation in turn, test views at 20° between them."""
    margin = 0.0 if split == "train" else 0.5 * ARC_HALF_ANGLE_DEG / max(number, 1)
    azimuths = np.radians(np.linspace(-ARC_HALF_ANGLE_DEG + margin, ARC_HALF_ANGLE_DEG - margin, number))
    focal = 0.5 * resolution / math.tan(0.5 * FIELD_OF_VIEW_RAD)
    cameras = []
    for i, azimuth in enumerate(azimuths):
        elevation = math.radians((10.0, 30.0)[i % 2] if split == "train" else 20.0)
        horizontal = math.cos(elevation)
        direction = np.array([horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), math.sin(elevation)])
        pose = look_at(CAMERA_DISTANCE * direction, np.zeros(3))
        cameras.append(Camera(pose, focal, focal, resolution / 2, resolution / 2, resolution, resolution))
    return cameras


def render_sphere(camera: Camera) -> View:
    """Trace one view of the mirror sphere."""
    fine = SAMPLES_PER_SIDE
    hit_fine, points_fine = _intersect(_supersampled(camera))
    hit_blocks = hit_fine.reshape(camera.height, fine, camera.width, fine)
    alpha = hit_blocks.mean((1, 3))
    center_hit = hit_blocks[:, fine // 2, :, fine // 2]
    blocks = points_fine.reshape(camera.height, fine, camera.width, fine, 3)
    # Where the center ray misses but part of the pixel is covered, the mean of the covered samples stands in.
    mean = blocks.sum((1, 3))
    mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-12)
    normals = np.where(center_hit[..., None], blocks[:, fine // 2, :, fine // 2], mean)
    reflected = reflect(ray_directions_world(camera), normals)
    radiance = environment_radiance(reflected) * alpha[..., None]
    depth = (normals - camera.position_world) @ camera.camera_to_world[:3, 2] * (alpha > 0)
    return View(*(array.astype(np.float32) for array in (radiance, alpha, normals, depth)), high_dynamic_range=True)


def _supersampled(camera: Camera) -> Camera:
    n = SAMPLES_PER_SIDE
    intrinsics = (n * camera.fx, n * camera.fy, n * camera.cx, n * camera.cy)
    return Camera(camera.camera_to_world, *intrinsics, n * camera.width, n * camera.height)


def _intersect(camera: Camera) -> tuple[Bool[np.ndarray, "H W"], Float[np.ndarray, "H W 3"]]:
    """Whether each pixel's ray hits the unit sphere, and where (zero for a miss); the point is also the normal."""
    directions, origin = ray_directions_world(camera), camera.position_world
    half_b = directions @ origin
    discriminant = half_b**2 - origin @ origin + 1.0
    hit = discriminant > 0
    distance = -half_b - np.sqrt(np.maximum(discriminant, 0))
    return hit, np.where(hit[..., None], origin + distance[..., None] * directions, 0.0)


def make_sphere_dataset(
    root: Path, resolution: int = 32, train: int = 6, test: int = 3, environment_height: int = MAP_HEIGHT
) -> Dataset:
    """Write the full format (EXR, companions, environment, checksums) to a new folder `root` and open it."""
    recipe = {"scene": "synthetic-sphere", "resolution": resolution, "train": train, "test": test}
    claim_folder(root, recipe, {"name": "tests.support.synthetic_dataset"})
    for split, number in (("train", train), ("test", test)):
        frames = make_frames(root, split, sphere_cameras(split, number, resolution))
        for frame in frames:
            write_view(frame, render_sphere(frame.camera))
        write_transforms(root, split, frames)
    write_environment(root, environment_latlong(environment_height), cube_resolution=environment_height // 2)
    complete_dataset(root, [{"file": "*", "license": "CC0-1.0", "source": "computed"}], {})
    return open_dataset(root)


def make_plain_sphere_dataset(root: Path, resolution: int = 32, train: int = 6, test: int = 3) -> Dataset:
    """The same views as a plain NeRF-synthetic folder: RGBA PNGs and `camera_angle_x`, nothing else."""
    for split, number in (("train", train), ("test", test)):
        frames = make_frames(root, split, sphere_cameras(split, number, resolution))
        for frame in frames:
            _write_rgba(frame, render_sphere(frame.camera))
        write_json(
            root / f"transforms_{split}.json", {"camera_angle_x": FIELD_OF_VIEW_RAD, "frames": entries_of(frames)}
        )
    return open_dataset(root)


def _write_rgba(frame: Frame, view: View) -> None:
    straight = np.clip(view.radiance / np.maximum(view.alpha, 1e-6)[..., None], 0, 1)
    rgba = np.concatenate([linear_to_srgb(straight), view.alpha[..., None]], -1)
    write_png(frame.png, np.rint(rgba * 255).astype(np.uint8))


def entries_of(frames: tuple[Frame, ...]) -> list[dict[str, object]]:
    """Frames as a plain transforms file lists them."""
    return [
        {
            "file_path": f"./{frame.name}",
            "transform_matrix": opencv_to_opengl(frame.camera.camera_to_world).tolist(),
        }
        for frame in frames
    ]
