"""Rays through places of pictures, in the normalized frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from panoless.capture.lens import LensChange
from panoless.capture.poses import Poses
from panoless.capture.rays import camera_rays, pose_of
from panoless.kernels.camera import RasterCamera
from shinypartial.core.conventions import PIXEL_CENTER


@dataclass(frozen=True)
class PixelRays:
    """Rays of unit direction through places of pictures.

    `steps` are the changes of the direction by a pixel to the right and down; `size` is a pixel's angle (rad).
    """

    origins: Float[np.ndarray, "P 3"]
    directions: Float[np.ndarray, "P 3"]
    steps: Float[np.ndarray, "P 2 3"]
    size: Float[np.ndarray, "P"]
    view: Int[np.ndarray, "P"]

    @classmethod
    def through(
        cls, camera: RasterCamera, column: Float[np.ndarray, "P"], row: Float[np.ndarray, "P"], view: int = 0
    ) -> "PixelRays":
        """Through places (column, row) of a picture, in pixels; `view` is its number."""
        rotation, center = pose_of(camera)
        directions = camera_rays(camera, column, row) @ rotation
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        directions /= length
        axes = rotation[:2] / np.array([[camera.fx], [camera.fy]])
        across = np.einsum("pi,ai->pa", directions, axes)
        steps = (axes - across[..., None] * directions[:, None]) / length[..., None]
        size, number = 1 / (camera.fx * length[:, 0]), np.full(len(column), view)
        return cls(np.tile(center, (len(column), 1)), directions, steps, size, number)

    def chosen(self, index: slice | Bool[np.ndarray, "P"] | Int[np.ndarray, "M"]) -> "PixelRays":
        """Some of them."""
        return PixelRays(*(values[index] for values in vars(self).values()))

    def moved(self, poses: Poses) -> "PixelRays":
        """With their cameras there."""
        turns = Rotation.from_rotvec(poses.turns).as_matrix()[self.view]
        directions = np.matmul(turns, self.directions[..., None])[..., 0]
        steps = np.matmul(self.steps, turns.transpose(0, 2, 1))
        return PixelRays(self.origins + poses.shifts[self.view], directions, steps, self.size, self.view)

    def through_lens(self, lens: LensChange, axes: Float[np.ndarray, "P 3"]) -> "PixelRays":
        """Through a lens that is not as it is said to be; `axes` are the optical ones of their cameras."""
        origins, directions = lens.rays(self.origins, self.directions, axes)
        factor = float(np.exp(lens.focal or 0.0))
        return PixelRays(origins, directions, self.steps / factor, self.size / factor, self.view)

    @classmethod
    def centers(cls, camera: RasterCamera, pixels: Int[np.ndarray, "P"], view: int = 0) -> "PixelRays":
        """Through the centers of pixels, given by flat indices."""
        row, column = np.divmod(pixels, camera.width)
        return cls.through(camera, column + PIXEL_CENTER, row + PIXEL_CENTER, view)
