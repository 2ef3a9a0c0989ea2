"""A planar mirror with an boundary, flat or bent within it, as views and as a dataset, traced in numpy."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.path import Path as PolygonPath

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import pose_of, unit_rays_camera
from panoless.capture.views import TrainView, Views
from panoless.geometry.plane.model import Plane
from panoless.kernels.camera import RasterCamera
from shinypartial.core.camera import Camera, look_at
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import Dataset, View
from shinypartial.dataset.write import (
    claim_folder,
    complete_dataset,
    make_frames,
    write_environment,
    write_transforms,
    write_view,
)
from tests.support.synthetic_dataset import environment_latlong, environment_radiance

SIZE_PX = 96
SUBPIXELS = 6
NORMAL = np.array([0.3, -0.9, 0.2]) / np.linalg.norm([0.3, -0.9, 0.2])
L_SHAPE = np.array([[-0.6, -0.5], [0.6, -0.5], [0.6, 0.1], [0.0, 0.1], [0.0, 0.5], [-0.6, 0.5]])
RECTANGLE = np.array([[-0.65, -0.5], [0.65, -0.5], [0.65, 0.5], [-0.65, 0.5]])


def disc(count: int) -> Float[np.ndarray, "N 2"]:
    """A boundary of so many vertices on a circle of radius 0.7."""
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return 0.7 * np.stack([np.cos(turn), np.sin(turn)], 1)


def plane_of(boundary: Float[np.ndarray, "N 2"], frame_height: float = 0.0, offset: float = 0.07) -> Plane:
    tangent_u = np.cross([0.0, 0.0, 1.0], NORMAL)
    tangent_u /= np.linalg.norm(tangent_u)
    return Plane(NORMAL, offset, tangent_u, np.cross(NORMAL, tangent_u), boundary, frame_height)


def camera_at(position: Float[np.ndarray, "3"], size: int = SIZE_PX) -> RasterCamera:
    """Looks at the origin and holds the unit ball."""
    world_to_camera = torch.from_numpy(np.linalg.inv(look_at(position, np.zeros(3)))).float()
    focal = 0.45 * size * float(np.linalg.norm(position))
    return RasterCamera(world_to_camera, focal, focal, size / 2, size / 2, size, size, 0.3, 150.0)


def arc(count: int, half_angle_deg: float = 35.0, size: int = SIZE_PX) -> list[RasterCamera]:
    """Around a direction 15° off the normal, up and down in turn."""
    cameras = []
    for index, azimuth in enumerate(np.radians(np.linspace(-half_angle_deg, half_angle_deg, count))):
        elevation = math.radians((-18.0, 5.0, 20.0)[index % 3])
        across = math.cos(elevation)
        position = np.array([across * math.sin(azimuth), -across * math.cos(azimuth), math.sin(elevation)])
        cameras.append(camera_at(3.0 * position, size))
    return cameras


def seen(plane: Plane, camera: RasterCamera, subpixels: int = SUBPIXELS) -> Bool[np.ndarray, "H W"]:
    """Whether rays through points of a fine grid in each pixel meet the mirror, by a test of points in polygons."""
    rotation, center = pose_of(camera)
    x = ((np.arange(camera.width * subpixels) + 0.5) / subpixels - camera.cx) / camera.fx
    y = ((np.arange(camera.height * subpixels) + 0.5) / subpixels - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], -1).reshape(-1, 3) @ rotation
    inside = np.ones(len(rays), dtype=bool)
    for height in {0.0, plane.frame_height}:
        depth = (plane.offset + height - center @ plane.normal) / (rays @ plane.normal)
        hit = center + depth[:, None] * rays
        coordinates = np.stack([hit @ plane.tangent_u, hit @ plane.tangent_v], 1)
        inside &= PolygonPath(plane.boundary).contains_points(coordinates) & (depth > 0)
    return inside.reshape(len(y), len(x))


def train_view(camera: RasterCamera, mask: Float[np.ndarray, "H W"]) -> TrainView:
    tensor = torch.from_numpy(mask).float()
    return TrainView(
        camera,
        torch.zeros(3, *mask.shape),
        tensor,
        torch.nonzero(tensor.flatten() > SOLID_ALPHA)[:, 0],
    )


def mirror_views(plane: Plane, cameras: list[RasterCamera]) -> Views:
    views = []
    for camera in cameras:
        fine = seen(plane, camera).reshape(camera.height, SUBPIXELS, camera.width, SUBPIXELS)
        views.append(train_view(camera, fine.mean((1, 3))))
    return Views(tuple(views), ObjectFrame(np.zeros(3), 1.0), 0.3)


def reflecting_views(plane: Plane, cameras: list[RasterCamera], bend: float = 0.0) -> Views:
    """Views that show the environment of the synthetic dataset, clipped to [0, 1] as training views are."""
    views = mirror_views(plane, cameras)
    train = []
    for view in views.train:
        radiance = traced(plane, view.camera, view.mask.numpy(), bend).radiance.clip(0, 1).transpose(2, 0, 1)
        train.append(replace(view, radiance=torch.from_numpy(np.ascontiguousarray(radiance))))
    return replace(views, train=tuple(train))


def traced(plane: Plane, camera: RasterCamera, alpha: Float[np.ndarray, "H W"], bend: float = 0.0) -> View:
    """What a camera sees of the mirror. At plane coordinates p its normal is n + bend·(p₁ t_u + p₂ t_v), made unit:
    that of a shallow dome, which the boundary does not determine.
    """
    rotation, center = pose_of(camera)
    rays = unit_rays_camera(camera).numpy().astype(np.float64).transpose(1, 2, 0)
    world = rays @ rotation
    distance = (plane.offset - center @ plane.normal) / (world @ plane.normal)
    hit = center + distance[..., None] * world
    normals = plane.normal + bend * sum(
        (hit @ tangent)[..., None] * tangent for tangent in (plane.tangent_u, plane.tangent_v)
    )
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    reflect = world - 2 * (world * normals).sum(-1, keepdims=True) * normals
    covered = alpha > 0
    images = (
        environment_radiance(reflect) * alpha[..., None],
        alpha,
        normals * covered[..., None],
        distance * rays[..., 2] * covered,
    )
    return View(*(np.ascontiguousarray(image, dtype=np.float32) for image in images), high_dynamic_range=True)


def make_plane_dataset(root: Path, plane: Plane, size: int = 64, train: int = 12, test: int = 3) -> Dataset:
    """The flat mirror in the dataset format, test views between the training views."""
    claim_folder(root, {"scene": "synthetic-plane", "size": size}, {"name": "tests.support.mirror_plane"})
    for split, number, half_angle_deg in (("train", train, 35.0), ("test", test, 25.0)):
        views = mirror_views(plane, arc(number, half_angle_deg, size))
        cameras = []
        for view in views.train:
            eye = view.camera
            pose = np.linalg.inv(eye.world_to_camera.numpy().astype(np.float64))
            cameras.append(Camera(pose, eye.fx, eye.fy, eye.cx, eye.cy, eye.width, eye.height))
        frames = make_frames(root, split, cameras)
        for frame, view in zip(frames, views.train, strict=True):
            write_view(frame, traced(plane, view.camera, view.mask.numpy()))
        write_transforms(root, split, frames)
    write_environment(root, environment_latlong(32), cube_resolution=16)
    complete_dataset(root, [{"file": "*", "license": "CC0-1.0", "source": "computed"}], {})
    return open_dataset(root)
