"""What lies beside a ball in its picture is a direct view of what the ball mirrors: a check that needs no truth.

A pixel beside the ball shows a point X = o + t v of the surroundings at the distance W from the ball. Seen from the
ball it lies in the direction X/‖X‖, in which other photographs, or this one near the rim, show it mirrored. Both are
compared by the correlation of their logarithms, band-passed, so that neither exposure nor a lamp above decides.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from panoless.photographs.ball.cone import BallCone
from panoless.photographs.ball.panorama import PHOTOGRAPHER_DEG, spans
from panoless.photographs.lens import Lens, opencv

COLUMNS = 128
"""Of the grid of directions beside a ball."""
DISTANCES = (30.0, 80.0, 200.0, 1e6)
"""W in radii of the ball, of which the one that agrees best counts."""
CLEARANCE = 1.25
"""Of the ball, in half angles."""
SUPPORT_WIDTH, SUPPORT_FROM = 3.0, 0.4
"""Below the ball, in radii: what it stands on is near, and is left out."""
BAND_PX = (1.2, 8.0)
"""Standard deviations of the Gaussians between which the band lies, in cells of the grid."""
LOG_LIGHT = np.log((np.arange(256, dtype=np.float32) / 255) ** 2.2 + 0.004)
VIEWS = 6
OTHERS = 6
LEAST_CELLS = 400
RING_DEG = (10.0, 30.0)
"""Angles from the ball's axis in which a single photograph is compared with its own rim…"""
SUPPORT_DEG = 60.0
"""…but for this angle to either side of down."""
RING_AZIMUTHS = 72
LEAST_RING_CONTRAST = 0.05
"""Root mean square of the logarithms beside the ball around the ring, below which nothing can be compared."""


@dataclass(frozen=True)
class PosedBall:
    """A photograph's logarithms of light, its lens, and where its ball and camera are."""

    light: Float32[np.ndarray, "H W"]
    lens: Lens
    cone: BallCone
    rotation: Float[np.ndarray, "3 3"]
    """World to camera."""

    def at(self, rays: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P"]:
        """Light along rays in the camera's frame; NaN beyond the picture."""
        cv2 = opencv()
        pixels = np.atleast_3d(self.lens.project(rays).astype(np.float32) - 0.5)
        pixels = pixels if rays.ndim == 3 else pixels.reshape(1, -1, 2)
        found: np.ndarray = cv2.remap(
            self.light, pixels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan")
        )
        return found.reshape(rays.shape[:-1])


def log_light(codes: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    """Logarithms of a picture's luminance, about."""
    return LOG_LIGHT[opencv().cvtColor(codes, opencv().COLOR_RGB2GRAY)]


def agreement(balls: Sequence[PosedBall]) -> tuple[float, float]:
    """Median correlation of direct and mirrored views, and the W (radii) at which it is largest; NaN where none shows.

    A single photograph is compared with its own rim.
    """
    if len(balls) == 1:
        return ring_agreement(balls[0]), np.inf
    chosen = balls[:: -(-len(balls) // VIEWS)]
    best = (float("nan"), np.inf)
    for distance in DISTANCES:
        found = [each for ball in chosen if (each := _of_view(ball, balls, distance)) is not None]
        if found and not float(np.median(found)) <= best[0]:
            best = float(np.median(found)), distance
    return best


def _of_view(ball: PosedBall, balls: Sequence[PosedBall], distance: float) -> float | None:
    height = round(COLUMNS * ball.lens.height / ball.lens.width)
    step = ball.lens.width / COLUMNS
    right, down = np.meshgrid((np.arange(COLUMNS) + 0.5) * step, (np.arange(height) + 0.5) * ball.lens.height / height)
    rays = ball.lens.rays(np.stack([right, down], -1))
    direct = ball.at(rays)
    middle = rays @ ball.cone.center
    reach = middle + np.sqrt(np.maximum(middle**2 - ball.cone.distance**2 + distance**2, 0))
    points = reach[..., None] * rays - ball.cone.center
    toward = points / np.linalg.norm(points, axis=-1, keepdims=True) @ ball.rotation
    others = [each for each in balls if each is not ball]
    values, weights = [], []
    for other in others[:: -(-len(others) // OTHERS)]:
        directions = toward @ other.rotation.T
        normals = other.cone.toward(directions).normals
        leaving = distance * directions - normals
        seen = other.cone.toward(leaving / np.linalg.norm(leaving, axis=-1, keepdims=True))
        good = seen.met & (seen.directions @ -other.cone.axis < np.cos(np.radians(PHOTOGRAPHER_DEG)))
        values.append(other.at(seen.rays))
        weights.append(np.where(good, spans(other.cone, seen, other.lens), np.inf))
    sharpest = np.argsort(np.stack(weights), 0)[:3]
    mirrored = np.median(np.take_along_axis(np.stack(values), sharpest, 0), 0)
    shown = beside(ball, rays) & np.isfinite(direct) & np.isfinite(mirrored)
    return None if shown.sum() < LEAST_CELLS else _correlation(direct, mirrored, shown)


def beside(ball: PosedBall, rays: Float[np.ndarray, "*P 3"]) -> Bool[np.ndarray, "*P"]:
    """Whether rays of the camera pass the ball, and what it stands on."""
    center, radius = ball.lens.project(ball.cone.axis), ball.lens.fx * np.tan(ball.cone.half_angle)
    right, down = np.moveaxis(ball.lens.project(rays) - center, -1, 0)
    below = (np.abs(right) < SUPPORT_WIDTH * radius) & (down > SUPPORT_FROM * radius)
    past = np.arccos(np.clip(rays @ ball.cone.axis, -1, 1)) >= CLEARANCE * ball.cone.half_angle
    return np.asarray(past & ~below)


def _correlation(one: np.ndarray, two: np.ndarray, shown: np.ndarray) -> float:
    """Of both, band-passed where they are shown."""
    cv2, weight = opencv(), shown.astype(np.float32)

    def band(values: np.ndarray) -> np.ndarray:
        plain = np.where(shown, values, 0).astype(np.float32)
        low, high = (
            cv2.GaussianBlur(plain, (0, 0), s) / np.maximum(cv2.GaussianBlur(weight, (0, 0), s), 1e-3) for s in BAND_PX
        )
        return np.asarray((low - high)[shown])

    x, y = (each - each.mean() for each in (band(one), band(two)))
    return float((x * y).sum() / max(float(np.sqrt((x**2).sum() * (y**2).sum())), 1e-12))


def ring_agreement(ball: PosedBall) -> float:
    """Correlation around the ball of what lies beside it and what it mirrors beside its rim: means over a ring of
    angles from its axis, without what one turn around it has once: light from above does that to a matte ball, too.
    """
    azimuth = (np.arange(RING_AZIMUTHS) + 0.5) * 2 * np.pi / RING_AZIMUTHS
    angle = np.radians(np.linspace(*RING_DEG, 24))[None, :, None]
    side = np.stack([np.cos(azimuth), np.sin(azimuth)], 1) @ ball.cone.across
    directions = np.cos(angle) * ball.cone.axis + np.sin(angle) * side[:, None]
    seen = ball.cone.toward(directions)
    direct, mirrored = ball.at(directions), ball.at(seen.rays)
    shown = seen.met & np.isfinite(direct) & np.isfinite(mirrored)
    count = shown.sum(1)
    kept = (count >= shown.shape[1] / 2) & (side[:, 1] < np.cos(np.radians(SUPPORT_DEG)))
    if kept.sum() < RING_AZIMUTHS / 3:
        return float("nan")
    basis = np.stack([np.ones(RING_AZIMUTHS), np.cos(azimuth), np.sin(azimuth)], 1)[kept]
    left = []
    for values in (direct, mirrored):
        mean = (np.where(shown, values, 0).sum(1) / np.maximum(count, 1))[kept]
        left.append(mean - basis @ np.linalg.lstsq(basis, mean, rcond=None)[0])
    if float(np.sqrt((left[0] ** 2).mean())) < LEAST_RING_CONTRAST:
        return float("nan")
    return float((left[0] * left[1]).sum() / max(float(np.linalg.norm(left[0]) * np.linalg.norm(left[1])), 1e-12))


def refraction_agreement(ball: PosedBall, index: float = 1.5) -> float:
    """Correlation of what lies behind a ball of glass, bent by its two surfaces, with what the ball shows: high only
    where the ball is no mirror.
    """
    radius = ball.lens.fx * np.tan(ball.cone.half_angle)
    center = ball.lens.project(ball.cone.axis)
    across = np.linspace(-0.75, 0.75, 96)
    right, down = np.meshgrid(center[0] + across * radius, center[1] + across * radius)
    seen = ball.cone.along(ball.lens.rays(np.stack([right, down], -1)))
    bent = (
        seen.rays / index
        + (seen.cosines / index - np.sqrt(1 - (1 - seen.cosines**2) / index**2))[..., None] * seen.normals
    )
    # Leaving: the same angles on the other side, so that the ray turns twice by θ − θ′ in its plane of incidence.
    out = 2 * (bent * seen.rays).sum(-1, keepdims=True) * bent - seen.rays
    direct, shown = ball.at(out), ball.at(seen.rays)
    good = np.isfinite(direct) & seen.met & (np.hypot(right - center[0], down - center[1]) < 0.75 * radius)
    outside = np.arccos(np.clip(out @ ball.cone.axis, -1, 1)) > 1.05 * ball.cone.half_angle
    good &= outside
    return float("nan") if good.sum() < LEAST_CELLS else _correlation(direct, shown, good)
