"""Pixels and silhouettes of all views as rays in the normalized frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.masks import BESIDE_PX, remembered
from panoless.capture.silhouettes import MaskContours, mask_contours
from panoless.capture.views import Views, concatenated, every_kth_pixel
from panoless.problem.rays import PixelRays
from shinypartial.core.conventions import SOLID_ALPHA

SATURATED = 0.97
"""Share of the largest radiance from which a pixel is taken for saturated."""


@dataclass(frozen=True)
class Pixels:
    """Solid pixels of all views, what they saw, and how far inside their mask they lie (px)."""

    rays: PixelRays
    radiance: Float[np.ndarray, "P 3"]
    inner_px: Float[np.ndarray, "P"]

    def chosen(self, index: Bool[np.ndarray, "P"] | Int[np.ndarray, "M"]) -> "Pixels":
        """Some of them."""
        return Pixels(self.rays.chosen(index), self.radiance[index], self.inner_px[index])


@remembered
def inner_distance_px(mask: Float[Tensor, "H W"]) -> Float[np.ndarray, "P"]:
    """How far each pixel lies from the nearest one that is not solid; the picture's border counts as such."""
    from scipy.ndimage import distance_transform_edt

    solid = np.pad(mask.cpu().numpy() > SOLID_ALPHA, 1)
    found: np.ndarray = distance_transform_edt(solid)[1:-1, 1:-1].astype(np.float32).ravel()
    return found


@remembered
def outer_distance_px(mask: Float[Tensor, "H W"]) -> Float[np.ndarray, "P"]:
    """How far each pixel lies from the nearest one that shows the object."""
    from scipy.ndimage import distance_transform_edt

    found: np.ndarray = distance_transform_edt(mask.cpu().numpy() <= 0).astype(np.float32).ravel()
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


def background_rays(views: Views, count: int) -> PixelRays:
    """Rays of pixels more than `BESIDE_PX` outside of their masks, as dense as `count` solid ones are."""
    stride = max(views.num_solid // count, 1)
    rays = []
    for number, view in enumerate(views.train):
        outside = np.flatnonzero(outer_distance_px(view.mask) > BESIDE_PX)
        rays.append(PixelRays.centers(view.camera, outside[number % stride :: stride], number))
    return concatenated(rays)


def silhouette_rays(views: Views, *, longest_only: bool = False) -> PixelRays:
    """Rays through all contours of the masks, or through the longest of each."""
    contours = mask_contours(views, longest_only=longest_only)
    length = np.linalg.norm(contours.rays, axis=1)
    focal = np.array([view.camera.fx for view in views.train])[contours.view]
    steps = dual(np.stack([contours.columns, contours.rows], 1) * length[:, None, None])
    return PixelRays(contours.centers, contours.rays / length[:, None], steps, 1 / (focal * length), contours.view)


def contours_of(rays: PixelRays) -> MaskContours:
    """Rays of contours, of unit direction, with how far a shift in space moves their pixel, times the distance."""
    moved = dual(rays.steps)
    return MaskContours(rays.view, rays.origins, rays.directions, moved[:, 0], moved[:, 1])


def dual(pairs: Float[np.ndarray, "P 2 3"]) -> Float[np.ndarray, "P 2 3"]:
    """The two vectors in the plane of each pair whose products with it are one and zero."""
    first, second = pairs[:, 0], pairs[:, 1]
    aa, ab, bb = (
        (one * other).sum(1, keepdims=True) for one, other in ((first, first), (first, second), (second, second))
    )
    area = np.maximum(aa * bb - ab**2, np.finfo(float).tiny)
    return np.stack([(bb * first - ab * second) / area, (aa * second - ab * first) / area], 1)


def is_saturated(radiance: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, "P 3"]:
    """Whether channels of pixels have the largest radiance of all, but for little."""
    found: np.ndarray = radiance >= SATURATED * radiance.max(0, initial=0.0)
    return found
