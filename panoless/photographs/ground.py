"""Masks without a hint, where the object stands on something flat with a pattern, such as a printed board.

The plane is known, so that each photograph can be laid out on it. What the plane shows is the color on which most of
them agree; a mirror, and all that stands above the plane, moves against it from view to view. A pixel that shows the
plane determines that nothing is on its ray: so points of space are cleared away by votes, and what is left over is the
object. Near its silhouette each view's own pixels decide.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from panoless.capture.masks import MAIN_SHARE, largest_pieces
from panoless.photographs.hull import carve, cube, nearest_point, pixels_of, silhouette
from panoless.photographs.lens import opencv
from panoless.photographs.masks import EDGE_PX, HULL_SPARE, HULL_VOXELS, TOLERATED, averaged, enlarged
from shinypartial.core.camera import Camera
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import tangents
from shinypartial.dataset.schema import GroundPlane
from shinypartial.io.images import write_png
from shinypartial.io.progress import Progress

SIDE_PX = 640
"""Masks by the ground are found in pictures averaged to no more than this."""
TEXELS = 640
"""Texels along a side of the square of ground."""
REACH = 0.5
"""Half side of the square of ground that is looked at, as a share of the distance of the cameras."""
CANDIDATES = 8
"""Views of which each texel takes the one with which most others agree."""
DIFFERENCE = 0.1
"""Codes of one place of the ground differ by less, of 1, between views that agree."""
AGREEING = 4
"""So many views must agree on a texel of the ground."""
AGREEING_SHARE = 0.15
"""So must this share of the views that reach it; what the object hides in most views is known from the others."""
WINDOW_PX = 7
"""Side of a window that shows the ground, or does not."""
WIDE_PX = 17
"""Side of a window near it that has to show it, too, because a small one can look like it by chance."""
NOISE = 0.06
"""Contrast, in codes of 1, that a plain window counts as having."""
LARGEST_LEFT = 0.1
"""A window shows the ground where less than this share of the contrast is left."""
CLEARED = (0.12, 0.15, 0.3)
"""A point of space is the object for sure, likely, or perhaps, where ground is seen at it in a smaller share of the
views."""

GIVE_MASKS = (
    "Give a folder of masks (--masks), a model (--segmenter), a rectangle about the object in a frame or two "
    "(--box X0,Y0,X1,Y1 --box-in NAME), or clicks (--clicks)."
)
#: One texel of this many determines how bright a view is.
SPARSE = 4
SPECK_PX = 5
#: Differences of a pixel from the ground, in codes of 1, between which they are counted.
STEPS = np.array([0.005, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.25])
#: A point is judged where so large a share of the views shows it.
LEAST_COUNTED = 0.3


@dataclass(frozen=True)
class Sheet:
    """A square of the plane as a picture: the middle of texel (column x, row y) is first + x right + y down."""

    first: Float[np.ndarray, "3"]
    right: Float[np.ndarray, "3"]
    down: Float[np.ndarray, "3"]
    count: int

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Its middle."""
        return self.first + (self.count - 1) / 2 * (self.right + self.down)

    @property
    def half_side(self) -> float:
        """In units of the world."""
        return self.count / 2 * float(np.linalg.norm(self.right))

    def to_pixels(self, camera: Camera) -> Float[np.ndarray, "3 3"]:
        """The homography from (x, y, 1) to pixels whose centers are whole numbers, as OpenCV has them."""
        axes = np.stack([self.right, self.down, self.first - camera.position_world], 1)
        intrinsics = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
        homography: np.ndarray = intrinsics @ camera.camera_to_world[:3, :3].T @ axes
        return homography


@dataclass(frozen=True)
class Evidence:
    """What the pixels of a view show of the ground."""

    camera: Camera
    shown: Bool[np.ndarray, "H W"]
    """Where the ground is seen for sure: in a whole window."""
    predicted: Bool[np.ndarray, "H W"]
    """Where the ground's color is predicted."""
    left: Float[np.ndarray, "H W"]
    """By how much each pixel differs from the ground that it would show, in codes of 1."""


def sheet_about(cameras: Sequence[Camera], ground: GroundPlane) -> Sheet:
    """A square about the point below the one that all cameras look at."""
    normal = np.array(ground.normal)
    target = nearest_point(cameras)
    foot = target - (normal @ target - ground.offset) * normal
    half = REACH * float(np.median([np.linalg.norm(each.position_world - foot) for each in cameras]))
    right, down = tangents(normal)
    step = 2 * half / TEXELS
    first = foot - (half - step / 2) * (right + down)
    return Sheet(first, step * right, step * down, TEXELS)


def laid_out(
    pictures: Sequence[UInt8[np.ndarray, "_ _ 3"]], cameras: Sequence[Camera], sheet: Sheet
) -> tuple[Float[np.ndarray, "V N N 3"], Bool[np.ndarray, "V N N"]]:
    """Each picture on the sheet, codes in [0, 1], and where it reaches."""
    cv2 = opencv()
    size, flags = (sheet.count, sheet.count), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    colors, seen = [], []
    for picture, camera in zip(pictures, cameras, strict=True):
        homography = sheet.to_pixels(camera)
        whole = np.full(picture.shape[:2], 255, np.uint8)
        colors.append(cv2.warpPerspective(picture, homography, size, flags=flags).astype(np.float32) / 255)
        seen.append(cv2.warpPerspective(whole, homography, size, flags=flags) == 255)
    return np.stack(colors), np.stack(seen)


def pattern_of(
    colors: Float[np.ndarray, "V N N 3"], seen: Bool[np.ndarray, "V N N"]
) -> tuple[Float[np.ndarray, "N N 3"], Bool[np.ndarray, "N N"]]:
    """The sheet's own color, and where enough views agree on one.

    Of some views, the one with which most others agree has the color of a texel; it is the mean of these.
    """
    most = np.zeros(seen.shape[1:], np.int32)
    pattern = np.zeros(colors.shape[1:], np.float32)
    for each in np.linspace(0, len(colors) - 1, min(CANDIDATES, len(colors))).round().astype(int):
        count, total = np.zeros(most.shape, np.int32), np.zeros(pattern.shape, np.float32)
        for color, where in zip(colors, seen, strict=True):
            near = where & seen[each]
            for channel in range(3):
                near &= np.abs(color[..., channel] - colors[each, ..., channel]) < DIFFERENCE
            count += near
            total += np.where(near[..., None], color, 0)
        better = count > most
        pattern[better], most[better] = (total / np.maximum(count, 1)[..., None])[better], count[better]
    return pattern, (most >= AGREEING) & (most >= AGREEING_SHARE * seen.sum(0))


def gains_of(colors: Float[np.ndarray, "V N N 3"], seen: Bool[np.ndarray, "V N N"]) -> Float[np.ndarray, "V 3"]:
    """Factors that make the sheet as bright in each view as in all of them, a channel each."""
    pattern, known = pattern_of(colors, seen)
    gains = np.ones((len(colors), 3), np.float32)
    for number, (color, where) in enumerate(zip(colors, seen, strict=True)):
        both = known & where & (np.abs(color - pattern).max(-1) < 2 * DIFFERENCE)
        both &= np.minimum(pattern, color).min(-1) > DIFFERENCE
        if both.any():
            gains[number] = np.median(pattern[both] / color[both], axis=0)
    return gains


def evidence_of(
    picture: UInt8[np.ndarray, "H W 3"],
    camera: Camera,
    gain: Float[np.ndarray, "3"],
    sheet: Sheet,
    pattern: Float[np.ndarray, "N N 3"],
    known: Bool[np.ndarray, "N N"],
) -> Evidence:
    """Compare a view with what it would show of the sheet alone, which may be a pixel off.

    A window shows the ground where what is left of it is little beside the contrast of either.
    """
    cv2 = opencv()
    size, homography = (camera.width, camera.height), sheet.to_pixels(camera)
    expected = cv2.warpPerspective(pattern, homography, size, flags=cv2.INTER_LINEAR)
    predicted = cv2.warpPerspective(known.astype(np.uint8) * 255, homography, size, flags=cv2.INTER_LINEAR) == 255
    color = picture.astype(np.float32) / 255 * gain
    around = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(expected, around), cv2.dilate(expected, around)
    left = np.maximum(np.maximum(low - color, color - high), 0)
    wide, shown = (predicted & _matches(color, expected, left, predicted, width) for width in (WIDE_PX, WINDOW_PX))
    spread = 2 * ((WIDE_PX - WINDOW_PX) // 2 + 1) + 1
    shown &= cv2.dilate(wide.astype(np.uint8), np.ones((spread, spread), np.uint8)) > 0
    return Evidence(camera, shown, predicted, left.max(-1))


def _matches(
    color: Float[np.ndarray, "H W 3"],
    expected: Float[np.ndarray, "H W 3"],
    left: Float[np.ndarray, "H W 3"],
    predicted: Bool[np.ndarray, "H W"],
    width: int,
) -> Bool[np.ndarray, "H W"]:
    """Where little is `left` in a window of that width, beside the contrast of what is seen or expected there."""
    cv2 = opencv()
    share = np.maximum(cv2.blur(predicted.astype(np.float32), (width, width)), 1e-6)[..., None]

    def mean(values: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
        found: np.ndarray = cv2.blur(np.where(predicted[..., None], values, 0), (width, width)) / share
        return found

    contrast = mean(color**2) - mean(color) ** 2 + mean(expected**2) - mean(expected) ** 2 + NOISE**2
    matched: np.ndarray = mean(left**2).sum(-1) < LARGEST_LEFT * contrast.sum(-1)
    return matched


def cleared(seen: Sequence[Evidence], points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
    """The share of the views that see ground at each point, of those that show it; 1 where few do."""
    clear, counted = np.zeros(len(points)), np.zeros(len(points))
    for view in seen:
        rows, columns, within, depth = pixels_of(view.camera, points)
        within &= depth > 0
        at = np.where(within, rows, 0), np.where(within, columns, 0)
        clear += within & view.shown[at]
        counted += within & view.predicted[at]
    return np.where(counted >= LEAST_COUNTED * len(seen), clear / np.maximum(counted, 1), 1.0)


def ground_masks(
    whole: Mapping[str, Camera], folder: Path, ground: GroundPlane, picture: Path
) -> dict[str, UInt8[np.ndarray, "_ _"]]:
    """Masks of all views, and the ground as a `picture`. Raises InputError where nothing stands on it."""
    side, downscaled, blocks = averaged(whole, folder, SIDE_PX)
    cameras, pictures = list(downscaled.values()), list(blocks.values())
    progress = Progress("masks by the ground", len(whole))
    sheet = sheet_about(cameras, ground)
    colors, reached = laid_out(pictures, cameras, sheet)
    sparse = (slice(None), slice(None, None, SPARSE), slice(None, None, SPARSE))
    gains = gains_of(colors[sparse], reached[sparse])
    colors *= gains[:, None, None]
    pattern, known = pattern_of(colors, reached)
    write_png(picture, np.rint(255 * np.where(known[..., None], pattern, 0)).clip(0, 255).astype(np.uint8))
    seen = []
    for each, camera, gain in zip(pictures, cameras, gains, strict=True):
        seen.append(evidence_of(each, camera, gain, sheet, pattern, known))
        progress.advance()
    found = _object_points(seen, ground, sheet)
    silhouettes = [[silhouette(view.camera, points, found.spacing) for points in found.sets] for view in seen]
    odds = odds_of(seen, silhouettes)
    masks = [_mask(view, of_view, odds) for view, of_view in zip(seen, silhouettes, strict=True)]
    masks = _agreed(seen, masks, found)
    return {name: _at_full_size(mask, whole[name], side) for name, mask in zip(whole, masks, strict=True)}


@dataclass(frozen=True)
class _Points:
    """Grid points that are the object for sure, likely, and perhaps; each set holds the one before."""

    sets: tuple[Float[np.ndarray, "_ 3"], ...]
    spacing: float
    center: Float[np.ndarray, "3"]
    half_side: float


def _object_points(seen: Sequence[Evidence], ground: GroundPlane, sheet: Sheet) -> _Points:
    """What stands on the ground and is not cleared away: the largest piece, on a grid about it."""
    normal, count, half = np.array(ground.normal), HULL_VOXELS, sheet.half_side / 2
    center = sheet.center + half * normal
    for last in (False, True):
        points = cube(center, half, count)
        share = np.where(points @ normal > ground.offset, cleared(seen, points), 1.0)
        pieces, found = ndimage.label((share < CLEARED[-1]).reshape(count, count, count))
        if not found:
            raise InputError(
                expected="an object that stands before the ground in most photographs",
                found="nothing that moves against the ground",
                remedy=GIVE_MASKS,
            )
        largest = (pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:])).ravel()
        sets = tuple(points[largest & (share < limit)] for limit in CLEARED)
        if not last:
            low, high = sets[-1].min(0), sets[-1].max(0)
            center, half = (low + high) / 2, HULL_SPARE / 2 * float((high - low).max())
    return _Points(sets, 2 * half / count, center, half)


def odds_of(
    seen: Sequence[Evidence], silhouettes: Sequence[Sequence[Bool[np.ndarray, "_ _"]]]
) -> Float[np.ndarray, "_"]:
    """The logarithm of how much likelier a difference is on the object than on the ground, for each of `STEPS`.

    Counted in these photographs: well within the silhouette of what is the object for sure, and around that of what is
    perhaps.
    """
    counts = np.ones((2, len(STEPS) + 1))
    for view, (sure, _, perhaps) in zip(seen, silhouettes, strict=True):
        step = np.searchsorted(STEPS, view.left)
        around = _distance_px(~perhaps)
        for which, where in enumerate((_distance_px(sure) > 3, (around > 4) & (around < 40))):
            counts[which] += np.bincount(step[where & view.predicted], minlength=len(STEPS) + 1)
    on_object, on_ground = np.log(counts / counts.sum(1, keepdims=True))
    odds: np.ndarray = on_object - on_ground
    return odds


def _distance_px(where: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """How far each pixel is from those outside; what is beyond the picture is outside."""
    cv2 = opencv()
    found: np.ndarray = cv2.distanceTransform(np.pad(where, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    return found


def _mask(
    view: Evidence, silhouettes: Sequence[Bool[np.ndarray, "H W"]], odds_of_step: Float[np.ndarray, "_"]
) -> Bool[np.ndarray, "H W"]:
    """Between the silhouettes of what is the object for sure and of what is perhaps, the pixels of the view decide.

    That a place is likely the object counts as a pixel with odds of e; where a pixel shows nothing, this alone counts.
    """
    cv2 = opencv()
    sure, likely, perhaps = silhouettes
    odds = np.where(likely, 1.0, -1.0) + np.where(view.predicted, odds_of_step[np.searchsorted(STEPS, view.left)], 0.0)
    mask = (_distance_px(sure) > 2) | (perhaps & (cv2.GaussianBlur(odds, (0, 0), 1.0) > 0))
    return largest_pieces(cv2.medianBlur(mask.astype(np.uint8), SPECK_PX) > 0, MAIN_SHARE)


def _agreed(
    seen: Sequence[Evidence], masks: Sequence[Bool[np.ndarray, "_ _"]], found: _Points
) -> list[Bool[np.ndarray, "_ _"]]:
    """Masks by the hull of these where the view itself shows nothing, as before the far end of the room."""
    views = [(view.camera, mask) for view, mask in zip(seen, masks, strict=True)]
    allowed = int(TOLERATED * len(views))
    points = carve(views, found.center, found.half_side, HULL_VOXELS, allowed)
    agreed = []
    for view, mask in zip(seen, masks, strict=True):
        hull = silhouette(view.camera, points, found.spacing)
        agreed.append(largest_pieces(np.where(view.predicted, mask, hull), MAIN_SHARE))
    return agreed


def _at_full_size(mask: Bool[np.ndarray, "_ _"], camera: Camera, side: int) -> UInt8[np.ndarray, "H W"]:
    smooth = opencv().GaussianBlur(enlarged(mask, camera, side), (0, 0), EDGE_PX * side)
    return np.rint(255 * smooth).astype(np.uint8)
