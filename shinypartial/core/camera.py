"""Pinhole cameras: pixels ⇄ rays, OpenGL ⇄ OpenCV poses."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from shinypartial.core.conventions import OPENGL_OPENCV, PIXEL_CENTER
from shinypartial.core.errors import InputError

ROTATION_TOLERANCE = 1e-3
#: From where an object is shown: from the front and a little above, in directions of the world.
FRONT = np.array([0.35, -1.0, 0.45])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with OpenCV axes; intrinsics in pixels, pixel (0, 0) spans [0, 1]²."""

    camera_to_world: Float[np.ndarray, "4 4"]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def position_world(self) -> Float[np.ndarray, "3"]:
        """Center of projection in world coordinates."""
        return self.camera_to_world[:3, 3]

    @property
    def world_to_camera(self) -> Float[np.ndarray, "4 4"]:
        """Inverse of the rigid pose."""
        return np.linalg.inv(self.camera_to_world)

    def downscaled(self, side: int) -> "Camera":
        """The same camera with pixels as large as blocks of `side` × `side`, without what fills no block."""
        fx, fy, cx, cy = (value / side for value in (self.fx, self.fy, self.cx, self.cy))
        return Camera(self.camera_to_world, fx, fy, cx, cy, self.width // side, self.height // side)


def opengl_to_opencv(camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Turn a pose with OpenGL camera axes into one with OpenCV axes."""
    return camera_to_world @ OPENGL_OPENCV


def opencv_to_opengl(camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Inverse of `opengl_to_opencv`."""
    return camera_to_world @ OPENGL_OPENCV


def check_pose(camera_to_world: Float[np.ndarray, "..."], name: str) -> None:
    """Raise InputError unless the matrix is finite and rigid (rotation, translation, last row 0 0 0 1)."""
    remedy = "Correct transform_matrix of that frame: a 4×4 camera-to-world matrix, rotation and translation only."
    if camera_to_world.shape != (4, 4):
        raise InputError(expected=f"a 4×4 pose for {name}", found=f"shape {camera_to_world.shape}", remedy=remedy)
    # Not all that a float64 holds: squares of distances overflow, and meshes are written in float32.
    if not (np.abs(camera_to_world) <= np.finfo(np.float32).max).all():
        found = "NaN, infinity or a number above 3e38 in it"
        raise InputError(expected=f"a finite pose for {name}", found=found, remedy=remedy)
    rotation = camera_to_world[:3, :3]
    rigid = np.abs(rotation.T @ rotation - np.eye(3)).max() < ROTATION_TOLERANCE
    if not rigid or np.linalg.det(rotation) < 0 or not np.allclose(camera_to_world[3], [0, 0, 0, 1]):
        raise InputError(
            expected=f"a rigid, invertible pose for {name}",
            found=f"determinant {np.linalg.det(rotation):.4g}, rotation part not orthonormal or last row not 0 0 0 1",
            remedy=remedy,
        )


def ray_directions_world(camera: Camera) -> Float[np.ndarray, "H W 3"]:
    """Unit ray directions from the camera through every pixel center, in world coordinates."""
    x = (np.arange(camera.width) + PIXEL_CENTER - camera.cx) / camera.fx
    y = (np.arange(camera.height) + PIXEL_CENTER - camera.cy) / camera.fy
    grid_x, grid_y = np.meshgrid(x, y)
    directions = np.stack([grid_x, grid_y, np.ones_like(grid_x)], -1) @ camera.camera_to_world[:3, :3].T
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def project(camera: Camera, points_world: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Pixel coordinates (x, y) and z-depth of world points; depth ≤ 0 lies behind the camera."""
    rotation, center = camera.camera_to_world[:3, :3], camera.camera_to_world[:3, 3]
    points_camera = (points_world - center) @ rotation
    depth = points_camera[:, 2]
    safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
    x = points_camera[:, 0] / safe * camera.fx + camera.cx
    y = points_camera[:, 1] / safe * camera.fy + camera.cy
    return np.stack([x, y, depth], -1)


@dataclass(frozen=True)
class Similarity:
    """The map x ↦ s R x + t from one world to another."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    def __call__(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Where points go."""
        return self.scale * points @ self.rotation.T + self.shift

    def undone(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """The inverse."""
        return (points - self.shift) @ self.rotation / self.scale

    def pose(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """The rigid pose of the same camera in the other world."""
        moved = np.eye(4)
        moved[:3, :3] = self.rotation @ camera_to_world[:3, :3]
        moved[:3, 3] = self(camera_to_world[None, :3, 3])[0]
        return moved

    def pose_covariance(self, covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
        """That of a pose, of its turn (rad, world axes) and its shift, in the other world."""
        carried = np.zeros((6, 6))
        carried[:3, :3], carried[3:, 3:] = self.rotation, self.scale * self.rotation
        moved: np.ndarray = carried @ covariance @ carried.T
        return moved


def look_at(position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """OpenCV camera-to-world pose at `position` that looks at `target` with world +Z up in the image."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9:
        raise InputError(
            expected="a camera that does not look straight up or down",
            found=f"a view direction of {forward}",
            remedy="Limit the elevation of the camera path to less than 90°.",
        )
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = position
    return pose


def front_view(
    low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], fov_deg: float, spare: float = 1.0
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Position and target of a camera that sees the ball about a box whole, times `spare`, from the front and a little
    above.
    """
    target, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    distance = spare * radius / np.sin(np.radians(fov_deg / 2))
    return target + distance * FRONT / np.linalg.norm(FRONT), target


def reflect(
    ray_directions: Float[np.ndarray, "... 3"], normals: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "... 3"]:
    """Mirror directions ω = v − 2 (v·n) n (paper Eq. 5), renormalized; v points from the camera to the surface."""
    reflected = ray_directions - 2.0 * np.sum(ray_directions * normals, -1, keepdims=True) * normals
    return reflected / np.maximum(np.linalg.norm(reflected, axis=-1, keepdims=True), 1e-12)
