"""Silhouettes: sub-pixel contours of masks, as curves and as signed distances.

Where a mask touches the border of its picture the object may go on, so there is no silhouette along that border, and
what lies beyond it is unknown. Beyond the other borders there is no object.
"""

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.masks import MASK_LEVEL, cut_sides, joined, remembered
from panoless.capture.rays import camera_rays, in_camera, pose_of, project
from panoless.capture.views import TrainView, Views, concatenated
from panoless.kernels.camera import RasterCamera
from shinypartial.core.conventions import PIXEL_CENTER

#: Within this distance the curve itself is measured; beyond, pixels are.
EXACT_BAND_PX = 3.0
CURVE_STEP_PX = 0.5
#: Contour points nearer to a border that the mask touches are left out.
BORDER_PX = 1.0


@dataclass(frozen=True)
class MaskDistance:
    """How far each pixel center of a view lies outside its mask's curve, in pixels; negative inside.

    `cut` are the sides at which the mask touches the border of the picture: left, top, right, bottom.
    """

    camera: RasterCamera
    distance_px: Float[Tensor, "H W"]
    cut: tuple[bool, bool, bool, bool] = (False, False, False, False)

    @property
    def pixel(self) -> float:
        """Size of a pixel at the origin of the normalized frame."""
        return float(np.linalg.norm(pose_of(self.camera)[1])) / self.camera.fx

    def distances(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P"]:
        """Signed distance of points from the silhouette's cone, to first order: pixels · depth / focal length.

        −∞ where the view leaves it open: beyond the last pixel centers at a side of the picture that cuts the mask.
        """
        camera = self.camera
        points_camera = in_camera(camera, points)
        depth = points_camera[:, 2].clamp(min=camera.near)
        column, row = project(camera, points_camera, first_center=0)
        inner_column, inner_row = column.clamp(0, camera.width - 1), row.clamp(0, camera.height - 1)
        beyond = torch.hypot(column - inner_column, row - inner_row)
        left, top = inner_column.floor().clamp(max=camera.width - 2), inner_row.floor().clamp(max=camera.height - 2)
        across, down = inner_column - left, inner_row - top
        index = (top * camera.width + left).long()
        values = self.distance_px.flatten()
        upper = torch.lerp(values[index], values[index + 1], across)
        lower = torch.lerp(values[index + camera.width], values[index + camera.width + 1], across)
        before = points_camera[:, 2] > camera.near
        outside = torch.where(before, torch.lerp(upper, lower, down) + beyond, beyond + camera.width)
        if any(self.cut):
            past = column, row, camera.width - 1 - column, camera.height - 1 - row
            unknown = ~before
            for side, cut in zip(past, self.cut, strict=True):
                unknown = unknown | (side < 0) if cut else unknown
            outside = outside.masked_fill(unknown, -math.inf)
        return outside * depth / camera.fx


def mask_distance(view: TrainView) -> MaskDistance:
    """The silhouette of a view as a signed distance."""
    return MaskDistance(view.camera, silhouette_distance_px(view.mask), cut_sides(view.mask.cpu().numpy()))


@remembered
def silhouette_distance_px(mask: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """`mask_distance_px` of a view's mask."""
    return torch.from_numpy(mask_distance_px(mask.cpu().numpy())).to(mask.device)


def mask_distance_px(mask: Float[np.ndarray, "H W"], band_px: float = EXACT_BAND_PX) -> Float[np.ndarray, "H W"]:
    """Signed distance, positive outside, of pixel centers from the curve where the interpolated mask is one half.

    Beyond the band it is counted from pixel centers. A mask of one kind only is half its size away from a curve.
    """
    from scipy.ndimage import distance_transform_edt
    from scipy.spatial import cKDTree
    from skimage.measure import find_contours

    inside: np.ndarray = mask >= MASK_LEVEL
    if inside.all() or not inside.any():
        return np.full(mask.shape, (0.5 - inside.flat[0]) * sum(mask.shape), dtype=np.float32)
    distance = np.where(inside, 0.5 - distance_transform_edt(inside), distance_transform_edt(~inside) - 0.5)
    padded = np.pad(mask.astype(np.float64), 1, mode="edge")
    lines = padded[:, 0], padded[0], padded[:, -1], padded[-1]
    for line, cut in zip(lines, cut_sides(mask), strict=True):
        line *= cut
    # Of a mask that reaches one half and nothing more, the curve is where it does.
    curves = find_contours(padded, MASK_LEVEL) or find_contours(padded, np.nextafter(MASK_LEVEL, 0))
    points = np.concatenate([_refined(curve - 1) for curve in curves])
    near = np.nonzero(np.abs(distance) < band_px)
    to_curve, _ = cKDTree(points).query(np.stack(near, 1).astype(np.float64))
    distance[near] = np.where(inside[near], -to_curve, to_curve)
    return distance.astype(np.float32)


def _refined(curve: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "Q 2"]:
    """Points along a curve whose sides are at most a pixel's diagonal, a quarter of a pixel apart or less."""
    parts = math.ceil(math.sqrt(2) / CURVE_STEP_PX)
    shares = (np.arange(parts) / parts)[:, None, None]
    return (curve[:-1] * (1 - shares) + curve[1:] * shares).reshape(-1, 2)


@dataclass(frozen=True)
class MaskContours:
    """Contour points: rays of camera depth one, and how far a shift in space moves their pixel, times depth."""

    view: Int[np.ndarray, "P"]
    centers: Float[np.ndarray, "P 3"]
    rays: Float[np.ndarray, "P 3"]
    columns: Float[np.ndarray, "P 3"]
    rows: Float[np.ndarray, "P 3"]

    def every(self, stride: int) -> "MaskContours":
        """Every stride-th point."""
        return MaskContours(*(getattr(self, field.name)[::stride] for field in fields(self)))


@remembered
def _contours(mask: Float[Tensor, "H W"]) -> list[Float[np.ndarray, "_ 2"]]:
    """All curves on which the interpolated mask is one half, as rows and columns."""
    from skimage.measure import find_contours

    found: list[np.ndarray] = find_contours(mask.cpu().numpy().astype(np.float64), MASK_LEVEL)
    return found


def without_gaps(views: Views) -> Views:
    """With masks that are `joined`, where they come in pieces."""
    masks = [joined(view.mask) for view in views.train]
    if all(mask is view.mask for mask, view in zip(masks, views.train, strict=True)):
        return views
    return replace(views, train=tuple(replace(view, mask=mask) for mask, view in zip(masks, views.train, strict=True)))


def mask_contours(views: Views, *, longest_only: bool = True) -> MaskContours:
    """The longest closed or open contour of each mask, or all of them, without what runs along a border that the mask
    touches.
    """
    parts = []
    for index, view in enumerate(views.train):
        mask, camera, contours = view.mask.cpu().numpy(), view.camera, _contours(view.mask)
        if not contours:
            continue
        chosen = [max(contours, key=len)] if longest_only else contours
        pixels = np.concatenate([contour[:-1, ::-1] for contour in chosen]) + PIXEL_CENTER
        if any(cut := cut_sides(mask)):
            inner = np.concatenate([pixels, [camera.width, camera.height] - pixels], 1) > BORDER_PX
            pixels = pixels[(inner | ~np.array(cut)).all(1)]
        rotation, center = pose_of(camera)
        rays = camera_rays(camera, *pixels.T)
        columns = camera.fx * (rotation[0] - rays[:, :1] * rotation[2])
        rows = camera.fy * (rotation[1] - rays[:, 1:2] * rotation[2])
        centers = np.tile(center, (len(rays), 1))
        parts.append(MaskContours(np.full(len(rays), index), centers, rays @ rotation, columns, rows))
    if not parts:
        return MaskContours(np.zeros(0, dtype=np.int64), *(np.zeros((0, 3)) for _ in range(4)))
    return concatenated(parts)
