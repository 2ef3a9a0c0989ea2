"""Where rays meet a height over a plane, in numpy with scipy's B-splines."""

import numpy as np
from jaxtyping import Float

from panoless.kernels.constants import MAX_NEWTON_STEPS, NEWTON_CONVERGED


def first_hits(
    origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], coefficients: Float[np.ndarray, "M N"]
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P 2"]]:
    """See `panoless.kernels.height_field`: Newton's steps t ← t − (z(t) − h)/(d_z − ∇h·d) from z = 0."""
    from scipy.interpolate import NdBSpline

    shape = np.array(coefficients.shape)
    spline = NdBSpline(tuple(np.arange(-3.0, count + 1) for count in shape), coefficients, 3)
    distance, slopes = np.full(len(origins), np.inf), np.zeros((len(origins), 2))
    ray = np.flatnonzero((origins[:, 2] > 0) & (directions[:, 2] < 0))
    t = -origins[ray, 2] / directions[ray, 2]
    for _ in range(MAX_NEWTON_STEPS):
        point, direction = origins[ray] + t[:, None] * directions[ray], directions[ray]
        nearest = point[:, :2].clip(0, shape - 3)
        slope = np.stack([spline(nearest, nu=order) for order in ((1, 0), (0, 1))], 1)
        gap = point[:, 2] - spline(nearest) - (slope * (point[:, :2] - nearest)).sum(1)
        rate = direction[:, 2] - (slope * direction[:, :2]).sum(1)
        met = (rate < 0) & (np.abs(gap) < NEWTON_CONVERGED) & (t > 0)
        distance[ray[met]], slopes[ray[met]] = t[met], slope[met]
        going = (rate < 0) & (np.abs(gap) >= NEWTON_CONVERGED)
        ray, t = ray[going], (t - gap / np.where(rate < 0, rate, -1.0))[going]
    return distance, slopes
