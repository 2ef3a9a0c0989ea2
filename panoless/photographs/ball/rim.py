"""The rim of a ball in a picture: circles by votes of edges, then the points of the rim to a tenth of a pixel.

An edge votes for the centers that lie along its gradient. A circle's *support* is the share of its circumference at
which an edge runs along it. What a mirror shows beside its rim is squeezed along it, so that circles of smaller radius
find support, too; the rim itself has most.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from panoless.numeric.robust import robust_scale, robust_weight
from panoless.photographs.lens import opencv

VOTING_SIDE_PX = 640
"""Votes are counted in a picture of this longest side."""
VOTED_RADII = (0.03, 0.48, 56)
"""Radii that are voted for, over the longest side: from, to, how many in equal ratios."""
OCTAVES, OF_OCTAVE = 4, 6
"""So many circles of each octave of radii are judged, as small ones abound in patterns."""
VOTES_BY_CHANCE = 0.1
"""Share of the circumference that has an edge pointing at any center."""
JUDGED_RADIUS_PX = 64
"""Circles are judged in a picture in which they have about this radius."""
SUPPORT_BY_CHANCE = 0.3
"""Largest support of circles about places where nothing is round: median of 37 pictures of a lobby."""
LEAST_CONTRAST = 0.6
"""Slope of an edge, in codes of 255 a pixel."""
AS_MUCH = 0.92
"""Share of the largest support from which a circle counts as having as much."""
POINTS = 720
"""Of the rim, all around."""
RIM_WINDOW_PX = (4.0, 2.0, 1.5)
"""About the circle, in which the rim's edge is looked for in rounds."""
STEEPEST = 0.765
"""A mirror shows at the depth s below its rim what changes as √s: seen with a blur σ, it changes most at 0.765 σ."""
HIDDEN_FROM_DEG, HIDDEN_TO_DEG = 12.0, 130.0
"""A gap in the rim so wide is a support that hides a part of the ball; a wider one is a rim that does not show."""


@dataclass(frozen=True)
class Circle:
    """A circle in a picture, in pixels with (0, 0) at the corner of the first one."""

    x: float
    y: float
    radius: float
    support: float = 0.0
    """Share of the circumference at which an edge runs along it."""

    @property
    def score(self) -> float:
        """How far the support is above that by chance, in units of its spread: the larger, the surer."""
        return (self.support - SUPPORT_BY_CHANCE) * min(self.radius, 150.0) ** 0.5

    def scaled(self, factor: float) -> "Circle":
        """In a picture that is so many times as large."""
        return replace(self, x=self.x * factor, y=self.y * factor, radius=self.radius * factor)

    def points(self, azimuths: Float[np.ndarray, "N"], factor: float = 1.0) -> Float[np.ndarray, "N 2"]:
        """At azimuths (rad) from +x toward +y, so many times as far from the center as the circle is."""
        around = np.stack([np.cos(azimuths), np.sin(azimuths)], 1)
        return np.array([self.x, self.y]) + factor * self.radius * around

    def contains(self, x: float, y: float) -> bool:
        """Whether a point lies inside."""
        return (x - self.x) ** 2 + (y - self.y) ** 2 < self.radius**2


@dataclass(frozen=True)
class Rim:
    """The points of a ball's rim that were seen, and where it was not."""

    circle: Circle
    points: Float[np.ndarray, "K 2"]
    """Pixels, in order around the circle."""
    seen: Bool[np.ndarray, "N"]
    """At which of so many azimuths, counted from +x toward +y."""

    def scaled(self, factor: float) -> "Rim":
        """In a picture that is so many times as large."""
        return Rim(self.circle.scaled(factor), self.points * factor, self.seen)

    @cached_property
    def gaps(self) -> tuple[tuple[float, float], ...]:
        """Azimuths (rad) between which a support hides the rim: from, to."""
        padded = ~_closed(self.seen)
        if padded.all() or not padded.any():
            return ()
        start = int(np.flatnonzero(~padded)[0])
        turned = np.roll(padded, -start)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], turned.view(np.int8), [0]])))
        step = 2 * np.pi / len(padded)
        found = [((a + start) * step, (b + start) * step) for a, b in edges.reshape(-1, 2)]
        low, high = np.radians([HIDDEN_FROM_DEG, HIDDEN_TO_DEG])
        return tuple((float(a), float(b)) for a, b in found if low < b - a < high)


def _closed(seen: Bool[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
    """Single azimuths do not interrupt a gap, nor a rim: by the majority of 9 neighbors."""
    near = np.convolve(np.concatenate([seen[-4:], seen, seen[:4]]).astype(float), np.full(9, 1 / 9), "valid")
    return near > 0.4


def circles(gray: UInt8[np.ndarray, "H W"]) -> list[Circle]:
    """The circles of a picture that have most support, the best first."""
    levels = _pyramid(gray)
    found = [_settled(levels, each) for each in _voted(gray)]
    found.sort(key=lambda each: -each.score)
    apart: list[Circle] = []
    for each in found:
        if all(np.hypot(each.x - other.x, each.y - other.y) > 0.2 * other.radius for other in apart):
            apart.append(each)
    return apart


def circle_near(gray: UInt8[np.ndarray, "H W"], guess: Circle) -> Circle:
    """The circle with most support near one that is known to a tenth of its radius."""
    return _settled(_pyramid(gray), guess)


def find_rim(gray: UInt8[np.ndarray, "H W"], circle: Circle) -> Rim:
    """The points of the rim: in rounds the steepest edge along each radius near the ellipse of those before."""
    center, azimuth = np.array([circle.x, circle.y]), np.arange(POINTS) * 2 * np.pi / POINTS
    radii, keep = np.full(POINTS, circle.radius), np.zeros(POINTS, bool)
    basis = np.stack([f(k * azimuth) for k in (1, 2) for f in (np.cos, np.sin)] + [np.ones(POINTS)], 1)
    blur = float(np.clip(circle.radius / 180, 0.8, 2.0))
    for window in RIM_WINDOW_PX:
        window = window * max(blur, 1.0)
        slopes, edge, steps = _along_radii(gray, center, azimuth, radii, window, blur)
        best = np.where(edge, np.abs(slopes), 0).argmax(1)
        rows = np.arange(POINTS)
        keep = edge[rows, best]
        inner = np.clip(best, 1, slopes.shape[1] - 2)
        left, middle, right = (np.abs(slopes[rows, inner + k]) for k in (-1, 0, 1))
        bend = left - 2 * middle + right
        peak = inner + np.where(np.abs(bend) > 1e-6, 0.5 * (left - right) / np.where(bend == 0, 1, bend), 0).clip(-1, 1)
        found = radii + steps[0] + peak * (steps[1] - steps[0])
        radii = basis @ _robust_fit(basis[keep], found[keep])
    off = np.abs(found - radii)
    keep &= off < 3 * max(float(np.median(off[keep])) if keep.any() else 1.0, 0.3)
    found, radii = found + STEEPEST * blur, radii + STEEPEST * blur
    around = np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
    middle = center + 2 * (radii[:, None] * around).mean(0)
    settled = replace(circle, x=float(middle[0]), y=float(middle[1]), radius=float(radii.mean()))
    return Rim(settled, (center + found[:, None] * around)[keep], keep)


def _robust_fit(basis: Float[np.ndarray, "P D"], values: Float[np.ndarray, "P"]) -> Float[np.ndarray, "D"]:
    weights = np.ones(len(values))
    for _ in range(8):
        weighted = basis * weights[:, None]
        solved = np.linalg.lstsq(weighted.T @ basis + 1e-9 * np.eye(basis.shape[1]), weighted.T @ values, rcond=None)[0]
        off = values - basis @ solved
        weights = robust_weight(off, robust_scale(off, 0.15, 2.0))
    return solved


def _along_radii(
    gray: UInt8[np.ndarray, "H W"],
    center: Float[np.ndarray, "2"],
    azimuth: Float[np.ndarray, "N"],
    radii: Float[np.ndarray, "N"],
    window: float,
    blur: float,
) -> tuple[Float32[np.ndarray, "N K"], Bool[np.ndarray, "N K"], Float[np.ndarray, "K"]]:
    """Slopes of the picture along radii at half pixels within a window, and where they are edges across them."""
    cv2 = opencv()
    margin = int(radii.max() + window) + 6
    left, top = (max(int(value) - margin, 0) for value in center)
    part = gray[top : int(center[1]) + margin, left : int(center[0]) + margin].astype(np.float32)
    smooth = cv2.GaussianBlur(part, (0, 0), blur)
    slope_x, slope_y = (cv2.Scharr(smooth, cv2.CV_32F, 1 - k, k) / 32 for k in (0, 1))
    steps = np.arange(-window - 0.5, window + 0.51, 0.5)
    reach = radii[:, None] + steps
    cosines, sines = np.cos(azimuth)[:, None], np.sin(azimuth)[:, None]
    at = [
        (value - 0.5).astype(np.float32)
        for value in (center[0] - left + cosines * reach, center[1] - top + sines * reach)
    ]
    sampled_x, sampled_y = (cv2.remap(each, *at, cv2.INTER_LINEAR) for each in (slope_x, slope_y))
    along = (sampled_x * cosines + sampled_y * sines).astype(np.float32)
    across = sampled_y * cosines - sampled_x * sines
    size = np.abs(along)
    peak = np.zeros(size.shape, bool)
    peak[:, 1:-1] = (size[:, 1:-1] >= size[:, :-2]) & (size[:, 1:-1] > size[:, 2:])
    return along, peak & (size > LEAST_CONTRAST) & (np.abs(across) < 0.5 * size), steps


def _pyramid(gray: UInt8[np.ndarray, "H W"]) -> list[UInt8[np.ndarray, "_ _"]]:
    cv2, levels = opencv(), [gray]
    while max(levels[-1].shape) > 2 * JUDGED_RADIUS_PX:
        levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    return levels


def _voted(gray: UInt8[np.ndarray, "H W"]) -> list[Circle]:
    """Centers and radii with most votes, of all sizes."""
    cv2 = opencv()
    scale = VOTING_SIDE_PX / max(gray.shape)
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.float32)
    small = cv2.GaussianBlur(small, (0, 0), 1.0)
    slope_x, slope_y = (cv2.Scharr(small, cv2.CV_32F, 1 - k, k) / 32 for k in (0, 1))
    size = np.hypot(slope_x, slope_y)
    rows, columns = np.nonzero(_ridges(slope_x, slope_y, size) & (size > 1.0) & (size > cv2.blur(size, (41, 41))))
    unit_x, unit_y = (each[rows, columns] / size[rows, columns] for each in (slope_x, slope_y))
    height, width = (length // 2 + 1 for length in size.shape)
    radii = np.geomspace(*VOTED_RADII[:2], VOTED_RADII[2]) * VOTING_SIDE_PX
    votes = np.zeros((len(radii), height, width), np.float32)
    for layer, radius in zip(votes, radii, strict=True):
        spread = max(0.8, 0.01 * radius)
        for sign in (1, -1):
            at_x, at_y = ((p + 0.5 + sign * radius * u) // 2 for p, u in ((columns, unit_x), (rows, unit_y)))
            inside = (at_x >= 0) & (at_x < width) & (at_y >= 0) & (at_y < height)
            places = (at_y[inside] * width + at_x[inside]).astype(np.int64)
            layer += np.bincount(places, minlength=height * width).reshape(height, width)
        share = cv2.GaussianBlur(layer, (0, 0), spread) * (spread**2 / radius)
        layer[:] = (share - VOTES_BY_CHANCE) * np.sqrt(radius)
    found = []
    for band in np.array_split(np.arange(len(radii)), OCTAVES):
        of_band = votes[band]
        for _ in range(OF_OCTAVE):
            number, row, column = (int(each) for each in np.unravel_index(of_band.argmax(), of_band.shape))
            if of_band[number, row, column] <= 0:
                break
            radius = float(radii[band[number]])
            found.append(Circle((2 * column + 1) / scale, (2 * row + 1) / scale, radius / scale))
            reach = int(0.15 * radius) + 1
            around = (slice(max(at - reach, 0), at + reach + 1) for at in (row, column))
            of_band[max(number - 8, 0) : number + 9, *around] = 0
    return found


def _ridges(
    slope_x: Float32[np.ndarray, "H W"], slope_y: Float32[np.ndarray, "H W"], size: Float32[np.ndarray, "H W"]
) -> Bool[np.ndarray, "H W"]:
    """Where the slope is larger than at both neighbors along it."""
    sector = (np.arctan2(slope_y, slope_x) * (4 / np.pi) + 8.5).astype(np.int8) % 4
    padded, (height, width) = np.pad(size, 1), size.shape
    ridge = np.zeros(size.shape, bool)
    for number, (down, right) in enumerate(((0, 1), (1, 1), (1, 0), (1, -1))):
        ahead, behind = (
            padded[1 + sign * down : 1 + sign * down + height, 1 + sign * right : 1 + sign * right + width]
            for sign in (1, -1)
        )
        ridge |= (sector == number) & (size >= ahead) & (size > behind)
    return ridge


def _settled(levels: list[UInt8[np.ndarray, "_ _"]], guess: Circle) -> Circle:
    """The circle near a guess that has most support, judged where it has a radius of some 64 pixels."""
    cv2 = opencv()
    level = int(np.clip(np.floor(np.log2(max(guess.radius / JUDGED_RADIUS_PX, 1))), 0, len(levels) - 1))
    picture, factor = levels[level], 2.0**level
    rest = guess.radius / factor / JUDGED_RADIUS_PX
    if rest > 1.02:
        picture = cv2.resize(picture, None, fx=1 / rest, fy=1 / rest, interpolation=cv2.INTER_AREA)
        factor *= rest
    x, y, radius = guess.x / factor, guess.y / factor, guess.radius / factor
    support = 0.0
    for low, high, span, step, sigma in ((0.7, 1.4, 0.12 * radius, 2.0, 1.2), (0.75, 1.3, 3.0, 1.0, 0.8)):
        center, count = np.array([x, y]), 180
        azimuth, middle = np.arange(count) * 2 * np.pi / count, 0.5 * (low + high) * radius
        window = 0.5 * (high - low) * radius
        _, edge, steps = _along_radii(picture, center, azimuth, np.full(count, middle), window, 1.0)
        shares = np.minimum(cv2.GaussianBlur(edge.astype(np.float32), (0, 0), 2 * sigma, sigmaY=0.01) * 5 * sigma, 1)
        shift = np.arange(-span, span + step / 2, step)
        right, down = (each.ravel() for each in np.meshgrid(shift, shift))
        offset = np.rint(2 * (np.outer(np.cos(azimuth), right) + np.outer(np.sin(azimuth), down))).astype(np.int64)
        columns, rows = np.arange(0, len(steps), 2), np.arange(count)
        profile = np.zeros((len(right), len(columns)), np.float32)
        for row in rows:
            profile += shares[row][np.clip(columns + offset[row][:, None], 0, len(steps) - 1)]
        # Inside the rim, too, edges run along circles: of those with about as much support the outermost is the rim.
        at = int(np.flatnonzero(profile.max(0) >= AS_MUCH * profile.max())[-1])
        best = int(profile[:, at].argmax())
        x, y, radius = x + float(right[best]), y + float(down[best]), middle + float(steps[columns[at]])
        support = float(profile[best, at]) / count
    return Circle(x * factor, y * factor, radius * factor, support)
