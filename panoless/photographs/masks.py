"""Masks of the object: those that are given, or found from hints in one frame or a few: rectangles and clicks.

GrabCut (Rother et al. 2004) parts the object from what lies around: within a rectangle, or that of clicks around it. A
mask moves to the nearest view without one, as if painted on a plane, and GrabCut finds its edge there. Then each view
and its neighbors vote, and edges are found again. The visual hull of all masks judges them: it is as large as each of
them only where they agree.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from panoless.capture.masks import MAIN_SHARE, MASK_LEVEL, cut_sides, estimate_object_frame, largest_pieces
from panoless.photographs.frames import block_means
from panoless.photographs.hull import carve, overlap, sighted_ball, silhouette
from panoless.photographs.lens import opencv
from shinypartial.core.camera import Camera, project
from shinypartial.core.errors import InputError
from shinypartial.io.files import read_json
from shinypartial.io.images import read_png
from shinypartial.io.progress import Progress
from shinypartial.io.records import read_record

MASK_SIDE_PX = 240
"""Masks are found in pictures averaged to no more than this, and only their edges in larger ones: GrabCut takes seconds
for a picture of 800 pixels."""
ROUNDS = 3
"""Rounds of votes of views on masks, and of edges."""
LEAST_OVERLAP = 0.7
"""Overlap (intersection over union) of a view's mask and the hull's silhouette, in the median, below which poses and
masks contradict each other."""
HULL_VOXELS = 96
"""Voxels of the visual hull along a side."""
HULL_SPARE = 1.3
"""Half side of the hull's cube over the radius that rectangles or masks suggest."""
TOLERATED = 0.1
"""Share of the masks that may be left out of the hull, where the others contradict them."""
LEAST_FILLED = 0.95
"""Share of the masks, in the median view, that the silhouette of their hull must fill."""
BAND = 0.03
"""Half width of the band about a silhouette in which the edge is looked for, as a share of √area."""
BAND_OF_TURN = 0.1
"""So much more of √area, times the sine of the angle from the neighbor, where a silhouette is a neighboring view's."""
VOTERS = 5
"""So many views, itself and its neighbors, decide on a mask before its edge is searched again."""
CLICK_PX = 2
"""Radius of what a click marks, in pixels of those pictures."""

Box = tuple[float, float, float, float]
Points = tuple[tuple[float, float], ...]
#: Codes of GrabCut's trimaps.
AROUND, OBJECT, _, PERHAPS_OBJECT = range(4)
#: Blur of an edge that GrabCut leaves as a staircase, in pixels: the line at one half stays where it was.
EDGE_PX = 0.7
CHECK_MASKS = (
    "Check that masks are white on the object, else invert them, and that poses are those of these photographs."
)
MORE_HINTS = "Draw a rectangle in another photograph, such as --box X0,Y0,X1,Y1 --box-in {}, or add --clicks there."
NAMED = 5
"""So many masks are named at most."""
SEED_ITERATIONS, ITERATIONS = 5, 2


@dataclass(frozen=True)
class Hint:
    """Hints on the object in one photograph, in its pixels: a rectangle, or points around it, or both."""

    box: Box | None = None
    """A rectangle about the object: left, top, right, bottom."""
    on: Points = ()
    """Points (x, y) on the object."""
    off: Points = ()
    """Points beside it, and in its holes."""

    @property
    def bounds(self) -> Box:
        """The rectangle; without one, that of the points beside the object; InputError where they have no extent."""
        if self.box is not None:
            return self.box
        columns, rows = zip(*self.off, strict=True) if self.off else ((0.0,), (0.0,))
        bounds = min(columns), min(rows), max(columns), max(rows)
        if not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
            raise InputError(
                expected="clicks beside the object on all of its sides, in each photograph without a rectangle",
                found=f"{len(self.off)} beside it",
                remedy='Add some to the file of --clicks: {"NAME": {"off": [[x, y], [x, y], [x, y], [x, y]]}}.',
            )
        return bounds

    def scaled(self, side: int) -> "Hint":
        """The same in a picture whose pixels are blocks of `side` × `side`."""
        box = None if self.box is None else tuple(value / side for value in self.box)
        on, off = (tuple((x / side, y / side) for x, y in points) for points in (self.on, self.off))
        return Hint(box, on, off)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Masks:
    """What the stage of masks found."""

    origin: str
    names: tuple[str, ...]
    overlaps: tuple[float, ...]
    """Of each mask with the silhouette of the hull of all."""
    sigma_px: float = 0.0
    """Standard deviation of contours, of masks that are found here."""


def hull_of(views: Sequence[tuple[Camera, Float[np.ndarray, "_ _"]]]) -> tuple[Float[np.ndarray, "P 3"], float]:
    """Points of the hull of masks, and their spacing; as few masks are left out as let it fill the others."""
    frame = estimate_object_frame(views)
    half_side = HULL_SPARE * frame.radius
    inside = [(camera, mask >= MASK_LEVEL) for camera, mask in views]
    spacing = 2 * half_side / HULL_VOXELS
    for wrong in range(int(TOLERATED * len(views)) + 1):
        points = carve(inside, frame.center, half_side, HULL_VOXELS, wrong)
        filled = [
            np.count_nonzero(silhouette(camera, points, spacing) & mask) / np.count_nonzero(mask)
            for camera, mask in inside
        ]
        if np.median(filled) >= LEAST_FILLED:
            break
    return points, spacing


def overlaps_of(
    views: Mapping[str, tuple[Camera, Float[np.ndarray, "_ _"]]],
    remedy: str = CHECK_MASKS,
) -> tuple[float, ...]:
    """Overlap of each mask with the hull of all. Raises InputError for masks of the background, for empty ones, and
    where they contradict each other; `remedy` may have a place, {}, for the name of a photograph.
    """
    full = [name for name, (_, mask) in views.items() if sum(cut_sides(mask)) >= 3]
    empty = [name for name, (_, mask) in views.items() if not (mask >= MASK_LEVEL).any()]
    if 2 * len(full) > len(views) or empty:
        wrong, what = (empty, "are empty") if empty else (full, "reach three borders of their picture")
        raise InputError(
            expected="masks that are white on the object and black around it",
            found=f"{len(wrong)} of {len(views)} that {what}: {', '.join(wrong[:NAMED])}{' …' * (len(wrong) > NAMED)}",
            remedy=remedy.format(wrong[0]),
        )
    seen = tuple(views.values())
    points, spacing = hull_of(seen)
    found = tuple(overlap(mask >= MASK_LEVEL, silhouette(camera, points, spacing)) for camera, mask in seen)
    if np.median(found) < LEAST_OVERLAP:
        raise InputError(
            expected=f"masks and poses that agree on an object: overlap of at least {LEAST_OVERLAP:.0%}",
            found=f"{np.median(found):.0%} in the median view",
            remedy=remedy.format(list(views)[int(np.argmin(found))]),
        )
    return found


def masks_beside(source: Path, names: Sequence[str]) -> Path | None:
    """The folder `masks` in a folder of photographs or beside it, or beside a video, if it has one for each of them."""
    places = (folder / "masks" for folder in (source, source.parent))
    return next((place for place in places if all(_mask_of(place, name) for name in names)), None)


def _mask_of(folder: Path, name: str) -> Path | None:
    ends = (".png", ".png.png", ".jpg.png", "_mask.png", "_alpha.png", ".jpg", ".jpeg")
    return next((path for end in ends if (path := folder / f"{name}{end}").is_file()), None)


def given_mask(folder: Path, name: str) -> Path:
    """The file of a mask, by the name of its photograph; InputError where there is none."""
    found = _mask_of(folder, name)
    if found is None:
        raise InputError(
            expected=f"a mask for {name} in {folder}, such as {name}.png",
            found="none",
            remedy="Name masks as their photographs, or leave the photograph out.",
        )
    return found


def read_clicks(path: Path) -> dict[str, Hint]:
    """Hints of a JSON file: {"NAME": {"on": [[x, y], …], "off": [[x, y], …]}}; InputError for other content."""
    content = read_json(path, "the clicks")
    if not isinstance(content, dict):
        raise InputError(
            expected=f"a table of photographs in {path}", found="something else", remedy="See --help of --clicks."
        )
    return {
        name: read_record(Hint, entry, f"{path}, {name}", remedy='Write "on" and "off", points as [x, y] each.')
        for name, entry in content.items()
    }


def find_masks(
    whole: Mapping[str, Camera], folder: Path, hints: Mapping[str, Hint]
) -> dict[str, UInt8[np.ndarray, "_ _"]]:
    """Masks of all views from hints in some. Raises InputError for names of no view and for hints without content."""
    unknown = [name for name in hints if name not in whole]
    if unknown or not hints:
        raise InputError(
            expected="the names of posed frames for --box-in and --clicks, such as " + next(iter(whole)),
            found=", ".join(unknown) or "none",
            remedy="Take names of photographs without their suffix.",
        )
    names = list(whole)
    side, cameras, pictures = averaged(whole, folder, MASK_SIDE_PX)
    progress = Progress("masks", len(names) * (2 + ROUNDS))
    masks: dict[str, Bool[np.ndarray, "_ _"]] = {}
    known = {name: hint.scaled(side) for name, hint in hints.items()}
    for name, hint in known.items():
        trimap = np.full(pictures[name].shape[:2], PERHAPS_OBJECT, np.uint8)
        masks[name] = _cut(pictures[name], _hinted(trimap, hint), SEED_ITERATIONS)
        if not masks[name].any():
            raise InputError(
                expected=f"the object by --box or --clicks in {name}",
                found="nothing that differs from what lies around",
                remedy="Draw the rectangle some pixels larger than the object, add clicks, or give --masks.",
            )
        progress.advance()
    _spread(names, cameras, pictures, masks, progress)
    for _ in range(ROUNDS):
        ball = _ball(cameras, masks)
        voted = {name: _voted(name, cameras, masks, ball) for name in names}
        bands = {name: _band(voted[name], BAND) for name in names}
        bands |= {name: _hinted(bands[name], hint) for name, hint in known.items()}
        masks = {name: _cut(pictures[name], bands[name], ITERATIONS) for name in names}
        progress.advance(steps=len(names))
    found = {}
    for name, camera in whole.items():
        found[name] = smooth_edge(_sharpened(masks[name], camera, side, folder / f"{name}.png"))
        progress.advance()
    return found


def averaged(
    whole: Mapping[str, Camera], folder: Path, largest_px: int
) -> tuple[int, dict[str, Camera], dict[str, UInt8[np.ndarray, "_ _ 3"]]]:
    """All views as means over blocks that leave no side longer than `largest_px`, and the side of these blocks."""
    longest = max(max(camera.width, camera.height) for camera in whole.values())
    side = -(-longest // largest_px)
    cameras = {name: camera.downscaled(side) for name, camera in whole.items()}
    return side, cameras, {name: block_means(read_png(folder / f"{name}.png")[..., :3], side) for name in whole}


def enlarged(mask: Bool[np.ndarray, "_ _"], camera: Camera, side: int) -> Float[np.ndarray, "H W"]:
    """The mask of blocks of pixels in those pixels themselves, linear in between."""
    size = (mask.shape[1] * side, mask.shape[0] * side)
    large = opencv().resize(mask.astype(np.float32), size, interpolation=opencv().INTER_LINEAR)
    whole: np.ndarray = np.pad(large, ((0, camera.height - size[1]), (0, camera.width - size[0])))
    return whole


def _hinted(trimap: UInt8[np.ndarray, "H W"], hint: Hint) -> UInt8[np.ndarray, "H W"]:
    """The trimap with what hints fix: nothing beyond the rectangle, and disks about clicks."""
    found = trimap.copy()
    left, top, right, bottom = (max(round(value), 0) for value in hint.bounds)
    within = np.zeros(trimap.shape, bool)
    within[top:bottom, left:right] = True
    found[~within] = AROUND
    for points, code in ((hint.on, OBJECT), (hint.off, AROUND)):
        for x, y in points:
            opencv().circle(found, (round(x - 0.5), round(y - 0.5)), CLICK_PX, code, -1)
    return found


def _sharpened(mask: Bool[np.ndarray, "_ _"], camera: Camera, side: int, picture: Path) -> Bool[np.ndarray, "H W"]:
    """The mask of blocks of pixels in those pixels themselves: its edge is found again near by."""
    if side == 1:
        return mask
    trimap = _band(enlarged(mask, camera, side) > 0.5, 0.0, least_px=1.5 * side)
    return _cut(read_png(picture)[..., :3], trimap, 1)


def _spread(
    names: Sequence[str],
    cameras: Mapping[str, Camera],
    pictures: Mapping[str, UInt8[np.ndarray, "_ _ 3"]],
    masks: dict[str, Bool[np.ndarray, "_ _"]],
    progress: Progress,
) -> None:
    """A mask for each view, in the order in which they are near to one that has it."""
    while len(masks) < len(names):
        ball = _ball(cameras, masks)
        rays = {name: _unit(cameras[name].position_world - ball[0]) for name in names}
        pairs = [(float(rays[new] @ rays[old]), new, old) for new in names if new not in masks for old in masks]
        cosine, name, neighbor = max(pairs)
        moved = moved_mask(masks[neighbor], cameras[neighbor], cameras[name], ball)
        trimap = _band(moved, BAND + BAND_OF_TURN * float(np.sqrt(max(1 - cosine**2, 0))))
        masks[name] = _cut(pictures[name], trimap, ITERATIONS)
        progress.advance()


def _voted(
    name: str,
    cameras: Mapping[str, Camera],
    masks: Mapping[str, Bool[np.ndarray, "_ _"]],
    ball: tuple[Float[np.ndarray, "3"], float],
) -> Bool[np.ndarray, "_ _"]:
    """What most of a view's own mask and those of its neighbors, moved into it, contain."""
    center, _ = ball
    ray = _unit(cameras[name].position_world - center)
    near = sorted(masks, key=lambda other: -float(_unit(cameras[other].position_world - center) @ ray))
    votes = [moved_mask(masks[other], cameras[other], cameras[name], ball) for other in near[:VOTERS]]
    return np.mean(votes, 0) > 0.5


def moved_mask(
    mask: Bool[np.ndarray, "H W"], old: Camera, new: Camera, ball: tuple[Float[np.ndarray, "3"], float]
) -> Bool[np.ndarray, "_ _"]:
    """The mask of a view as another would see it, were it painted on the plane through the center that faces both."""
    cv2 = opencv()
    center, radius = ball
    normal = _unit(_unit(old.position_world - center) + _unit(new.position_world - center))
    right = _unit(np.cross(normal, old.camera_to_world[:3, 1]))
    down = np.cross(normal, right)
    corners = center + radius * np.array([right + down, right - down, -right - down, down - right])
    places = [(project(camera, corners)[:, :2] - 0.5).astype(np.float32) for camera in (old, new)]
    moved = cv2.warpPerspective(mask.astype(np.uint8), cv2.getPerspectiveTransform(*places), (new.width, new.height))
    return moved > 0


def _ball(
    cameras: Mapping[str, Camera], masks: Mapping[str, Bool[np.ndarray, "_ _"]]
) -> tuple[Float[np.ndarray, "3"], float]:
    """Where the object is, by the masks so far."""
    seen = []
    for name, mask in masks.items():
        rows, columns = np.nonzero(mask)
        if len(rows):
            box = (float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1))
            seen.append((cameras[name], box))
    return sighted_ball(list(cameras.values()), seen)


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / np.linalg.norm(vector)


def _band(shape: Bool[np.ndarray, "H W"], share: float, least_px: float = 2.0) -> UInt8[np.ndarray, "H W"]:
    """GrabCut's trimap, which is open within a band about a silhouette."""
    width = max(least_px, share * float(np.sqrt(np.count_nonzero(shape))))
    distance, trimap = signed_distance_px(shape), np.full(shape.shape, PERHAPS_OBJECT, np.uint8)
    trimap[distance > width - 0.5], trimap[distance < 0.5 - width] = OBJECT, AROUND
    return trimap


def signed_distance_px(where: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Distance from the edge of a region, positive inside; the border of the picture is no edge."""
    cv2 = opencv()
    inside, outside = (cv2.distanceTransform(each.astype(np.uint8), cv2.DIST_L2, 3) for each in (where, ~where))
    found: np.ndarray = np.where(where, inside - 0.5, 0.5 - outside)
    return found


def _cut(
    picture: UInt8[np.ndarray, "H W 3"], trimap: UInt8[np.ndarray, "H W"], iterations: int
) -> Bool[np.ndarray, "H W"]:
    """GrabCut from a trimap, in the part of the picture around it; the trimap itself where it leaves no choice."""
    cv2 = opencv()
    perhaps = trimap != AROUND
    rows, columns = np.nonzero(perhaps.any(1))[0], np.nonzero(perhaps.any(0))[0]
    if not len(rows):
        return perhaps
    margin = max(10, (rows[-1] - rows[0]) // 3)
    window = (
        slice(max(rows[0] - margin, 0), rows[-1] + margin),
        slice(max(columns[0] - margin, 0), columns[-1] + margin),
    )
    part = trimap[window].copy()
    if not (part == AROUND).any() or not (part == PERHAPS_OBJECT).any():
        return perhaps
    image = np.ascontiguousarray(picture[window])
    cv2.setRNGSeed(0)
    cv2.grabCut(image, part, None, np.zeros((1, 65)), np.zeros((1, 65)), iterations, cv2.GC_INIT_WITH_MASK)
    cut = np.zeros(trimap.shape, bool)
    cut[window] = (part == OBJECT) | (part == PERHAPS_OBJECT)
    return largest_pieces(cut, MAIN_SHARE) if cut.any() else cut


def smooth_edge(mask: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """The mask with an edge of about a pixel, whose line at one half is smooth."""
    return opencv().GaussianBlur(mask.astype(np.uint8) * 255, (0, 0), EDGE_PX)
