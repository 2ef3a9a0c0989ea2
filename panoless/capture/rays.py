"""Pixels to rays and back, and the mirror's law."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.object_frame import ObjectFrame
from panoless.kernels.rasterize import RasterCamera
from panoless.kernels.reference.objective import unit_rays
from shinypartial.core.camera import Camera
from shinypartial.core.conventions import PIXEL_CENTER


def reflect(directions: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """ω = v − 2 (v·n) n (paper Eq. 5)."""
    return directions - 2 * (directions * normals).sum(1, keepdims=True) * normals


def pixel_rays(
    camera: RasterCamera, pixels: Int[np.ndarray, "P"], shift: tuple[float, float] = (PIXEL_CENTER, PIXEL_CENTER)
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Origins and directions, in the normalized frame, of rays through flat pixel indices; camera depth is 1."""
    rotation, center = pose_of(camera)
    row, column = np.divmod(pixels, camera.width)
    x, y = (column + shift[0] - camera.cx) / camera.fx, (row + shift[1] - camera.cy) / camera.fy
    return np.broadcast_to(center, (len(pixels), 3)), np.stack([x, y, np.ones_like(x)], 1) @ rotation


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


def unit_rays_camera(camera: RasterCamera) -> Float[Tensor, "3 H W"]:
    """Unit ray directions in the camera frame through pixel centers."""
    size, focal, center = (camera.height, camera.width), (camera.fx, camera.fy), (camera.cx, camera.cy)
    return unit_rays(size, focal, center)
