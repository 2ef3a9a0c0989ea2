"""The lat-long map that explains a set of rays best: robust linear least squares on arrays, gaps filled smoothly."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from shinypartial.core.sphere import (
    directions_to_latlong,
    latlong_directions,
    latlong_laplacian,
    latlong_solid_angles,
    sample_latlong,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

#: Residuals of about this size lose their vote, round by round; None: plain least squares.
ROBUST_SCALES = (None, 0.3, 0.15, 0.08, 0.05, 0.03, 0.02)
#: Weight of the squared gradient of the map against one ray: decides only where there are hardly any rays.
SMOOTHNESS = 0.01
CONJUGATE_GRADIENT_STEPS = 100
#: Relative residual at which conjugate gradients stop: below the half-float rounding of radiance (5e-4).
TOLERANCE = 1e-4
#: From here on the clipped map says only that radiance is at least 1, and the mean of what was seen says how much.
SATURATED = 0.99

Latlong = Float[np.ndarray, "H W 3"]
Evidence = Float[np.ndarray, "H W"]


@dataclass(frozen=True)
class Rays:
    """Observations: unit world directions, unbounded linear radiance, and the solid angle (sr) that a pixel sees."""

    directions: Float[np.ndarray, "P 3"]
    radiance: Float[np.ndarray, "P 3"]
    footprint_sr: Float[np.ndarray, "P"]


@dataclass(frozen=True)
class SolvedMap:
    """Two estimates of the environment, and the summed weight of the rays at each texel of the robust one.

    `averaged` is the weighted mean of the rays near each texel; `robust` is the re-weighted least-squares map.
    """

    averaged: Latlong
    robust: Latlong
    evidence: Evidence


@dataclass(frozen=True)
class _Cells:
    """Rays sorted by the cell of four texels that they lie in, so that sums over a cell are sums over a slice."""

    height: int
    starts: Int[np.ndarray, "C"]
    ray_cell: Int[np.ndarray, "P"]
    corners: Int[np.ndarray, "C 4"]
    shares: Float[np.ndarray, "4 P"]
    radiance: Float[np.ndarray, "3 P"]
    footprint_weight: Float[np.ndarray, "P"]

    def sum_of(self, values: Float[np.ndarray, "P"]) -> Float[np.ndarray, "C"]:
        """Sum of a value of each ray over the cells."""
        return np.add.reduceat(values, self.starts)

    def to_texels(self, values: Float[np.ndarray, "C 4"]) -> Float[np.ndarray, "T"]:
        """Sum over cells of what they give to their corners."""
        return np.bincount(self.corners.ravel(), values.ravel(), minlength=2 * self.height**2)


def solve_latlong(rays: Rays, height: int, after_round: Callable[[], None] = lambda: None) -> SolvedMap:
    """Robust least squares: min over E of Σ w ‖E(ω) − clip(c)‖² + λ ‖∇E‖², with E(ω) bilinear and c clipped to [0, 1].

    The weight w is f · (1 + ‖e‖²/s²)⁻² (Geman–McClure, residual e, falling scales s), so that rays that see something
    else than the environment lose their vote; f = 1/(1 + footprint/texel) lets a pixel that spans many texels say
    less about each of them. Normal equations are assembled once a round and solved by conjugate gradients; texels
    that no ray determines are filled by `fill_gaps`. Where the clipped map saturates, the result is the weighted mean
    of the unclipped radiance. Raises ValueError when there is no ray.
    """
    if not len(rays.directions):
        raise ValueError("expected at least one ray")
    cells, laplacian = _sort_into_cells(rays, height), SMOOTHNESS * latlong_laplacian(height)
    clipped = [np.clip(channel, 0, 1) for channel in cells.radiance]
    solution: Float[np.ndarray, "T 3"] | None = None
    averaged: Float[np.ndarray, "T 3"] | None = None
    for scale in ROBUST_SCALES:
        weights = cells.footprint_weight
        if scale is not None and solution is not None:
            weights = weights * (1 + _squared_residuals(cells, solution, clipped) / np.float32(scale**2)) ** -2
        evidence, right_side = _splat(cells, weights, clipped)
        mean = right_side / np.maximum(evidence, 1e-9)[:, None]
        averaged = _fill(mean, evidence, height) if averaged is None else averaged
        start = _fill(mean if solution is None else solution, evidence, height)
        solution = _conjugate_gradients(_normal_matrix(cells, weights) + laplacian, right_side, start)
        after_round()
    assert solution is not None
    assert averaged is not None
    evidence, summed = _splat(cells, weights, list(cells.radiance))
    unclipped = summed / np.maximum(evidence, 1e-9)[:, None]
    robust = np.where((solution > SATURATED) & (unclipped > 1), unclipped, np.clip(solution, 0, 1))
    shape = (height, 2 * height)
    maps = [texels.reshape(*shape, 3).astype(np.float32) for texels in (averaged, robust)]
    return SolvedMap(maps[0], maps[1], evidence.reshape(shape).astype(np.float32))


def _sort_into_cells(rays: Rays, height: int) -> _Cells:
    """Cells lie between the centers of four texels; they wrap in azimuth, and clamp to the first and last row."""
    width = 2 * height
    uv = directions_to_latlong(rays.directions)
    x, y = uv[:, 0] * width - 0.5, np.clip(uv[:, 1] * height - 0.5, 0, height - 1)
    column = np.floor(x).astype(np.int32)
    row = np.minimum(np.floor(y).astype(np.int32), height - 2)
    across, down = (x - column).astype(np.float32), (y - row).astype(np.float32)
    cell = row * width + column % width
    order = np.argsort(cell, kind="stable")
    present, starts, counts = np.unique(cell[order], return_index=True, return_counts=True)
    across, down = across[order], down[order]
    left, right = present, present - present % width + (present + 1) % width
    texel_sr = (math.pi / height) ** 2
    return _Cells(
        height=height,
        starts=starts,
        ray_cell=np.repeat(np.arange(len(present)), counts),
        corners=np.stack([left, right, left + width, right + width], 1),
        shares=np.stack([(1 - across) * (1 - down), across * (1 - down), (1 - across) * down, across * down]),
        radiance=np.ascontiguousarray(rays.radiance[order].T),
        footprint_weight=(1 / (1 + rays.footprint_sr[order] / texel_sr)).astype(np.float32),
    )


def _squared_residuals(
    cells: _Cells, solution: Float[np.ndarray, "T 3"], observed: Sequence[Float[np.ndarray, "P"]]
) -> Float[np.ndarray, "P"]:
    squared = np.zeros(len(cells.ray_cell), np.float32)
    for channel, values in enumerate(observed):
        corners = solution[:, channel].astype(np.float32)[cells.corners]
        predicted = np.zeros_like(squared)
        for corner, share in enumerate(cells.shares):
            predicted += corners[:, corner][cells.ray_cell] * share
        squared += (predicted - values) ** 2
    return squared


def _splat(
    cells: _Cells, weights: Float[np.ndarray, "P"], observed: Sequence[Float[np.ndarray, "P"]]
) -> tuple[Float[np.ndarray, "T"], Float[np.ndarray, "T 3"]]:
    """Bᵀw and Bᵀ(w c): summed weight and summed weighted radiance of every texel."""
    shares = [share * weights for share in cells.shares]
    evidence = cells.to_texels(np.stack([cells.sum_of(share) for share in shares], 1))
    sums = [cells.to_texels(np.stack([cells.sum_of(share * values) for share in shares], 1)) for values in observed]
    return evidence, np.stack(sums, 1)


def _normal_matrix(cells: _Cells, weights: Float[np.ndarray, "P"]) -> "csr_matrix":
    """BᵀWB: a cell couples its four corners by a symmetric block of 4 × 4."""
    from scipy.sparse import coo_matrix

    blocks = np.zeros((len(cells.starts), 4, 4), np.float32)
    for i in range(4):
        weighted = cells.shares[i] * weights
        for j in range(i, 4):
            blocks[:, i, j] = blocks[:, j, i] = cells.sum_of(weighted * cells.shares[j])
    rows, columns = np.repeat(cells.corners, 4, 1), np.tile(cells.corners, (1, 4))
    texels = 2 * cells.height**2
    return coo_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(texels, texels)).tocsr()


def _conjugate_gradients(
    matrix: "csr_matrix", right_side: Float[np.ndarray, "T 3"], start: Float[np.ndarray, "T 3"]
) -> Float[np.ndarray, "T 3"]:
    """Solve for the three channels at once, scaled by the diagonal."""
    scale = 1 / matrix.diagonal()[:, None]
    solution = start.astype(np.float64)
    residual = right_side - matrix @ solution
    direction = scaled = scale * residual
    energy = (residual * scaled).sum(0)
    goal = TOLERANCE**2 * np.maximum((right_side * scale * right_side).sum(0), 1e-30)
    for _ in range(CONJUGATE_GRADIENT_STEPS):
        if (energy <= goal).all():
            break
        product = matrix @ direction
        step = energy / np.maximum((direction * product).sum(0), 1e-30)
        solution = solution + step * direction
        residual = residual - step * product
        scaled = scale * residual
        new_energy = (residual * scaled).sum(0)
        direction = scaled + new_energy / np.maximum(energy, 1e-30) * direction
        energy = new_energy
    return solution


def _fill(texels: Float[np.ndarray, "T 3"], evidence: Float[np.ndarray, "T"], height: int) -> Float[np.ndarray, "T 3"]:
    shape = (height, 2 * height)
    return fill_gaps(texels.reshape(*shape, 3), evidence.reshape(shape)).reshape(-1, 3)


def fill_gaps(values: Float[np.ndarray, "H W C"], evidence: Evidence) -> Float[np.ndarray, "H W C"]:
    """Push–pull (Gortler et al. 1996): average what is known to coarser maps, interpolate it back into the gaps.

    A texel with evidence of at least one keeps its value; below that it is blended with the coarser level. Averages
    are weighted by solid angle. A height that can't be halved ends the pyramid with the mean of that level.
    """
    known = np.clip(evidence, 0, 1)[..., None]
    height = values.shape[0]
    if height % 2:
        weights = known * latlong_solid_angles(height)[..., None]
        coarse = (values * weights).sum((0, 1)) / max(float(weights.sum()), 1e-30)
        return values * known + coarse * (1 - known)
    area = latlong_solid_angles(height)[..., None]
    weight, mass = _sum_of_four(known * area), _sum_of_four(values * known * area)
    # A coarse texel is known as well as the best known of its four: what is seen is not diluted by its gaps.
    confidence = known.reshape(height // 2, 2, height, 2).max((1, 3))
    coarse = fill_gaps(mass / np.maximum(weight, 1e-30), confidence)
    return values * known + sample_latlong(coarse, latlong_directions(height)) * (1 - known)


def _sum_of_four(values: Float[np.ndarray, "H W C"]) -> Float[np.ndarray, "h w C"]:
    height, width, channels = values.shape
    return values.reshape(height // 2, 2, width // 2, 2, channels).sum((1, 3))
