"""What masks say before any surface: their pieces, the sides on which the picture cuts them, the object's frame."""

import math
from collections.abc import Callable, Sequence
from functools import wraps
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import camera_rays
from shinypartial.core.camera import Camera, project
from shinypartial.core.conventions import PIXEL_CENTER
from shinypartial.core.errors import InputError

#: A pixel of at least this alpha is on the object.
MASK_LEVEL = 0.5
#: Masks err by less: pixels that lie farther beside them show what is past the object.
BESIDE_PX = 3.0
#: Pieces of a mask smaller than this share of its largest are specks, and are removed. An object's own pieces, such as
#: a tip that shows beyond a rim, are larger; a larger stray piece harms nothing but the size of the crop.
SPECK_SHARE = 0.002
#: Pieces smaller than this share have no weight in center and radius.
MAIN_SHARE = 0.05
#: The ball has this much more radius than the median mask.
SPARE = 1.1
#: The object's reach is this quantile over the views: a few wrong masks don't count.
REACH_QUANTILE = 0.95
#: Least eigenvalue, a view, of the equations of a center.
LEAST_SPREAD = 1e-4
#: Gaps of up to twice so many pixels between pieces of a mask are closed, in turn.
GAPS_PX = (1, 2, 4, 8)
#: Where views leave the depth of the object open, it is at least this, in units of the world.
LEAST_DEPTH = 1.0

Found = TypeVar("Found")


def remembered(find: Callable[[Tensor], Found]) -> Callable[[Tensor], Found]:
    """A function of a mask that keeps what it found as long as the mask is there. Masks are never changed in place."""
    known = WeakIdKeyDictionary()

    @wraps(find)
    def found(mask: Tensor) -> Found:
        if mask not in known:
            known[mask] = find(mask)
        result: Found = known[mask]
        return result

    return found


def largest_pieces(inside: Bool[np.ndarray, "H W"], share: float, gap_px: int = 0) -> Bool[np.ndarray, "H W"]:
    """The largest connected piece of a mask, and all others of at least `share` of its pixels.

    Pixels that touch at a corner are connected, and so are those with no more than 2·`gap_px` pixels between them.
    """
    from scipy.ndimage import binary_dilation, label

    square = np.ones((3, 3), bool)
    joined = binary_dilation(inside, square, gap_px) if gap_px else inside
    pieces, count = label(joined, square)
    if count <= 1:
        return inside
    sizes = np.bincount(pieces[inside], minlength=count + 1)
    return inside & (sizes >= share * sizes.max())[pieces]


def without_specks(alpha: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """The mask without pieces that are too small to be of the object; one of a single piece is returned as it is."""
    kept = largest_pieces(alpha > 0, SPECK_SHARE, gap_px=1)
    return alpha if kept.sum() == np.count_nonzero(alpha) else np.where(kept, alpha, 0)


def cut_sides(alpha: Float[np.ndarray, "H W"]) -> tuple[bool, bool, bool, bool]:
    """Whether the mask touches the left, top, right and bottom border of its picture, beyond which it may go on."""
    lines = alpha[:, 0], alpha[0], alpha[:, -1], alpha[-1]
    left, top, right, bottom = (bool((line >= MASK_LEVEL).any()) for line in lines)
    return left, top, right, bottom


def estimate_object_frame(
    masks: Sequence[tuple[Camera, Float[np.ndarray, "_ _"]]], known_radius: float = 0.0
) -> ObjectFrame:
    """Center, radius and reach of the object from where the masks lie in the views.

    The center is the point nearest, in least squares, to the rays through the middles of the masks' boxes. Of a box
    that the picture cuts at one side or two opposite ones, the plane through the other two sides' middle counts instead
    of the ray, and of one that is cut both ways nothing, unless too little is left.
    The radius is the median of d sin(arctan(r)) over the uncut views, or all if there are none, with a tenth to spare:
    d is the distance of the center, and r that of the farthest mask pixel from the projected center over the focal
    length. The reach is a high quantile over all views.
    When all cameras look along one line, the depth is open: it is that at which the masks have a `known_radius`, or,
    for zero, that of the point of the line nearest to the world's origin, at least one unit.
    """
    pieces = [(camera, largest_pieces(alpha >= MASK_LEVEL, MAIN_SHARE)) for camera, alpha in masks]
    cuts = [cut_sides(alpha) for _, alpha in masks]
    uncut = np.array([not any(sides) for sides in cuts])
    center = _center(pieces, cuts)
    if center is None:
        center = _center(pieces, [(False,) * 4] * len(masks))
    depth_is_open = center is None
    if center is None:
        center = _center_on_line(pieces, known_radius)
    radii = np.array([_mask_radius(camera, inside, center) for camera, inside in pieces])
    radius = SPARE * float(np.median(radii[uncut] if uncut.any() else radii))
    return ObjectFrame(center, radius, float(np.quantile(radii, REACH_QUANTILE)) / radius, depth_is_open)


def _center_on_line(pieces: Sequence[tuple[Camera, Bool[np.ndarray, "_ _"]]], known_radius: float) -> np.ndarray:
    """A point on the line along which all cameras look, at which the first mask has the `known_radius`, unless zero."""
    camera, inside = pieces[0]
    ray = _middle_ray(camera, inside)
    depth = max(float(-ray @ camera.position_world), LEAST_DEPTH)
    if known_radius:
        depth *= known_radius / _mask_radius(camera, inside, camera.position_world + depth * ray)
    return camera.position_world + depth * ray


def _middle_ray(camera: Camera, inside: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "3"]:
    """The unit ray through the middle of a mask's box."""
    rows, columns = np.nonzero(inside)
    x, y = (np.array((places.min() + places.max() + 1) / 2) for places in (columns, rows))
    ray: np.ndarray = camera.camera_to_world[:3, :3] @ camera_rays(camera, x, y)
    return ray / np.linalg.norm(ray)


def _center(
    pieces: Sequence[tuple[Camera, Bool[np.ndarray, "_ _"]]], cuts: Sequence[tuple[bool, ...]]
) -> Float[np.ndarray, "3"] | None:
    """The point nearest to the rays, or planes, through the middles of the boxes; None where they leave it open."""
    normal_matrix, right_side = np.zeros((3, 3)), np.zeros(3)
    for (camera, inside), (left, top, right, bottom) in zip(pieces, cuts, strict=True):
        ray = _middle_ray(camera, inside)
        across = np.eye(3) - np.outer(ray, ray)
        # The camera axis along which the plane through the middle extends.
        for cut, along in ((left or right, 0), (top or bottom, 1)):
            if cut:
                direction = across @ camera.camera_to_world[:3, along]
                across = across - np.outer(direction, direction) / max(direction @ direction, 1e-12)
        normal_matrix += across
        right_side += across @ camera.position_world
    if np.linalg.eigvalsh(normal_matrix)[0] < LEAST_SPREAD * len(pieces):
        return None
    return np.linalg.solve(normal_matrix, right_side)


def _mask_radius(camera: Camera, inside: Bool[np.ndarray, "H W"], center: Float[np.ndarray, "3"]) -> float:
    x, y, depth = project(camera, center[None])[0]
    distance = float(np.linalg.norm(center - camera.position_world))  # Zero too where its square is too small.
    if min(depth, distance) <= 0:
        raise InputError(
            expected="cameras that look at one object",
            found="an object center behind one of the cameras",
            remedy="Check the axes of transform_matrix: OpenGL, the camera looks along −z. Cameras that stand in one "
            "place do not determine where the object is.",
        )
    rows, columns = np.nonzero(inside)
    across = np.hypot((columns + PIXEL_CENTER - x) / camera.fx, (rows + PIXEL_CENTER - y) / camera.fy).max()
    return distance * math.sin(math.atan(across))


@remembered
def joined(mask: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """A mask without the gaps between its pieces, such as bars between panes.

    It is the grey closing by a square twice as wide as joins them. A mask of one piece is returned as it is, and so is
    one that none of the squares joins.
    """
    from scipy.ndimage import grey_closing, label

    alpha = mask.cpu().numpy()
    if label(alpha >= MASK_LEVEL)[1] == 1:
        return mask
    for gap_px in GAPS_PX:
        if label(grey_closing(alpha, 2 * gap_px + 1) >= MASK_LEVEL)[1] == 1:
            return torch.from_numpy(grey_closing(alpha, 4 * gap_px + 1)).to(mask)
    return mask
