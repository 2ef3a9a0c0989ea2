"""Three balls lit by a map, as papers on lighting estimation compare maps, and the direction of the brightest light.

A mirror, a glossy and a diffuse ball are seen from far away along one direction. Radiance is linear and not clipped.
The glossy one weights light by D(h) (n·ω)₊, with h between ω and the view and D the distribution of Trowbridge and
Reitz, the diffuse one by (n·ω)₊. Weights sum to one, so that a white world gives white balls.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.camera import reflect
from shinypartial.core.sphere import blur_latlong, latlong_directions, latlong_solid_angles, sample_latlong, tangents
from shinypartial.metrics.angular import angular_error_deg
from shinypartial.metrics.environment import Latlong, to_protocol_size

BALL_PX = 32
"""Diameter of the pictures of balls."""
LIGHT_HEIGHT = 64
"""Rows of the maps that light glossy and diffuse balls."""
ROUGHNESS = 0.5
"""Of the glossy ball; α is its square."""
PERCENTILES = (0.1, 99.9)
"""What the normalized error maps to 0 and 1."""
PEAK_BLUR_DEG = 2.0
"""Standard deviation of the blur under which the brightest direction is looked for."""


@dataclass(frozen=True)
class BallErrors:
    """Of one ball, over its pixels."""

    si_rmse: float
    """√mean (αp − t)² with the factor α = Σ p t/Σ p²."""
    color_error_deg: float
    """Mean angle between the colors p and t."""
    normalized_rmse: float
    """RMSE of both after each was mapped from its percentiles 0.1 and 99.9 to [0, 1]."""


@dataclass(frozen=True)
class BallScores:
    """Of three balls, and of the brightest light."""

    mirror: BallErrors
    glossy: BallErrors
    diffuse: BallErrors
    peak_error_deg: float
    """Angle between the brightest directions of prediction and truth, after a small blur."""


def ball_scores(prediction: Latlong, truth: Latlong, view: Float[np.ndarray, "3"]) -> BallScores:
    """Compare two maps of linear radiance by balls that are seen against the direction `view`, from camera to ball."""
    lit = [balls(radiance, view) for radiance in (prediction, truth)]
    mirror, glossy, diffuse = (_errors(*pair) for pair in zip(*lit, strict=True))
    peaks = [_peak(radiance) for radiance in (prediction, truth)]
    return BallScores(mirror, glossy, diffuse, float(angular_error_deg(*peaks)))


def balls(radiance: Latlong, view: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "P 3"], ...]:
    """Linear radiance of the pixels of a mirror, a glossy and a diffuse ball."""
    view = view / np.linalg.norm(view)
    normals, light = ball_normals(view), to_protocol_size(radiance, LIGHT_HEIGHT).reshape(-1, 3).astype(np.float64)
    directions, area = latlong_directions(LIGHT_HEIGHT).reshape(-1, 3), latlong_solid_angles(LIGHT_HEIGHT).ravel()
    mirrored = reflect(np.broadcast_to(view, normals.shape), normals)
    half = directions - view
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
    facing, alpha = np.maximum(normals @ directions.T, 0), ROUGHNESS**2
    facets = 1 / ((np.maximum(normals @ half.T, 0) ** 2) * (alpha**2 - 1) + 1) ** 2

    def mean(weights: Float[np.ndarray, "P N"]) -> Float[np.ndarray, "P 3"]:
        weights = weights * area
        found: np.ndarray = weights @ light / weights.sum(1, keepdims=True)
        return found

    return sample_latlong(to_protocol_size(radiance), mirrored), mean(facets * facing), mean(facing)


def ball_normals(view: Float[np.ndarray, "3"]) -> Float[np.ndarray, "P 3"]:
    """Unit normals of the pixels of a ball that is seen along a unit direction."""
    line = (np.arange(BALL_PX) + 0.5) / BALL_PX * 2 - 1
    right, up = np.meshgrid(line, line)
    inside: Bool[np.ndarray, "S S"] = right**2 + up**2 < 1
    right, up = right[inside, None], up[inside, None]
    first, second = tangents(view)
    normals: np.ndarray = right * first + up * second - np.sqrt(1 - right**2 - up**2) * view
    return normals


def _errors(prediction: Float[np.ndarray, "P 3"], truth: Float[np.ndarray, "P 3"]) -> BallErrors:
    scale = float((prediction * truth).sum()) / max(float((prediction**2).sum()), 1e-12)
    normalized = [_normalized(each) for each in (prediction, truth)]
    return BallErrors(
        si_rmse=_rms(scale * prediction - truth),
        color_error_deg=float(angular_error_deg(prediction, truth).mean()),
        normalized_rmse=_rms(normalized[0] - normalized[1]),
    )


def _normalized(radiance: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    low, high = np.percentile(radiance, PERCENTILES)
    return np.clip((radiance - low) / max(high - low, 1e-12), 0, 1)


def _rms(difference: Float[np.ndarray, "P 3"]) -> float:
    return float(np.sqrt((difference**2).mean()))


def _peak(radiance: Latlong) -> Float[np.ndarray, "3"]:
    brightness = blur_latlong(to_protocol_size(radiance).astype(np.float64), np.radians(PEAK_BLUR_DEG)).sum(-1)
    found: np.ndarray = latlong_directions(len(brightness))[np.unravel_index(brightness.argmax(), brightness.shape)]
    return found
