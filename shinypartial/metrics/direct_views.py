"""A map against photographs of the surroundings themselves, taken past the object at the world's origin.

A pixel beside the object shows the point X = o + t v where its ray meets the surroundings, ‖X‖ = D(X/‖X‖). The map has
it in the direction X/‖X‖. Correlations are of log(L + ε), L luminance, in a band too, so that lamps don't decide.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.camera import Camera, project, ray_directions_world
from shinypartial.core.color import linear_to_srgb
from shinypartial.core.sphere import blur_latlong, latlong_directions, sample_latlong
from shinypartial.metrics.angular import angular_error_deg
from shinypartial.metrics.image import psnr

COLUMNS = 256
"""Of the grid of cells, means over blocks of pixels, on which views are compared."""
CLEARANCE = 1.25
"""Of the object, in its half angles."""
SUPPORT_WIDTH, SUPPORT_FROM = 3.0, 0.4
"""What the object stands on is left out: to either side, and from below the center, in radii in the picture."""
BAND_CELLS = (2.4, 16.0)
"""Standard deviations of the Gaussians between which the band lies."""
LOG_FLOOR = 0.004
"""ε: about the step of 8-bit codes in the dark."""
LIGHT = (0.004, 0.9)
"""Linear light from which a gain is taken: above noise, not clipped."""
WINDOW, STRIDE, REACH = 32, 16, 32
"""Side of a window, from one to the next, and how far it is looked for, in cells."""
SLOPE = 0.02
"""Root mean square slope of the band, per cell, that a window has in every direction."""
FARTHEST = 1e-6
"""1/D of a point that is seen in its direction from anywhere."""
REC709 = np.array([0.2126, 0.7152, 0.0722])
STEPS, CONVERGED = 24, 1e-9
"""Of the fixed point at which rays meet the surroundings, and by how much 1/D may then be off."""
LAMP_DEG = 2.0
"""Standard deviation of the Gaussian by which a map is blurred before lamps are looked for…"""
LAMP_REACH_DEG = 8.0
"""…and the angle within which light belongs to one of them."""


@dataclass(frozen=True)
class DirectView:
    """What a camera sees past the object: linear light in cells of its picture, and which cells show surroundings."""

    camera: Camera
    radiance: Float[np.ndarray, "H W 3"]
    shown: Bool[np.ndarray, "H W"]


@dataclass(frozen=True)
class DirectScores:
    """Of a map against one view, or medians over views."""

    correlation: float
    """Of log luminance in the band."""
    correlation_unfiltered: float
    psnr_srgb: float
    psnr_linear: float
    offset_deg: float | None
    """Median angle, from the object, between where the map has a window's features and where they are."""
    across_deg: float | None
    """Its part across the plane of camera, object and feature: whatever the distance of the surroundings."""
    windows: int


def direct_view(camera: Camera, radiance: Float[np.ndarray, "H W 3"], radius: float = 1.0) -> DirectView:
    """Cells of a photograph of linear light, and which lie beside the ball of that radius at the origin."""
    side = max(1, camera.width // COLUMNS)
    cells = camera.downscaled(side)
    cut = radiance[: cells.height * side, : cells.width * side]
    means = cut.reshape(cells.height, side, cells.width, side, 3).mean((1, 3), dtype=np.float64)
    return DirectView(cells, means, _beside(cells, radius))


def _beside(camera: Camera, radius: float) -> Bool[np.ndarray, "H W"]:
    distance = float(np.linalg.norm(camera.position_world))
    half = np.arcsin(min(radius / distance, 1.0))
    cosine = ray_directions_world(camera) @ (-camera.position_world / distance)
    x, y, _ = project(camera, np.zeros((1, 3)))[0]
    size = camera.fx * np.tan(half)
    right, down = np.meshgrid(np.arange(camera.width) + 0.5 - x, np.arange(camera.height) + 0.5 - y)
    support = (np.abs(right) < SUPPORT_WIDTH * size) & (down > SUPPORT_FROM * size)
    return np.asarray((cosine < np.cos(CLEARANCE * half)) & ~support)


def with_margin(camera: Camera, cells: int) -> Camera:
    """The same camera with a larger picture, by so many cells at each side."""
    grown = camera.width + 2 * cells, camera.height + 2 * cells
    return replace(camera, cx=camera.cx + cells, cy=camera.cy + cells, width=grown[0], height=grown[1])


def seen_from_origin(camera: Camera, inverse_distance: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "H W 3"]:
    """Unit directions from the origin to where each pixel's ray meets the surroundings: X/‖X‖, ‖X‖ = D(X/‖X‖).

    `inverse_distance` is 1/D as a lat-long map, 0 for infinitely far. D is no less than the camera's distance, which
    stands within the surroundings.
    """
    rays, origin = ray_directions_world(camera), camera.position_world
    most = 1 / (1.001 * float(np.linalg.norm(origin)))
    inverse = np.minimum(_inverse_at(inverse_distance, rays), most)
    for _ in range(STEPS):
        # t of ‖o + t v‖ = D, all over D, so that 1/D may be 0.
        middle = (rays @ origin) * inverse
        reach = np.sqrt(middle**2 + 1 - (origin @ origin) * inverse**2) - middle
        points = reach[..., None] * rays + inverse[..., None] * origin
        directions = points / np.linalg.norm(points, axis=-1, keepdims=True)
        last, found = inverse, np.minimum(_inverse_at(inverse_distance, directions), most)
        inverse = (last + found) / 2  # Converges where either alone swings.
        if np.abs(found - last).max() < CONVERGED:
            break
    return directions


def _inverse_at(
    inverse_distance: Float[np.ndarray, "h w"], directions: Float[np.ndarray, "*P 3"]
) -> Float[np.ndarray, "*P"]:
    return np.asarray(sample_latlong(inverse_distance[..., None].astype(np.float64), directions)[..., 0])


def gain_between(views: Sequence[DirectView], rendered: Sequence[Float[np.ndarray, "_ _ 3"]]) -> Float[np.ndarray, "3"]:
    """Median ratio of what is seen to what the map has, per channel, over all cells of all views that show them."""
    seen = np.concatenate([view.radiance[view.shown] for view in views])
    had = np.concatenate([picture[view.shown] for view, picture in zip(views, rendered, strict=True)])
    good = (seen > LIGHT[0]) & (seen < LIGHT[1]) & (had > 0)
    ratios = np.where(good, seen / np.where(good, had, 1), np.nan)
    return np.array([np.median(each[~np.isnan(each)]) if (~np.isnan(each)).any() else 1.0 for each in ratios.T])


def direct_scores(
    view: DirectView,
    rendered: Float[np.ndarray, "h w 3"],
    directions: Float[np.ndarray, "h w 3"],
    gain: Float[np.ndarray, "3"],
) -> DirectScores:
    """Of what the map has where the view looks, rendered with REACH cells of margin in those directions, times a gain.

    PSNR is of light clipped to [0, 1].
    """
    inner = slice(REACH, -REACH), slice(REACH, -REACH)
    had, seen, shown = rendered * gain, view.radiance, view.shown
    dark, light = _log_luminance(had), _log_luminance(seen)
    band = _band(light, shown), _band(dark[inner], shown)
    offsets = feature_offsets_deg(view, band[0], _band(dark, np.ones(dark.shape, bool)), directions)
    clipped = [np.clip(each[shown], 0, 1)[None] for each in (had[inner], seen)]
    return DirectScores(
        correlation=_correlation(band[0][shown], band[1][shown]),
        correlation_unfiltered=_correlation(light[shown], dark[inner][shown]),
        psnr_srgb=psnr(*map(linear_to_srgb, clipped), data_range=1),
        psnr_linear=psnr(clipped[0], clipped[1], data_range=1),
        offset_deg=float(np.median(offsets[:, 0])) if len(offsets) else None,
        across_deg=float(np.median(offsets[:, 1])) if len(offsets) else None,
        windows=len(offsets),
    )


def feature_offsets_deg(
    view: DirectView,
    direct: Float[np.ndarray, "H W"],
    rendered: Float[np.ndarray, "h w"],
    directions: Float[np.ndarray, "h w 3"],
) -> Float[np.ndarray, "N 2"]:
    """Angles between where the map has the features of windows of a direct view, and where they are: whole, and across.

    A window is looked for in the rendered picture, REACH cells larger at each side, at the shift of the largest
    normalized correlation, to a fraction of a cell by parabolas. Windows count that are shown whole and slope in every
    direction: the least eigenvalue of their mean ∇b ∇bᵀ is SLOPE² or more. Whatever its distance, a feature lies in the
    plane of the camera, the origin and its ray: the angle from that plane is the one across.
    """
    slopes = np.stack(np.gradient(direct), -1)
    corners = []
    for top in range(0, direct.shape[0] - WINDOW + 1, STRIDE):
        for left in range(0, direct.shape[1] - WINDOW + 1, STRIDE):
            place = slice(top, top + WINDOW), slice(left, left + WINDOW)
            slope = slopes[place].reshape(-1, 2)
            if view.shown[place].all() and np.linalg.eigvalsh(slope.T @ slope / len(slope))[0] >= SLOPE**2:
                corners.append((top, left))
    if not corners:
        return np.zeros((0, 2))
    windows = _cut(direct, corners, WINDOW)
    shifts = _best_shifts(windows - windows.mean((1, 2), keepdims=True), _cut(rendered, corners, WINDOW + 2 * REACH))
    middles = np.array(corners) + REACH + (WINDOW - 1) / 2
    there, here = _at(directions, middles + shifts), _at(directions, middles)
    normals = np.cross(view.camera.position_world, here)
    sines = (there * normals).sum(-1) / np.linalg.norm(normals, axis=-1)
    return np.stack([angular_error_deg(there, here), np.degrees(np.arcsin(np.abs(sines)))], -1)


def _cut(
    picture: Float[np.ndarray, "h w"], corners: Sequence[tuple[int, int]], side: int
) -> Float[np.ndarray, "N s s"]:
    return np.stack([picture[top : top + side, left : left + side] for top, left in corners])


def _best_shifts(windows: Float[np.ndarray, "N n n"], areas: Float[np.ndarray, "N m m"]) -> Float[np.ndarray, "N 2"]:
    """Rows and columns from the middles of areas to where windows of mean 0 correlate best with them."""
    size, places = areas.shape[1:], 2 * REACH + 1
    spectra = np.fft.rfft2(areas) * np.fft.rfft2(windows, s=size).conj()
    cross = np.fft.irfft2(spectra, s=size)[:, :places, :places]  # No window reaches around at these places.
    count = WINDOW**2
    scores = cross / np.sqrt(np.maximum(_box_sums(areas**2) - _box_sums(areas) ** 2 / count, 1e-9))
    shifts = np.empty((len(windows), 2))
    for i, score in enumerate(scores):
        best = np.array(np.unravel_index(score.argmax(), score.shape))
        shifts[i] = best - REACH
        for axis in range(2):
            if 0 < best[axis] < places - 1:
                step = np.eye(2, dtype=int)[axis]
                before, top, after = (float(score[tuple(best + k * step)]) for k in (-1, 0, 1))
                shifts[i, axis] += (after - before) / (2 * max(2 * top - before - after, 1e-12))
    return shifts


def _box_sums(areas: Float[np.ndarray, "N m m"]) -> Float[np.ndarray, "N k k"]:
    """Over windows, at each place within the areas."""
    sums = np.pad(areas.cumsum(1).cumsum(2), ((0, 0), (1, 0), (1, 0)))
    n = WINDOW
    return np.asarray(sums[:, n:, n:] - sums[:, :-n, n:] - sums[:, n:, :-n] + sums[:, :-n, :-n])


def _at(directions: Float[np.ndarray, "h w 3"], places: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Bilinear, at rows and columns."""
    from scipy.ndimage import map_coordinates

    return np.stack(
        [map_coordinates(plane, places.T, order=1, mode="nearest") for plane in directions.T.swapaxes(1, 2)], -1
    )


def _log_luminance(radiance: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    return np.log(np.maximum(radiance @ REC709, 0) + LOG_FLOOR)


def _band(values: Float[np.ndarray, "H W"], shown: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    from scipy.ndimage import gaussian_filter

    plain, weight = np.where(shown, values, 0), shown.astype(np.float64)
    low, high = (gaussian_filter(plain, s) / np.maximum(gaussian_filter(weight, s), 1e-3) for s in BAND_CELLS)
    return np.asarray(low - high)


def _correlation(one: Float[np.ndarray, "N"], two: Float[np.ndarray, "N"]) -> float:
    x, y = one - one.mean(), two - two.mean()
    return float(x @ y / max(float(np.linalg.norm(x) * np.linalg.norm(y)), 1e-12))


def direct_panorama(
    views: Sequence[DirectView], inverse_distances: Sequence[Float[np.ndarray, "_ _"]], height: int
) -> tuple[Float[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """What is seen directly as a lat-long map about the origin, the mean over views, and which directions are.

    Each view has its map of 1/D.
    """
    directions = latlong_directions(height)
    total, count = np.zeros((2 * height**2, 3)), np.zeros(2 * height**2)
    for view, inverse_distance in zip(views, inverse_distances, strict=True):
        inverse = np.maximum(_inverse_at(inverse_distance, directions), FARTHEST)
        x, y, depth = project(view.camera, (directions / inverse[..., None]).reshape(-1, 3)).T
        inside = (depth > 0) & (x >= 0) & (x < view.camera.width) & (y >= 0) & (y < view.camera.height)
        rows, columns = y[inside].astype(int), x[inside].astype(int)
        kept = view.shown[rows, columns]
        place = np.flatnonzero(inside)[kept]
        total[place] += view.radiance[rows, columns][kept]
        count[place] += 1
    shape = directions.shape[:2]
    return (total / np.maximum(count, 1)[:, None]).reshape(*shape, 3), (count > 0).reshape(shape)


def lamp_directions(radiance: Float[np.ndarray, "H W 3"], known: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "N 3"]:
    """Unit directions of lamps among the known directions of a lat-long map, the brightest first.

    Luminance is clipped to [0, 1], as photographs are; what is at least half as bright as the brightest is blurred by
    LAMP_DEG. The largest value is a lamp, at the centroid of what is within LAMP_REACH_DEG and at least half as bright;
    so is the largest one elsewhere, and so on down to half the first.
    """
    light = np.where(known, np.clip(radiance @ REC709, 0, 1), 0)
    light = np.where(light >= light.max() / 2, light, 0)
    left = np.where(known, blur_latlong(light[..., None], np.radians(LAMP_DEG))[..., 0], 0)
    directions, least = latlong_directions(len(light)), left.max() / 2
    areas, found = np.linalg.norm(directions[..., :2], axis=-1), []
    while left.max() >= max(least, 1e-9):
        near = directions @ directions.reshape(-1, 3)[left.argmax()] > np.cos(np.radians(LAMP_REACH_DEG))
        weights = np.where(near & (left >= left.max() / 2), left, 0) * areas
        centroid = np.tensordot(weights, directions, 2)
        found.append(centroid / np.linalg.norm(centroid))
        left = np.where(near, 0, left)
    return np.array(found).reshape(-1, 3)
