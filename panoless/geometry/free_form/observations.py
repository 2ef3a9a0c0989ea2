"""Pixels and outlines of all views as rays in the normalized frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from panoless.capture.masks import remembered
from panoless.capture.silhouettes import mask_contours
from panoless.capture.views import Views, concatenated, every_kth_pixel
from panoless.problem.rays import PixelRays
from shinypartial.core.conventions import SOLID_ALPHA


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
