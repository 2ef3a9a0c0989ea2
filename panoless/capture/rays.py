"""The one place for pixel → ray, point → pixel and the law of reflection, on numpy arrays and torch tensors.

Kernels have their own, and `shinypartial.core.camera` is the benchmark's.
"""

from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.object_frame import ObjectFrame
from panoless.kernels.camera import RasterCamera, unit_rays
from shinypartial.core.camera import Camera
from shinypartial.core.conventions import PIXEL_CENTER

Vectors = TypeVar("Vectors", np.ndarray, Tensor)


def reflect(directions: Vectors, normals: Vectors) -> Vectors:
    """ω = v − 2 (v·n) n (paper Eq. 5) of (…, 3) directions v and unit normals n."""
    return directions - 2 * (directions * normals).sum(-1)[..., None] * normals


def camera_rays(
    camera: Camera | RasterCamera, x: Float[np.ndarray, "*P"], y: Float[np.ndarray, "*P"]
) -> Float[np.ndarray, "*P 3"]:
    """Rays of depth one, in the camera frame, through places (x, y) in pixels; pixel (0, 0) spans [0, 1]²."""
    x, y = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], -1)


def in_camera(camera: RasterCamera, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    """Points of the normalized frame in the camera's axes."""
    return points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]


def project(
    camera: RasterCamera, points_camera: Vectors, first_center: float = PIXEL_CENTER
) -> tuple[Vectors, Vectors]:
    """Places (x, y) in pixels of (…, 3) points in the camera frame, the inverse of `camera_rays`.

    What is nearer than the near plane is taken to be that far. `first_center` is the coordinate of the first pixel's
    center: 0 gives indices into an image.
    """
    depth, shift = points_camera[..., 2].clip(camera.near), PIXEL_CENTER - first_center
    x = points_camera[..., 0] / depth * camera.fx + (camera.cx - shift)
    return x, points_camera[..., 1] / depth * camera.fy + (camera.cy - shift)


def pixel_rays(
    camera: RasterCamera, pixels: Int[np.ndarray, "P"], shift: tuple[float, float] = (PIXEL_CENTER, PIXEL_CENTER)
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Origins and directions, in the normalized frame, of rays through flat pixel indices; camera depth is 1.

    `shift` is the place (x, y) within the pixel.
    """
    rotation, center = pose_of(camera)
    row, column = np.divmod(pixels, camera.width)
    rays = camera_rays(camera, column + shift[0], row + shift[1])
    return np.broadcast_to(center, rays.shape), rays @ rotation


def raster_camera(camera: Camera, object_frame: ObjectFrame, near: float) -> RasterCamera:
    """Camera of the rasterizer in the normalized frame."""
    pose = camera.camera_to_world.copy()
    pose[:3, 3] = (pose[:3, 3] - object_frame.center) / object_frame.radius
    world_to_camera = torch.from_numpy(np.linalg.inv(pose)).to(torch.float32)
    return RasterCamera(
        world_to_camera, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, near, 500 * near
    )


def pose_of(camera: RasterCamera) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Rotation from the normalized frame to the camera, and the camera's center in that frame, in float64."""
    matrix = camera.world_to_camera.cpu().numpy().astype(np.float64)
    return matrix[:3, :3], -matrix[:3, :3].T @ matrix[:3, 3]


def unit_rays_camera(camera: RasterCamera, device: torch.device | None = None) -> Float[Tensor, "3 H W"]:
    """Unit ray directions in the camera frame through pixel centers, made on a device."""
    size, focal, center = (camera.height, camera.width), (camera.fx, camera.fy), (camera.cx, camera.cy)
    return unit_rays(size, focal, center, device=device)
