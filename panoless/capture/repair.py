"""Masks that the other views contradict: holes inside the object are filled, and pieces beside it removed.

A segmentation program that takes a lamp's reflection for background leaves a hole, and one that takes a second shiny
thing for the object a stray piece. Both cost the whole shape: a hole carves a tunnel through the visual hull, and a
stray piece has an outline to which no surface can attach.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from panoless.capture.masks import MASK_LEVEL
from panoless.capture.options import MaskRepairOptions
from panoless.capture.silhouettes import MaskDistance, mask_distance
from panoless.capture.views import MaskRepairs, TrainView, Views
from shinypartial.core.conventions import SOLID_ALPHA

Labels = Int[np.ndarray, "H W"]
#: Rays are followed through the ball about the object with this much more than its radius.
SPARE = 1.1


def with_repaired_masks(views: Views, options: MaskRepairOptions) -> Views:
    """The views with masks in which no hole and no piece contradicts the others.

    What is filled is on the object, but no photograph shows it whole, so it tells no color. What hangs together with
    the object's largest piece, or with the background around it, stays as it is.
    """
    if options.mode == "off" or len(views.train) < options.least_views:
        return views
    found = [(_holes(view, options), _pieces(view)) for view in views.train]
    if not any(part.any() for parts in found for part in parts):
        return views
    seen = _Seen.of(views, options)
    train, holes, pieces, changed = [], 0, 0, 0
    for index, (view, (of_holes, of_pieces)) in enumerate(zip(views.train, found, strict=True)):
        wrong_holes = [
            label for label in range(1, of_holes.max() + 1) if seen.is_object(index, _deepest(of_holes == label))
        ]
        wrong_pieces = [
            label
            for label in range(1, of_pieces.max() + 1)
            if seen.is_beside(index, _some(of_pieces == label, options))
        ]
        holes, pieces = holes + len(wrong_holes), pieces + len(wrong_pieces)
        changed += bool(wrong_holes or wrong_pieces)
        train.append(_repaired(view, np.isin(of_holes, wrong_holes), np.isin(of_pieces, wrong_pieces)))
    return replace(views, train=tuple(train), repairs=MaskRepairs(holes, pieces, changed))


def _holes(view: TrainView, options: MaskRepairOptions) -> Labels:
    """Numbers from 1 on for each piece of background that does not reach the border of the picture; else 0."""
    from scipy.ndimage import distance_transform_edt, label

    outside = view.mask.cpu().numpy() < MASK_LEVEL
    pieces, count = label(outside)
    border = np.concatenate([pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1]])
    enclosed = np.setdiff1d(np.arange(1, count + 1), border)
    if not len(enclosed):
        return np.zeros_like(pieces)
    wide = np.unique(pieces[distance_transform_edt(outside) >= options.least_radius_px])
    return _numbered(pieces, np.intersect1d(enclosed, wide))


def _pieces(view: TrainView) -> Labels:
    """Numbers from 1 on for each piece of the mask but the largest; else 0."""
    from scipy.ndimage import label

    pieces, count = label(view.mask.cpu().numpy() >= MASK_LEVEL, np.ones((3, 3)))
    if count < 2:
        return np.zeros_like(pieces)
    largest = 1 + int(np.bincount(pieces[pieces > 0] - 1).argmax())
    return _numbered(pieces, np.setdiff1d(np.arange(1, count + 1), [largest]))


def _numbered(pieces: Labels, kept: Int[np.ndarray, "K"]) -> Labels:
    numbers = np.zeros(int(pieces.max()) + 1, pieces.dtype)
    numbers[kept] = np.arange(1, len(kept) + 1)
    return numbers[pieces]


def _deepest(inside: Bool[np.ndarray, "H W"]) -> Int[Tensor, "1"]:
    """The pixel (flat index) farthest from the edge."""
    from scipy.ndimage import distance_transform_edt

    return torch.tensor([int(distance_transform_edt(inside).argmax())])


def _some(inside: Bool[np.ndarray, "H W"], options: MaskRepairOptions) -> Int[Tensor, "P"]:
    pixels = np.flatnonzero(inside)
    return torch.from_numpy(pixels[:: -(-len(pixels) // options.rays)])


def _repaired(view: TrainView, filled: Bool[np.ndarray, "H W"], removed: Bool[np.ndarray, "H W"]) -> TrainView:
    """Pixels beside a removed piece that belong to it in part go with it."""
    from scipy.ndimage import binary_dilation

    if not (filled.any() or removed.any()):
        return view
    alpha = view.mask.cpu().numpy()
    square = np.ones((3, 3), bool)
    rim = binary_dilation(filled, square) & (alpha >= MASK_LEVEL)
    mended = np.where(filled | rim, np.maximum(alpha, np.float32(SOLID_ALPHA)), alpha)
    fringe = binary_dilation(removed, square) & (alpha < MASK_LEVEL)
    mask = torch.from_numpy(np.where(removed | fringe, np.float32(0), mended)).to(view.mask)
    solid = view.solid[mask.flatten()[view.solid] > SOLID_ALPHA]
    return replace(view, mask=mask, solid=solid)


@dataclass(frozen=True)
class _Seen:
    """The masks of all views as signed distances, and which views look from near each other."""

    views: Views
    outlines: Sequence[MaskDistance]
    nearest: Int[np.ndarray, "V V"]
    """All views by the angle between their directions to the object's center, from each on."""
    options: MaskRepairOptions

    @classmethod
    def of(cls, views: Views, options: MaskRepairOptions) -> "_Seen":
        centers = np.array([view.position for view in views.train])
        sights = centers / np.linalg.norm(centers, axis=1, keepdims=True)
        return cls(
            views, [mask_distance(view) for view in views.train], np.argsort(-sights @ sights.T, axis=1), options
        )

    def is_object(self, index: int, pixels: Int[Tensor, "P"]) -> bool:
        """Whether the others show the object at some point of these rays."""
        outside = self._outside(index, pixels, 0.0)
        near = outside[: self.options.near_views].any(0)
        return bool((~near & (outside.sum(0) <= self._allowed)).any())

    def is_beside(self, index: int, pixels: Int[Tensor, "P"]) -> bool:
        """Whether more of the others than may be wrong show something else at every point of these rays."""
        return bool((self._outside(index, pixels, self.options.margin_px).sum(0) > self._allowed).all())

    @property
    def _allowed(self) -> int:
        return int(self.options.contradicted_share * (len(self.outlines) - 1))

    def _outside(self, index: int, pixels: Int[Tensor, "P"], margin_px: float) -> Bool[np.ndarray, "W Q"]:
        """Whether points of the rays lie farther than that beside the masks of the other views, the nearest first."""
        view = self.views.train[index]
        center = view.position
        middle = float(np.linalg.norm(center))
        reach = SPARE * max(1.0, self.views.object_frame.reach)
        depths = torch.linspace(max(middle - reach, view.camera.near), middle + reach, self.options.ray_samples)
        rays = view.directions_world(pixels.to(view.mask.device)).cpu()
        points = (torch.from_numpy(center).float() + depths[:, None, None] * rays).reshape(-1, 3)
        others = [other for other in self.nearest[index] if other != index]
        distances = [
            self.outlines[other].distances(points.to(view.mask.device)) > margin_px * self.outlines[other].pixel
            for other in others
        ]
        return torch.stack(distances).cpu().numpy()
