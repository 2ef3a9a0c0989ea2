"""How near the surroundings are, by what is mirrored: Gauss–Newton on 1/D with the map eliminated.

Two points of the object that look in one direction see the same of a far world, and shifted parts of a near one. With
the rows B of `Surroundings.rows` and the residuals e under the map that explains the rays best, each texel takes the
mean of what its rays require, and only the rest moves the walls: k ← k − (Bᵀ W (1 − Π) B)⁻¹ Bᵀ W (1 − Π) e.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float

from panoless.environment.mirrored import radiance_of, slopes_of
from panoless.environment.rays import Rays
from panoless.environment.solve import solve_environment
from panoless.environment.surroundings import FAR, Floor, Surroundings
from panoless.environment.variable_projection import VariableProjection
from panoless.numeric.gauss_newton import damped_step
from panoless.numeric.robust import bounded_error, robust_weight

ROBUST_SCALE = 0.15
"""Residual (linear radiance) beyond which a ray loses its vote."""
RESOLUTIONS = (8, 8, 16, 16, 16, 32, 32, 32, 64, 64, 64)
"""Texels along a face side of the maps of all steps."""
STRETCH = 1.7
"""Factor of a step: it lets each texel follow by the mean of its rays, as a map does not quite."""
LEAST_SHARE = 1e-3
"""Share of the mean diagonal that is added to the diagonal, for walls that no ray determines."""
FLOOR_DEPTHS = (0.45, 0.55, 0.65, 0.8, 1.0)
"""Of what the object may stand on below its center, in radii of the object: those that are tried first."""
FLOOR_REACHES = (2.5, 4.0, 8.0)
"""How far that may reach, in radii of the object."""
FLOOR_RESOLUTION = 16
"""Texels along a face side of the maps that determine which of these explains most."""


@dataclass(frozen=True)
class LeavingRays:
    """Where rays leave the object, in the normalized frame, in which unit directions, and what was seen along them."""

    points: Float[np.ndarray, "P 3"]
    directions: Float[np.ndarray, "P 3"]
    radiance: Float[np.ndarray, "P 3"]

    def rays(self, surroundings: Surroundings) -> Rays:
        """As rays into the map of those surroundings."""
        looked_up = surroundings.looked_up(self.points, self.directions)
        return Rays(torch.from_numpy(looked_up).float(), torch.from_numpy(self.radiance).float())


@dataclass(frozen=True)
class Linearized:
    """The cost of rays in some surroundings, Σ w ‖(1 − Π) e‖²/2, its gradient and matrix over the unknowns."""

    cost: float
    gradient: Float[np.ndarray, "D"]
    matrix: Float[np.ndarray, "D D"]

    @classmethod
    def at(
        cls,
        seen: LeavingRays,
        surroundings: Surroundings,
        resolution: int,
        free: Bool[np.ndarray, "D"] | slice = slice(None),
    ) -> "Linearized":
        """With the map solved there; over those of the unknowns that are free."""
        rays = seen.rays(surroundings)
        directions, environment = rays.directions.numpy().astype(np.float64), solve_environment([rays], resolution)
        residual = radiance_of(environment, directions) - seen.radiance
        rows = surroundings.rows(slopes_of(environment, directions), seen.points, seen.directions)[..., free]
        projection = VariableProjection.of(directions, robust_weight(residual, ROBUST_SCALE), resolution)
        gradient, matrix = projection.equations(rows, residual)
        return cls(_cost(residual), gradient, matrix)

    def step(self) -> Float[np.ndarray, "D"]:
        """−(H + λ)⁻¹ g, λ a small share of the mean diagonal; none where no ray determines anything."""
        return damped_step(self.gradient, self.matrix, LEAST_SHARE)

    def pull(self) -> float:
        """The share of the cost that a step promises: ½ gᵀ(H + λ)⁻¹g over it."""
        return float(-self.gradient @ self.step()) / 2 / max(self.cost, 1e-30)


def upward(rights: Float[np.ndarray, "V 3"], ups: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "3"]:
    """Where up is, by cameras that are held level: the direction across all of their right axes, on the side of
    their own ups.
    """
    up = np.linalg.eigh(rights.T @ rights)[1][:, 0]
    return up if (ups @ up).sum() > 0 else -up


def with_floor(
    seen: LeavingRays, up: Float[np.ndarray, "3"], depths: Sequence[float] = FLOOR_DEPTHS
) -> tuple[Surroundings, float]:
    """A level disk below the object in a far world: of a grid of depths and reaches, what explains the rays best; and
    the share of the cost in a far world that it leaves.
    """

    def cost(surroundings: Surroundings) -> float:
        rays = seen.rays(surroundings)
        environment = solve_environment([rays], FLOOR_RESOLUTION)
        return _cost(radiance_of(environment, rays.directions.numpy().astype(np.float64)) - seen.radiance)

    grid = product(depths, FLOOR_REACHES)
    tried = [Surroundings(np.zeros(1), Floor(up, depth, reach)) for depth, reach in grid]
    costs = [cost(each) for each in tried]
    best = int(np.argmin(costs))
    return tried[best], costs[best] / max(cost(FAR), 1e-30)


def found_surroundings(
    seen: LeavingRays, start: Surroundings, resolutions: Sequence[int] = RESOLUTIONS, *, known_floor: bool = False
) -> Surroundings:
    """After a step under a map of each of the resolutions. A floor stays level, as wrong normals would tilt it, and one
    that is known stays where it is.
    """
    for resolution in resolutions:
        free = np.ones(start.num_unknowns, bool)
        if start.floor is not None:
            free[len(start.coefficients) : None if known_floor else -1] = False
        change = np.zeros(start.num_unknowns)
        change[free] = Linearized.at(seen, start, resolution, free).step()
        start = start.after(STRETCH * change)
    return start


def _cost(residual: Float[np.ndarray, "P C"]) -> float:
    return ROBUST_SCALE**2 * float(bounded_error(residual, ROBUST_SCALE).sum()) / 2
