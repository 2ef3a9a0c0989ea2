"""Masks that the other views contradict: what they lack of the object is filled, and what stands out from it removed.

A segmentation program that takes a lamp's reflection for background leaves a hole or a dent, and one that takes a
second shiny thing for the object a stray piece. Both cost the whole shape: a hole carves a tunnel through the visual
hull, and a stray piece has a silhouette to which no surface can attach.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.masks import MASK_LEVEL
from panoless.capture.rays import in_camera, project
from panoless.capture.silhouettes import mask_distance
from panoless.capture.views import MaskRepairs, TrainView, Views
from shinypartial.core.conventions import SOLID_ALPHA

GRIDS = (48, 96)
"""Points along a side of the grids that views vote on, which contain the object: on the finer one, mended masks vote on
the masks as they were."""
LEAST_VIEWS = 20
"""With fewer views a gap of the object may be seen by one of them alone."""
CONTRADICTED_SHARE = 0.04
"""A point counts as the object's where no more than this share of the other views sees it beside their masks."""
NEAR_VIEWS = 4
"""Of so many views nearest in direction, none may see a point beside its mask that a view lacks."""
MARGIN = 0.8
"""What stands out lies farther than this beside the masks of the others, in spacings of the first grid."""
LEAST_RADIUS = 1.0
"""Parts in which no larger disk fits are left alone, in spacings."""
LEAST_RADIUS_PX = 3.0
"""The same in pixels, where these are wider than a third of a spacing."""
LARGEST_LENGTH = 6.0
"""Parts longer than so many times the radius of that disk are left alone: wrong poses make crescents."""
LEAST_SHARE = 0.75
"""Share that parts which are not long have of all that is as wide and contradicts, at least."""
ROUNDS = 4
"""Most rounds on each grid: masks that were mended determine more about others."""

Image = Bool[np.ndarray, "H W"]
#: The grid holds the ball about the object with this much more than its radius.
SPARE = 1.1
#: Pixels that touch at a corner are connected.
SQUARE = np.ones((3, 3), bool)


def with_repaired_masks(views: Views, *, grids: tuple[int, int] = GRIDS) -> Views:
    """The views with masks from which nothing as large as a blob is missing, and nothing stands out, by what the others
    say.

    What is filled is on the object, but no photograph shows it whole, so it determines no color. Crescents along an
    silhouette stay: wrong poses make them, and masks that are too small. Where these are most of what contradicts,
    nothing is mended. What is missing is filled first: holes in other masks look as if a view showed too much. In each
    round the mended masks vote on the masks as they were, in the last rounds on a finer grid.
    """
    if len(views.train) < LEAST_VIEWS:
        return views
    said, inside = views, [view.mask.cpu().numpy() >= MASK_LEVEL for view in views.train]
    margin = MARGIN * _Grid.of(views, grids[0]).spacing
    for cells in grids:
        grid, lacked, stood_out = _Grid.of(said, cells), 0, 0
        radii = [max(LEAST_RADIUS * grid.spacing_px(view), LEAST_RADIUS_PX) for view in said.train]
        for _ in range(ROUNDS):
            votes = _Votes.of(views, grid, margin)
            gaps = [~each & votes.shown(index) for index, each in enumerate(inside)]
            beyond = [each & ~votes.allowed(index) for index, each in enumerate(inside)]
            lacking, excess = (_Contradicted.of(regions, radii) for regions in (gaps, beyond))
            is_settled = lacking.area <= lacked and excess.area <= stood_out
            if is_settled or lacking.area + excess.area < LEAST_SHARE * (lacking.wide + excess.wide):
                break
            if lacking.area > lacked:
                excess = excess.without_any()
            lacked, stood_out = lacking.area, excess.area
            parts = zip(said.train, lacking.blobs, excess.blobs, radii, strict=True)
            train = tuple(_without(_filled(view, part, size), extra, size) for view, part, extra, size in parts)
            changed = sum(bool((one | other).any()) for one, other in zip(lacking.blobs, excess.blobs, strict=True))
            views = replace(said, train=train, repairs=MaskRepairs(lacking.count, excess.count, changed))
        if views is said:
            break
    return views


@dataclass(frozen=True)
class _Grid:
    """Points in the ball about the object, and how far apart they are."""

    points: Float[Tensor, "P 3"]
    spacing: float

    @classmethod
    def of(cls, views: Views, cells: int) -> "_Grid":
        reach = SPARE * max(1.0, views.object_frame.reach)
        side = torch.linspace(-reach, reach, cells)
        points = torch.stack(torch.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
        inside = points[points.norm(dim=1) <= reach].to(views.train[0].mask.device)
        return cls(inside, 2 * reach / (cells - 1))

    def spacing_px(self, view: TrainView) -> float:
        """In pixels of a view, at the object's center."""
        return self.spacing * view.camera.fx / float(np.linalg.norm(view.position))


@dataclass(frozen=True)
class _Votes:
    """Which views see each point of the grid beside their masks, and which see it farther off than a margin (normalized
    frame)."""

    views: Views
    grid: _Grid
    outside: Bool[np.ndarray, "V P"]
    beyond: Bool[np.ndarray, "V P"]
    nearest: Int[np.ndarray, "V K"]
    """The views that look from nearest to each."""

    @classmethod
    def of(cls, views: Views, grid: _Grid, margin: float) -> "_Votes":
        away = [mask_distance(view).distances(grid.points).cpu().numpy() for view in views.train]
        centers = np.array([view.position for view in views.train])
        sights = centers / np.linalg.norm(centers, axis=1, keepdims=True)
        order = np.argsort(-(sights @ sights.T) - 2 * np.eye(len(sights)), axis=1)[:, 1 : 1 + NEAR_VIEWS]
        outside, beyond = (np.array([each > farther for each in away]) for farther in (0.0, margin))
        return cls(views, grid, outside, beyond, order)

    def shown(self, index: int) -> Image:
        """Where a view has to show the object: nearly all others, and all those nearest, have it inside their masks."""
        near = self.outside[self.nearest[index]].any(0)
        return self._seen(index, ~near & self._is_inside(self.outside[index], self.times_outside))

    def allowed(self, index: int) -> Image:
        """Where it may: nearly all others have it inside their masks, or a margin beside them."""
        return self._seen(index, self._is_inside(self.beyond[index], self.times_beyond))

    @cached_property
    def times_outside(self) -> Int[np.ndarray, "P"]:
        """How many views see each point beside their masks."""
        return self.outside.sum(0)

    @cached_property
    def times_beyond(self) -> Int[np.ndarray, "P"]:
        """How many see it farther off."""
        return self.beyond.sum(0)

    def _is_inside(self, own: Bool[np.ndarray, "P"], times: Int[np.ndarray, "P"]) -> Bool[np.ndarray, "P"]:
        """Whether no more of the others than may be wrong are among those of all views."""
        wrong = int(CONTRADICTED_SHARE * (len(self.views.train) - 1))
        found: np.ndarray = times - own <= wrong
        return found

    def _seen(self, index: int, chosen: Bool[np.ndarray, "P"]) -> Image:
        """Pixels that show some of the chosen points, which lie closer than its gaps are closed."""
        from scipy.ndimage import maximum_filter, minimum_filter

        camera, points = self.views.train[index].camera, self.grid.points
        points_camera = in_camera(camera, points[torch.from_numpy(chosen).to(points.device)])
        columns, rows = (each.cpu().numpy() for each in project(camera, points_camera, first_center=0))
        nearest = max(float(points_camera[:, 2].min()), camera.near) if len(points_camera) else math.inf
        gap = max(1, math.ceil(self.grid.spacing * camera.fx / (2 * nearest)))
        image = np.zeros((camera.height + 2 * gap, camera.width + 2 * gap), bool)
        rows, columns = (np.rint(each).astype(int) + gap for each in (rows, columns))
        within = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
        image[rows[within], columns[within]] = True
        # A closing by a square, one axis at a time.
        size = 2 * gap + 1
        closed: np.ndarray = minimum_filter(maximum_filter(image, size, mode="constant"), size, mode="constant")
        return closed[gap:-gap, gap:-gap]


@dataclass(frozen=True)
class _Contradicted:
    """Of the region of each view that others contradict, the parts that are as wide as the least disk and not long."""

    blobs: list[Image]
    count: int
    """Of these parts."""
    area: int
    """Of these parts, in pixels…"""
    wide: int
    """…and of all that is as wide."""

    def without_any(self) -> "_Contradicted":
        """The same with none of these parts."""
        return _Contradicted([np.zeros_like(blob) for blob in self.blobs], 0, 0, self.wide)

    @classmethod
    def of(cls, regions: Sequence[Image], radii: Sequence[float]) -> "_Contradicted":
        """`radii` are those of the least disk in the pixels of each view."""
        from scipy.ndimage import find_objects, label

        blobs, count, wide = [np.zeros_like(region) for region in regions], 0, 0
        for region, blob, radius in zip(regions, blobs, radii, strict=True):
            depth, opened = _opened(region, radius)
            parts, _ = label(opened, SQUARE)
            for number, box in enumerate(find_objects(parts), start=1):
                part = parts == number
                longest = max(side.stop - side.start for side in box)
                if longest <= LARGEST_LENGTH * depth[part].max():
                    blob |= part
                    count += 1
            wide += int(opened.sum())
        return cls(blobs, count, sum(int(blob.sum()) for blob in blobs), wide)


def _opened(region: Image, radius: float) -> tuple[Float[np.ndarray, "H W"], Image]:
    """Depth of each pixel in a region, and the disks of that radius that fit into it."""
    from scipy.ndimage import distance_transform_edt

    depth = distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1]
    core = depth >= radius
    return depth, region & (distance_transform_edt(~core) <= radius) if core.any() else core


def _filled(view: TrainView, part: Image, radius: float) -> TrainView:
    """With that part on the object, and gaps beside it that are narrower than a disk."""
    from scipy.ndimage import binary_fill_holes

    if not part.any():
        return view
    alpha = view.mask.cpu().numpy()
    inside = (alpha >= MASK_LEVEL) | part
    part = part | _narrow_beside(binary_fill_holes(inside) & ~inside, part, radius)
    return _with_mask(
        view, np.where(_grown(part) & (alpha >= MASK_LEVEL) | part, np.maximum(alpha, SOLID_ALPHA), alpha)
    )


def _without(view: TrainView, part: Image, radius: float) -> TrainView:
    """With that part, and half pixels and pieces beside it that are narrower than a disk, off the object."""
    if not part.any():
        return view
    alpha = view.mask.cpu().numpy()
    part = part | _narrow_beside((alpha >= MASK_LEVEL) & ~part, part, radius)
    return _with_mask(view, np.where(part | _grown(part) & (alpha < MASK_LEVEL), 0, alpha))


def _narrow_beside(region: Image, part: Image, radius: float) -> Image:
    """Pieces of a region that touch a part and into which no disk of that radius fits."""
    from scipy.ndimage import label

    pieces, _ = label(region, SQUARE)
    wide = pieces[_opened(region, radius)[1]]
    found: np.ndarray = np.isin(pieces, np.setdiff1d(pieces[_grown(part)], [0, *wide]))
    return found


def _grown(part: Image) -> Image:
    from scipy.ndimage import binary_dilation

    found: np.ndarray = binary_dilation(part, SQUARE)
    return found


def _with_mask(view: TrainView, alpha: Float[np.ndarray, "H W"]) -> TrainView:
    mask = torch.from_numpy(alpha.astype(np.float32)).to(view.mask)
    return replace(view, mask=mask, solid=view.solid[mask.flatten()[view.solid] > SOLID_ALPHA])
