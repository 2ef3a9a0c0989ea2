"""The frame in which the object is the unit ball, from where the masks lie."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import Camera
from shinypartial.core.errors import InputError


@dataclass(frozen=True)
class ObjectFrame:
    """x_normalized = (x_world − center)/radius, so that the object lies in the unit ball."""

    center: Float[np.ndarray, "3"]
    radius: float

    def to_world(self, points: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P 3"]:
        """Points of the object frame in the world."""
        return points * self.radius + self.center


def estimate_object_frame(masks: list[tuple[Camera, Float[np.ndarray, "_ _"]]]) -> ObjectFrame:
    """Center and radius of the object from where the masks lie in the views.

    The center is the point nearest, in least squares, to the rays through the masks' centers; the radius is the
    median over views of (largest distance of a mask pixel from the projected center) · depth / focal length, with
    a tenth to spare. Raises InputError when all cameras look along one line, which leaves the depth open.
    """
    normal_matrix, right_side = np.zeros((3, 3)), np.zeros(3)
    for camera, alpha in masks:
        rows, columns = np.nonzero(alpha >= 0.5)
        x = (columns.min() + columns.max() + 1) / 2
        y = (rows.min() + rows.max() + 1) / 2
        ray = camera.camera_to_world[:3, :3] @ np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        normal_matrix += across
        right_side += across @ camera.position_world
    if np.linalg.eigvalsh(normal_matrix)[0] < 1e-4 * len(masks):
        raise InputError(
            expected="cameras that see the object from different directions",
            found="views along a single line",
            remedy="Add views from the sides; an arc of at least 30° is best.",
        )
    center = np.linalg.solve(normal_matrix, right_side)
    radii = [_mask_radius(camera, alpha, center) for camera, alpha in masks]
    return ObjectFrame(center, 1.1 * float(np.median(radii)))


def _mask_radius(camera: Camera, alpha: Float[np.ndarray, "H W"], center: Float[np.ndarray, "3"]) -> float:
    rows, columns = np.nonzero(alpha >= 0.5)
    in_camera = camera.camera_to_world[:3, :3].T @ (center - camera.position_world)
    if in_camera[2] <= 0:
        raise InputError(
            expected="cameras that look at one object",
            found="an object center behind one of the cameras",
            remedy="Check the axes of transform_matrix: OpenGL, the camera looks along −z.",
        )
    x = in_camera[0] / in_camera[2] * camera.fx + camera.cx
    y = in_camera[1] / in_camera[2] * camera.fy + camera.cy
    across = np.hypot((columns + 0.5 - x) / camera.fx, (rows + 0.5 - y) / camera.fy).max()
    return float(np.linalg.norm(in_camera) * math.sin(math.atan(across)))
