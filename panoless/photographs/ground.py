"""Masks without a hint, where the object stands on something flat with a pattern, such as a printed board.

The plane is known, so that each photograph can be laid out on it. What the plane shows is the color on which most of
them agree; a mirror, and all that stands above the plane, moves against it from view to view. A pixel that shows the
plane determines that nothing is on its ray: points of space are cleared away where all of a few adjacent views show it.
What is left is moved at its silhouettes to where pixels are likelier the object than the ground in the mean over all
views that see its edge there. Last each view draws its own edge near by, at the least total variation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from panoless.capture.masks import MAIN_SHARE, largest_pieces
from panoless.photographs.hull import cube, nearest_point, pixels_of, silhouette
from panoless.photographs.lens import opencv
from panoless.photographs.masks import EDGE_PX, HULL_SPARE, HULL_VOXELS, averaged, enlarged, signed_distance_px
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
AGREEING = 3
"""So many views must agree on a texel of the ground."""
WINDOW_PX = 7
"""Side of a window that shows the ground, or does not."""
WIDE_PX = 17
"""Side of a window near it that has to show it, too, because a small one can look like it by chance."""
NOISE = 0.06
"""Contrast, in codes of 1, that a plain window counts as having."""
LARGEST_LEFT = 0.1
"""A window shows the ground where less than this share of the contrast is left."""
CLEARED_BESIDE = 0.1
"""Pixels in such a window that differ by less, in codes of 1, show the ground, too."""
ADJACENT = 5
"""Views nearest in direction that all show ground at a point where nothing is."""
LEAST_COUNTED = 0.3
"""A point is judged where so large a share of the views shows it."""
MATCHED = 0.05
"""A pixel that differs from the ground by less, in codes of 1, may be the ground…"""
LEAST_DIFFERING = 0.25
"""Share of an object's pixels that differ more, in the median view: of bare ground, one in sixteen does."""
USUALLY = 0.94, 0.2
"""…as so many pixels of the ground do, and so many of a mirror, where few of a view say more…"""
FEW = 20.0
"""…which are so many."""
NEAR_SHARE = 0.06
"""Standard deviation of the region that determines these shares about a pixel, in √area of the object."""
EDGE_BAND_PX = 2.5
"""Pixels so near to a silhouette move it."""
MOST_ODDS = 3.0
"""Largest logarithm of odds of a pixel."""
MOVES, LEARNED_EVERY = 40, 5
"""Moves of the silhouettes, by a point of the grid each; shares are counted again every so many."""
LEAST_PULL = 0.1
"""Mean of the logarithms of odds by which a point changes sides."""
ROUNDING = 0.8
"""Standard deviation of a blur that rounds the object after each move, in points of the grid."""
TENSION = 2.0
"""Length of an edge that counts as much as a pixel with odds of e, where colors do not change…"""
EDGE_CONTRAST = 0.15
"""…and less by the exponential of their slope in units of this…"""
LEAST_TENSION = 0.15
"""…down to this share."""
OWN_SHARE, HULL_SHARE = 0.5, 0.5
"""Weights of a pixel's own odds, and of those of the common silhouette: one at 2 px beside it, three at most."""
SETTLED_PX = 15.0
"""Pixels farther from the common silhouette stay on its side."""
VARIATION_STEPS = 100

GIVE_MASKS = (
    "Give a folder of masks (--masks), a model (--segmenter), a rectangle about the object in a frame or two "
    "(--box X0,Y0,X1,Y1 --box-in NAME), or clicks (--clicks)."
)
#: One texel of this many determines how bright a view is.
SPARSE = 4


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

    @property
    def cleared(self) -> Bool[np.ndarray, "H W"]:
        """Where nothing is before the ground: pixels of a window that shows it, but for those that differ much."""
        around = opencv().dilate(self.shown.astype(np.uint8), np.ones((WINDOW_PX, WINDOW_PX), np.uint8)) > 0
        found: np.ndarray = around & (self.left < CLEARED_BESIDE) & self.predicted
        return found


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
    return pattern, most >= AGREEING


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
    points, spacing = object_points(seen, ground, sheet)
    common = [silhouette(view.camera, points, spacing) for view in seen]
    masks = [drawn_edge(*each) for each in zip(seen, common, pictures, strict=True)]
    return {name: _at_full_size(mask, whole[name], side) for name, mask in zip(whole, masks, strict=True)}


def object_points(
    seen: Sequence[Evidence], ground: GroundPlane, sheet: Sheet
) -> tuple[Float[np.ndarray, "P 3"], float]:
    """Points of a grid that are the object, and their spacing; InputError where nothing stands on the ground."""
    normal, count, half = np.array(ground.normal), HULL_VOXELS, sheet.half_side / 2
    center = sheet.center + half * normal
    for last in (False, True):
        points = cube(center, half, count)
        above = points @ normal > ground.offset
        inside = largest_part(above & ~is_cleared(seen, points, center), count)
        if differing_share(seen, points[inside], 2 * half / count) < LEAST_DIFFERING:
            raise InputError(
                expected="an object that stands before the ground in most photographs",
                found="nothing that moves against the ground",
                remedy=GIVE_MASKS,
            )
        if not last:
            low, high = points[inside].min(0), points[inside].max(0)
            center, half = (low + high) / 2, HULL_SPARE / 2 * float((high - low).max())
    inside = largest_part(moved_edges(seen, points, inside, above), count)
    return points[inside], 2 * half / count


def differing_share(seen: Sequence[Evidence], points: Float[np.ndarray, "P 3"], spacing: float) -> float:
    """Of the pixels that show some points before ground: how many differ from it, in the median view; 0 of none."""
    shares = [0.0]
    for view in seen:
        where = silhouette(view.camera, points, spacing) & view.predicted
        if where.any():
            shares.append(float((view.left[where] > MATCHED).mean()))
    return float(np.median(shares))


def largest_part(inside: Bool[np.ndarray, "P"], count: int) -> Bool[np.ndarray, "P"]:
    """The largest connected part on a grid of count³ points."""
    parts, _ = ndimage.label(inside.reshape(count, count, count))
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0  # What is outside.
    found: np.ndarray = inside & (parts.ravel() == np.argmax(sizes))
    return found


def is_cleared(
    seen: Sequence[Evidence], points: Float[np.ndarray, "P 3"], center: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "P"]:
    """Where all of some adjacent views show ground, or where few views would."""
    clear, counted = np.zeros((len(seen), len(points)), bool), np.zeros((len(seen), len(points)), bool)
    for number, view in enumerate(seen):
        places, within = _places(view.camera, points)
        counted[number], clear[number] = within & view.predicted[places], within & view.cleared[places]
    away = np.stack([view.camera.position_world - center for view in seen])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    found = counted.sum(0) < LEAST_COUNTED * len(seen)
    for group in np.argsort(-(away @ away.T), axis=1)[:, :ADJACENT]:
        found |= (clear[group].sum(0) == counted[group].sum(0)) & (counted[group].sum(0) > len(group) / 2)
    return found


def moved_edges(
    seen: Sequence[Evidence],
    points: Float[np.ndarray, "P 3"],
    inside: Bool[np.ndarray, "P"],
    above: Bool[np.ndarray, "P"],
) -> Bool[np.ndarray, "P"]:
    """The object after its silhouettes moved to where pixels are as likely the object as the ground.

    A point near the object's edge changes sides by the mean, over views that see it near their silhouette, of the
    logarithms of odds there; each move is rounded.
    """
    cv2, count = opencv(), round(len(points) ** (1 / 3))
    spacing = float(points[1, 2] - points[0, 2])
    odds: list[np.ndarray] = []
    for move in range(MOVES):
        common = [silhouette(view.camera, points[inside], spacing) for view in seen]
        if move % LEARNED_EVERY == 0:
            odds = [
                cv2.GaussianBlur(log_odds(*each), (0, 0), 1.0).clip(-MOST_ODDS, MOST_ODDS)
                for each in zip(seen, common, strict=True)
            ]
        solid = inside.reshape(count, count, count)
        edge = np.flatnonzero((ndimage.binary_dilation(solid) & ~ndimage.binary_erosion(solid)).ravel() & above)
        pull, views = np.zeros(len(edge)), np.ones(len(edge))
        for view, of_view, where in zip(seen, odds, common, strict=True):
            places, within = _places(view.camera, points[edge])
            near = within & (np.abs(signed_distance_px(where)[places]) < EDGE_BAND_PX) & view.predicted[places]
            pull += np.where(near, of_view[places], 0)
            views += near
        moved = inside.copy()
        moved[edge[pull > LEAST_PULL * views]] = True
        moved[edge[pull < -LEAST_PULL * views]] = False
        rounded = ndimage.gaussian_filter(moved.reshape(solid.shape).astype(np.float32), ROUNDING) > 0.5
        rounded = rounded.ravel() & above
        if not rounded.any() or (rounded == inside).all():
            break
        inside = rounded
    return inside


def log_odds(view: Evidence, where: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """How much likelier each pixel is on the object than on the ground, as a logarithm; 0 where no ground is predicted.

    By whether it matches the ground: how often pixels do is counted in the region about it, well within the silhouette
    and around it. A mirror of the ground matches it more often than one of the sky.
    """
    cv2 = opencv()
    matched, distance = view.left < MATCHED, signed_distance_px(where)
    sigma = max(NEAR_SHARE * float(np.sqrt(np.count_nonzero(where))), 3.0)

    def share(region: Bool[np.ndarray, "H W"], usually: float) -> Float[np.ndarray, "H W"]:
        counted = (region & view.predicted).astype(np.float32)
        area = 2 * np.pi * sigma**2
        many, all_of_them = (area * cv2.GaussianBlur(each, (0, 0), sigma) for each in (counted * matched, counted))
        found: np.ndarray = (many + FEW * usually) / (all_of_them + FEW)
        return found

    of_object = share(distance > 3, USUALLY[1]).clip(0.02, 0.97)
    of_ground = np.maximum(share((distance < -2) & (distance > -40), USUALLY[0]).clip(0.5, 0.98), of_object + 0.01)
    odds = np.where(matched, np.log(of_object / of_ground), np.log((1 - of_object) / (1 - of_ground)))
    return np.where(view.predicted, odds, 0.0).astype(np.float32)


def drawn_edge(
    view: Evidence, common: Bool[np.ndarray, "H W"], picture: UInt8[np.ndarray, "H W 3"]
) -> Bool[np.ndarray, "H W"]:
    """The view's own edge near the common silhouette: the region u of least Σ g ‖∇u‖ + f u (Chan, Esedoglu and
    Nikolova 2006), with f the logarithm of the odds of the ground, by own pixels and by the common silhouette, and g
    smaller where colors change.
    """
    distance = signed_distance_px(common)
    f = -(OWN_SHARE * log_odds(view, common) + HULL_SHARE * (distance / 2).clip(-3, 3))
    f = np.where(np.abs(distance) > SETTLED_PX, -5 * np.sign(distance), f).astype(np.float32)
    smooth = opencv().GaussianBlur(picture.astype(np.float32) / 255, (0, 0), 0.7)
    slopes = [np.abs(np.diff(smooth, axis=axis, append=smooth.take([-1], axis))).max(-1) for axis in (0, 1)]
    g = TENSION * (LEAST_TENSION + np.exp(-np.hypot(*slopes) / EDGE_CONTRAST))
    found = least_variation(f, g.astype(np.float32)) > 0.5
    return largest_pieces(found, MAIN_SHARE) if found.any() else common


def least_variation(f: Float[np.ndarray, "H W"], g: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """u in [0, 1] of least Σ g ‖∇u‖ + f u, by the steps of Chambolle and Pock (2011)."""
    step = 1 / np.sqrt(8)
    u = (f < 0).astype(np.float32)
    ahead, dual = u.copy(), np.zeros((2, *f.shape), np.float32)
    for _ in range(VARIATION_STEPS):
        dual[0, :-1] += step * np.diff(ahead, axis=0)
        dual[1, :, :-1] += step * np.diff(ahead, axis=1)
        dual /= np.maximum(1, np.hypot(*dual) / g)
        divergence = dual.sum(0)
        divergence[1:] -= dual[0, :-1]
        divergence[:, 1:] -= dual[1, :, :-1]
        moved = np.clip(u + step * (divergence - f), 0, 1)
        ahead, u = 2 * moved - u, moved
    return u


def _places(
    camera: Camera, points: Float[np.ndarray, "P 3"]
) -> tuple[tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]], Bool[np.ndarray, "P"]]:
    """Row and column of each point, and whether the picture shows it."""
    rows, columns, within, depth = pixels_of(camera, points)
    within &= depth > 0
    return (np.where(within, rows, 0), np.where(within, columns, 0)), within


def _at_full_size(mask: Bool[np.ndarray, "_ _"], camera: Camera, side: int) -> UInt8[np.ndarray, "H W"]:
    smooth = opencv().GaussianBlur(enlarged(mask, camera, side), (0, 0), EDGE_PX * side)
    return np.rint(255 * smooth).astype(np.uint8)
