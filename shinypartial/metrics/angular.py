"""Angles between directions, in degrees, and their statistics."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

#: Pixels of the mask for which a method gives no normal count with this error.
HOLE_ERROR_DEG = 90.0


@dataclass(frozen=True)
class AngularStatistics:
    """Statistics of angular errors, pooled over all pixels of all views (not averaged over images)."""

    mean_angular_error_deg: float
    median_angular_error_deg: float
    rmse_angular_error_deg: float
    fraction_within_5deg: float
    fraction_within_11_25deg: float
    fraction_within_22_5deg: float
    normal_coverage: float


def angular_error_deg(a: Float[np.ndarray, "... 3"], b: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
    """Angle atan2(‖a × b‖, a·b) in degrees, [0, 180]; lengths do not matter, and small angles keep their precision."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(cross, np.sum(a * b, -1))))


def normal_errors_deg(
    predicted_normals: Float[np.ndarray, "P 3"], true_normals: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "P"]:
    """Angular errors of normals; where the prediction has none (length below ½) the error is NaN."""
    errors = angular_error_deg(predicted_normals, true_normals)
    return np.where(np.linalg.norm(predicted_normals, axis=-1) < 0.5, np.nan, errors).astype(np.float32)


def angular_statistics(errors_deg: Float[np.ndarray, "P"]) -> AngularStatistics:
    """Pooled statistics; NaN marks a hole, which counts with HOLE_ERROR_DEG. Raises ValueError for no pixels."""
    if errors_deg.size == 0:
        raise ValueError("expected at least one pixel")
    holes = np.isnan(errors_deg)
    errors = np.where(holes, np.float32(HOLE_ERROR_DEG), errors_deg)
    return AngularStatistics(
        mean_angular_error_deg=float(errors.mean(dtype=np.float64)),
        median_angular_error_deg=float(np.median(errors)),
        rmse_angular_error_deg=float(np.sqrt(np.square(errors).mean(dtype=np.float64))),
        fraction_within_5deg=float((errors <= 5.0).mean()),
        fraction_within_11_25deg=float((errors <= 11.25).mean()),
        fraction_within_22_5deg=float((errors <= 22.5).mean()),
        normal_coverage=float(1.0 - holes.mean()),
    )
