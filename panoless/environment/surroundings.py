"""How far away the surroundings are: where in the map a ray looks that leaves the object beside its center.

The map holds the light that arrives at the origin of the normalized frame, the object's center. A point x that mirrors
into the direction ω sees a wall in another direction ω′ than the origin does. With D the distance of the wall from the
origin, κ = 1/D and x⊥ = x − (x·ω) ω,

ω′ = κ x⊥ + √(1 − κ²‖x⊥‖²) ω,

which is exact for a sphere about the origin, and of unit length. Walls at other distances have κ(ω′) = Σ k_i Y_i(ω′),
so ω′ is a fixed point. To first order ω′ changes with k_i by Y_i x⊥, which is linear, and the map stays linear.
"""

from dataclasses import dataclass, field
from math import isqrt

import numpy as np
from jaxtyping import Float

from shinypartial.core.harmonics import real_harmonics

SHARPEST = 0.6
"""Upper bound of 1/D, in inverse radii of the object: nearer walls would touch it. Not tuned."""
ROUNDS = 4
"""Of the fixed point; its error falls by ‖x⊥‖ ‖∇κ‖ in each. Not tuned."""

ORDER = (0, 3, 1, 2, 4, 5, 7, 8, 6)
"""Where `real_harmonics` has each of them; stored coefficients are in this order."""


@dataclass(frozen=True)
class Surroundings:
    """1/D = Σ k_i Y_i(ω) about the origin of the normalized frame, in inverse radii of the object, within [0, 0.6].

    Y_i are the real spherical harmonics of the first degrees, with a mean square of one over the sphere: no number for
    a world that is infinitely far, one for a sphere, four for one about another point, nine for the walls of a room.
    """

    coefficients: Float[np.ndarray, "K"] = field(default_factory=lambda: np.zeros(0))

    @property
    def is_far(self) -> bool:
        """Whether a direction is all that matters."""
        return not self.coefficients.any()

    @property
    def kind(self) -> str:
        """The rung of the ladder."""
        return {0: "far", 1: "sphere"}.get(len(self.coefficients), f"harmonics of degree {self.degree}")

    @property
    def degree(self) -> int:
        """Of the highest harmonics; −1 for a far world."""
        return round(len(self.coefficients) ** 0.5) - 1

    def with_degree(self, degree: int) -> "Surroundings":
        """The same with harmonics up to a degree; those that it had not are zero."""
        count = (degree + 1) ** 2
        return Surroundings(np.pad(self.coefficients, (0, max(count - len(self.coefficients), 0)))[:count])

    def after(self, step: Float[np.ndarray, "K"]) -> "Surroundings":
        """With changed coefficients."""
        return Surroundings(self.coefficients + step)

    def inverse_distance(self, directions: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P"]:
        """1/D of unit directions from the origin, in inverse radii of the object."""
        if self.is_far:
            return np.zeros(directions.shape[:-1])
        count = len(self.coefficients)
        return np.clip(harmonics(directions, count) @ self.coefficients, 0.0, SHARPEST)

    def inverse_distance_from(
        self, point: Float[np.ndarray, "3"], directions: Float[np.ndarray, "*P 3"]
    ) -> Float[np.ndarray, "*P"]:
        """1/t of the walls at x + t ω, seen from a point of the unit ball: κ/(√(1 − κ²‖x⊥‖²) − κ x·ω)."""
        points = np.broadcast_to(point, directions.shape)
        inverse, square = (
            self.inverse_distance(self.looked_up(points, directions)),
            (across_rays(points, directions) ** 2),
        )
        along = np.sqrt(np.maximum(1 - inverse**2 * square.sum(-1), 0.0)) - inverse * (points * directions).sum(-1)
        return inverse / np.maximum(along, SHARPEST)

    def looked_up(
        self, points: Float[np.ndarray, "*P 3"], directions: Float[np.ndarray, "*P 3"]
    ) -> Float[np.ndarray, "*P 3"]:
        """ω′ of rays that leave points of the unit ball in unit directions ω; these themselves in a far world."""
        if self.is_far:
            return directions
        across = across_rays(points, directions)
        square = (across**2).sum(-1)
        found = directions
        for _ in range(ROUNDS if len(self.coefficients) > 1 else 1):
            inverse = self.inverse_distance(found)
            along = np.sqrt(np.maximum(1 - inverse**2 * square, 0.0))
            found = inverse[..., None] * across + along[..., None] * directions
        return found

    def rows(
        self,
        slopes: Float[np.ndarray, "P C 3"],
        points: Float[np.ndarray, "P 3"],
        directions: Float[np.ndarray, "P 3"],
    ) -> Float[np.ndarray, "P C K"]:
        """What light changes by with the coefficients: with slopes a by ω′, Y_i (a·x⊥ − κ ‖x⊥‖² (a·ω)/s)."""
        across, found = across_rays(points, directions), self.looked_up(points, directions)
        inverse, square = self.inverse_distance(found), (across**2).sum(-1)
        along = np.sqrt(np.maximum(1 - inverse**2 * square, 0.1))
        way = across - (inverse * square / along)[:, None] * directions
        rows: np.ndarray = np.matmul(slopes, way[..., None]) * harmonics(found, len(self.coefficients))[:, None]
        return rows

    def slopes_by_mirrored(
        self,
        slopes: Float[np.ndarray, "P C 3"],
        points: Float[np.ndarray, "P 3"],
        directions: Float[np.ndarray, "P 3"],
    ) -> Float[np.ndarray, "P C 3"]:
        """Slopes a of the light by ω′, made those by ω: with s = √(1 − κ²‖x⊥‖²), κ being what it is there,

        (s − κ x·ω) a + (κ² (x·ω)/s − κ) (a·ω) x.
        """
        if self.is_far:
            return slopes
        inverse = self.inverse_distance(self.looked_up(points, directions))
        height = (points * directions).sum(-1)
        along = np.sqrt(np.maximum(1 - inverse**2 * (across_rays(points, directions) ** 2).sum(-1), 0.1))
        across = (inverse**2 * height / along - inverse)[:, None] * np.matmul(slopes, directions[..., None])[..., 0]
        return (along - inverse * height)[:, None, None] * slopes + across[..., None] * points[:, None]


FAR = Surroundings()


def across_rays(points: Float[np.ndarray, "*P 3"], directions: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P 3"]:
    """x⊥ = x − (x·ω) ω: points less what lies along their unit directions."""
    return points - (points * directions).sum(-1)[..., None] * directions


def harmonics(directions: Float[np.ndarray, "*P 3"], count: int) -> Float[np.ndarray, "*P K"]:
    """The first 0, 1, 4 or 9 real spherical harmonics of unit directions, with a mean square of one, in the order of
    x, y and z: 1, x, y, z, xy, yz, zx, x² − y², 3z² − 1 but for their factors.
    """
    basis = real_harmonics(directions, isqrt(max(count - 1, 0)))[..., ORDER[:count]]
    basis *= np.sqrt(4 * np.pi)
    return basis
