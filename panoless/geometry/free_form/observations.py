"""Pixels and outlines of all views as rays in the normalized frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from panoless.capture.lens import LensChange
from panoless.capture.masks import remembered
from panoless.capture.poses import Poses
from panoless.capture.rays import camera_rays, pose_of
from panoless.capture.silhouettes import mask_contours
from panoless.capture.views import Views, concatenated, every_kth_pixel
from panoless.kernels.camera import RasterCamera
from shinypartial.core.conventions import PIXEL_CENTER, SOLID_ALPHA


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


@dataclass(frozen=True)
class Pixels:
    """Solid pixels of all views, what they saw, and how far inside their mask they lie (px)."""

    rays: PixelRays
    radiance: Float[np.ndarray, "P 3"]
    inner_px: Float[np.ndarray, "P"]


@remembered
def inner_distance_px(mask: Float[Tensor, "H W"]) -> Float[np.ndarray, "P"]:
    """How far each pixel lies from the nearest one that is not solid; the picture's border counts as such."""
    from scipy.ndimage import distance_transform_edt

    solid = np.pad(mask.cpu().numpy() > SOLID_ALPHA, 1)
    found: np.ndarray = distance_transform_edt(solid)[1:-1, 1:-1].astype(np.float32).ravel()
    return found


def solid_pixels(views: Views, count: int) -> Pixels:
    """About `count` solid pixels of all views, evenly."""
    rays, radiance, inner = [], [], []
    for number, (view, pixels) in enumerate(every_kth_pixel(views, count)):
        index = pixels.cpu().numpy()
        rays.append(PixelRays.centers(view.camera, index, number))
        radiance.append(view.radiance_at(pixels).cpu().numpy().astype(np.float64))
        inner.append(inner_distance_px(view.mask)[index])
    return Pixels(concatenated(rays), np.concatenate(radiance), np.concatenate(inner))


def outline_rays(views: Views) -> PixelRays:
    """Rays through all contours of the masks."""
    contours = mask_contours(views, longest_only=False)
    length = np.linalg.norm(contours.rays, axis=1)
    focal = np.array([view.camera.fx for view in views.train])[contours.view]
    steps = np.zeros((len(length), 2, 3))
    return PixelRays(contours.centers, contours.rays / length[:, None], steps, 1 / (focal * length), contours.view)
