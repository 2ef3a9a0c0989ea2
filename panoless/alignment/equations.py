"""How what one camera sees of a surface changes when the camera is turned and shifted, in closed form.

A camera with the turn ω (rad, world axes) and the shift τ (normalized frame) sees a point at p from its center where it
saw p − ω × p − τ before. With the derivative P of the projection, a fixed point moves in the picture by

δq = −P (ω × p + τ),

and what is seen at a fixed pixel is what was seen at q − δq. So one picture of a surface (depth and normals) tells all
six derivatives, whatever the kind of the surface.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.alignment.options import PoseOptions
from panoless.capture.masks import MASK_LEVEL
from panoless.capture.rays import camera_rays, pose_of
from panoless.capture.silhouettes import BORDER_PX
from panoless.capture.views import TrainView
from panoless.environment.mirrored import MirroredRays
from panoless.environment.surroundings import FAR, Surroundings
from panoless.geometry.base import SOLID_SURFACE_ALPHA, SurfaceBuffers
from panoless.kernels.camera import RasterCamera
from panoless.numeric.robust import bounded_error, robust_weight
from shinypartial.core.conventions import PIXEL_CENTER


@dataclass(frozen=True)
class PoseRows:
    """Residuals of one view and their derivatives by (ω, τ)."""

    residual: Float[np.ndarray, "P K"]
    rows: Float[np.ndarray, "P K 6"]
    directions: Float[np.ndarray, "P 3"] | None = None
    """Of the light, where it is light that is compared."""

    @property
    def typical(self) -> float:
        """The median length of a residual; 0 where there is none."""
        return float(np.median(np.linalg.norm(self.residual, axis=1))) if len(self.residual) else 0.0

    def equations(self, scale: float, sigma: float) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6 6"], float]:
        """Gradient Jᵀ W e, matrix Jᵀ W J and cost Σ s² ρ/2σ² with Geman–McClure weights of that scale s."""
        weights = robust_weight(self.residual, scale) / sigma**2
        weighted = self.rows * weights[:, None, None]
        gradient = np.einsum("pki,pk->i", weighted, self.residual)
        matrix = np.einsum("pki,pkj->ij", weighted, self.rows)
        return gradient, matrix, float(bounded_error(self.residual, scale).sum()) * (scale / sigma) ** 2 / 2


def image_motion(camera: RasterCamera, points_camera: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2 6"]:
    """δq (px) of fixed points, given in camera axes, by (ω, τ)."""
    rotation, _ = pose_of(camera)
    x, y, z = points_camera.T
    zero = np.zeros_like(z)
    across = np.stack([camera.fx / z, zero, -camera.fx * x / z**2], 1)
    down = np.stack([zero, camera.fy / z, -camera.fy * y / z**2], 1)
    by_shift = -np.stack([across, down], 1) @ rotation
    points = points_camera @ rotation
    return np.concatenate([-np.cross(by_shift, points[:, None]), by_shift], 2)


def outline_rows(view: TrainView, distance_px: Float[np.ndarray, "H W"], surface: SurfaceBuffers) -> PoseRows:
    """How far the outline of a surface lies outside that of the mask, in pixels, at points along the first.

    `distance_px` is the signed distance from the mask's contour. No points where the surface is not seen, nor near the
    border of the picture, beyond which it may go on.
    """
    from scipy.ndimage import map_coordinates
    from skimage.measure import find_contours

    alpha = surface.alpha.cpu().numpy().astype(np.float64)
    curves = find_contours(alpha, MASK_LEVEL)
    places = np.concatenate([np.zeros((0, 2)), *(curve[:-1] for curve in curves)])
    inner = (np.minimum(places, np.array(alpha.shape) - 1 - places) > BORDER_PX).all(1)
    places = places[inner].T
    covered = (alpha > 0).astype(np.float64)
    depth, share = (
        map_coordinates(image, places, order=1)
        for image in (surface.depth.cpu().numpy().astype(np.float64) * covered, covered)
    )
    slopes = np.stack([map_coordinates(each, places, order=1) for each in np.gradient(distance_px)[::-1]], 1)
    rays = camera_rays(view.camera, places[1] + PIXEL_CENTER, places[0] + PIXEL_CENTER)
    motion = image_motion(view.camera, rays * (depth / share)[:, None])
    rows = np.einsum("pa,pai->pi", slopes, motion)
    return PoseRows(map_coordinates(distance_px, places, order=1)[:, None], rows[:, None])


def light_rows(
    view: TrainView,
    pixels: Int[np.ndarray, "P"],
    surface: SurfaceBuffers,
    environment: Float[Tensor, "6 3 L L"],
    options: PoseOptions,
    surroundings: Surroundings = FAR,
) -> PoseRows:
    """E(r) − c of those of the pixels (flat indices) around which the surface is smooth.

    r = d − 2 (d·n) n changes by the turn of the ray d, δd = ω × d, and by the normal that comes to the pixel,
    δn = −∇n δq.
    """
    camera = view.camera
    rotation, _ = pose_of(camera)
    normals, bend, smooth = _normals(surface, rotation, options.largest_bend_rad)
    pixels = pixels[smooth.ravel()[pixels]]
    n, by_place = normals.reshape(-1, 3)[pixels], bend.reshape(-1, 2, 3)[pixels]
    row, column = np.divmod(pixels, camera.width)
    rays = camera_rays(camera, column + PIXEL_CENTER, row + PIXEL_CENTER)
    depth = surface.depth.cpu().numpy().ravel()[pixels].astype(np.float64)
    d = rays @ rotation
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    motion = image_motion(camera, rays * depth[:, None])
    by_normal = -np.einsum("pac,pai->pci", by_place, motion)
    by_ray = np.zeros_like(by_normal)
    by_ray[:, :, :3] = np.cross(d[:, None], np.eye(3))
    seen = MirroredRays(d, n, pose_of(camera)[1] + rays * depth[:, None] @ rotation, surroundings)
    slopes = seen.slopes(environment)
    rows = np.matmul(seen.by_ray(slopes), by_ray) + np.matmul(seen.by_normal(slopes), by_normal)
    residual = seen.light(environment) - view.radiance_at(torch.from_numpy(pixels)).cpu().numpy()
    return PoseRows(residual, rows, seen.looked_up)


def _normals(
    surface: SurfaceBuffers, rotation: Float[np.ndarray, "3 3"], largest_bend: float
) -> tuple[Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W 2 3"], Bool[np.ndarray, "H W"]]:
    """Unit normals in world axes, their changes by a pixel to the right and down, and where these can be told."""
    image = np.moveaxis(surface.normals_camera.cpu().numpy().astype(np.float64), 0, 2) @ rotation
    image /= np.maximum(np.linalg.norm(image, axis=2, keepdims=True), 1e-12)
    covered = surface.alpha.cpu().numpy() > SOLID_SURFACE_ALPHA
    smooth = np.zeros_like(covered)
    smooth[1:-1, 1:-1] = (
        covered[1:-1, 1:-1] & covered[:-2, 1:-1] & covered[2:, 1:-1] & covered[1:-1, :-2] & covered[1:-1, 2:]
    )
    bend = np.stack(np.gradient(image, axis=(1, 0)), 2)
    return image, bend, smooth & (np.linalg.norm(bend, axis=3).max(2) < largest_bend)
