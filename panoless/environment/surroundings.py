"""How far away the surroundings are: where in the map a ray looks that leaves the object beside its center.

The map holds the light that arrives at the origin of the normalized frame, the object's center. A point x that mirrors
into the direction ω sees a wall in another direction ω′ than the origin does. With D the distance of the wall from the
origin, κ = 1/D and x⊥ = x − (x·ω) ω,

ω′ = κ x⊥ + √(1 − κ²‖x⊥‖²) ω,

which is exact for a sphere about the origin, and of unit length. Walls at other distances have κ(ω′) = Σ k_i Y_i(ω′),
so ω′ is a fixed point. To first order ω′ changes with k_i by Y_i x⊥, which is linear, and the map stays linear.

Before them may lie what the object stands on, a disk with the upward unit normal u at the depth h below the origin. A
ray that comes down on it, (u·ω) < 0, meets it at q = x + t ω with t = −(h + u·x)/(u·ω), and looks to ω′ = q/‖q‖.
"""

from dataclasses import dataclass, field, replace
from math import isqrt

import numpy as np
from jaxtyping import Float

from shinypartial.core.harmonics import real_harmonics
from shinypartial.core.sphere import tangents

SHARPEST = 0.6
"""Upper bound of 1/D, in inverse radii of the object: nearer walls would touch it. Not tuned."""
LEAST_FALL = 1e-3
"""Sine of the angle at which a ray has to come down on the floor. Not tuned."""
LEAST_DEPTH = 0.05
"""Of a floor below the object's center, in radii of the object. Not tuned."""
FLOOR_UNKNOWNS = 3
ROUNDS = 4
"""Of the fixed point; its error falls by ‖x⊥‖ ‖∇κ‖ in each. Not tuned."""

ORDER = (0, 3, 1, 2, 4, 5, 7, 8, 6)
"""Where `real_harmonics` has each of them; stored coefficients are in this order."""


@dataclass(frozen=True)
class Floor:
    """What the object stands on: a disk about the foot of the origin, in the normalized frame."""

    up: Float[np.ndarray, "3"]
    """Its unit normal, on the object's side."""
    depth: float
    """Of its plane below the origin, u·q = −h, in radii of the object."""
    reach: float
    """Radius of the disk, in radii of the object."""

    @property
    def tilts(self) -> Float[np.ndarray, "2 3"]:
        """Two unit directions in the plane, across each other."""
        return np.stack(tangents(self.up))

    def after(self, step: Float[np.ndarray, "3"]) -> "Floor":
        """With the normal moved along both tilts and with another depth."""
        up = self.up + step[:2] @ self.tilts
        return Floor(up / np.linalg.norm(up), max(self.depth + float(step[2]), LEAST_DEPTH), self.reach)

    def scaled(self, factor: float) -> "Floor":
        """As many times as large."""
        return Floor(self.up, self.depth * factor, self.reach * factor)

    def distance(
        self, points: Float[np.ndarray, "*P 3"], directions: Float[np.ndarray, "*P 3"]
    ) -> Float[np.ndarray, "*P"]:
        """t of q = x + t ω, for points above the plane; infinite where rays do not meet the disk."""
        fall = -(directions @ self.up)
        falls = fall > LEAST_FALL
        found = np.where(falls, np.maximum(points @ self.up + self.depth, 0.0) / np.where(falls, fall, 1.0), np.inf)
        met = np.where(falls, found, 0.0)[..., None] * directions + points + self.depth * self.up
        return np.where((met**2).sum(-1) <= self.reach**2, found, np.inf)


@dataclass(frozen=True)
class Surroundings:
    """1/D = Σ k_i Y_i(ω) about the origin of the normalized frame, in inverse radii of the object, within [0, 0.6].

    Y_i are the real spherical harmonics of the first degrees, with a mean square of one over the sphere: no number for
    a world that is infinitely far, one for a sphere, four for one about another point, nine for the walls of a room.
    """

    coefficients: Float[np.ndarray, "K"] = field(default_factory=lambda: np.zeros(0))
    floor: Floor | None = None
    """Before the walls, where there is one."""

    @property
    def is_far(self) -> bool:
        """Whether a direction is all that matters."""
        return self.floor is None and not self.coefficients.any()

    @property
    def kind(self) -> str:
        """The rung of the ladder."""
        count = len(self.coefficients) if self.floor is None or self.coefficients.any() else 0
        walls = {0: "far", 1: "sphere"}.get(count, f"harmonics of degree {self.degree}")
        return walls if self.floor is None else f"floor and {walls}"

    @property
    def num_unknowns(self) -> int:
        """Of the coefficients, and three of the floor: its reach is none."""
        return len(self.coefficients) + (0 if self.floor is None else FLOOR_UNKNOWNS)

    @property
    def degree(self) -> int:
        """Of the highest harmonics; −1 for a far world."""
        return round(len(self.coefficients) ** 0.5) - 1

    def with_degree(self, degree: int) -> "Surroundings":
        """The same with harmonics up to a degree; those that it had not are zero."""
        count = (degree + 1) ** 2
        return replace(
            self, coefficients=np.pad(self.coefficients, (0, max(count - len(self.coefficients), 0)))[:count]
        )

    def after(self, step: Float[np.ndarray, "D"]) -> "Surroundings":
        """With changed coefficients, and then the floor."""
        count = len(self.coefficients)
        floor = None if self.floor is None else self.floor.after(step[count:])
        return Surroundings(self.coefficients + step[:count], floor)

    @property
    def without_walls(self) -> "Surroundings":
        """With the floor alone."""
        return replace(self, coefficients=np.zeros(0))

    def scaled(self, factor: float) -> "Surroundings":
        """As many times as large."""
        return Surroundings(self.coefficients / factor, None if self.floor is None else self.floor.scaled(factor))

    def inverse_distance(self, directions: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P"]:
        """1/D of the walls in unit directions from the origin, in inverse radii of the object."""
        if not self.coefficients.any():
            return np.zeros(directions.shape[:-1])
        count = len(self.coefficients)
        return np.clip(harmonics(directions, count) @ self.coefficients, 0.0, SHARPEST)

    def inverse_distance_from(
        self, point: Float[np.ndarray, "3"], directions: Float[np.ndarray, "*P 3"]
    ) -> Float[np.ndarray, "*P"]:
        """1/t of what is met at x + t ω from a point of the unit ball, of the walls κ/(√(1 − κ²‖x⊥‖²) − κ x·ω)."""
        points = np.broadcast_to(point, directions.shape)
        inverse, square = (
            self.inverse_distance(self._on_walls(points, directions)),
            (across_rays(points, directions) ** 2),
        )
        along = np.sqrt(np.maximum(1 - inverse**2 * square.sum(-1), 0.0)) - inverse * (points * directions).sum(-1)
        walls = inverse / np.maximum(along, 1 - SHARPEST)
        if self.floor is None:
            return walls
        return np.maximum(walls, 1 / np.maximum(self.floor.distance(points, directions), LEAST_DEPTH))

    def looked_up(
        self, points: Float[np.ndarray, "*P 3"], directions: Float[np.ndarray, "*P 3"]
    ) -> Float[np.ndarray, "*P 3"]:
        """ω′ of rays that leave points of the unit ball in unit directions ω; these themselves in a far world."""
        found = self._on_walls(points, directions)
        if self.floor is None:
            return found
        distance = self.floor.distance(points, directions)
        met = np.isfinite(distance)
        places = points + np.where(met, distance, 1.0)[..., None] * directions
        places /= np.linalg.norm(places, axis=-1, keepdims=True)
        return np.where(met[..., None], places, found)

    def _on_walls(
        self, points: Float[np.ndarray, "*P 3"], directions: Float[np.ndarray, "*P 3"]
    ) -> Float[np.ndarray, "*P 3"]:
        """The same as if there were no floor."""
        if not self.coefficients.any():
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
    ) -> Float[np.ndarray, "P C D"]:
        """What light changes by with the unknowns: with slopes a by ω′, Y_i (a·x⊥ − κ ‖x⊥‖² (a·ω)/s) of the walls, and
        −(a·ω)/((u·ω) ‖q‖) times e·q for tilts e of the floor, times 1 for its depth.
        """
        across, found = across_rays(points, directions), self._on_walls(points, directions)
        inverse, square = self.inverse_distance(found), (across**2).sum(-1)
        along = np.sqrt(np.maximum(1 - inverse**2 * square, 0.1))
        way = across - (inverse * square / along)[:, None] * directions
        basis = harmonics(found, len(self.coefficients))
        if self.floor is None:
            rows: np.ndarray = np.matmul(slopes, way[..., None]) * basis[:, None]
            return rows
        distance = self.floor.distance(points, directions)
        met = np.isfinite(distance)
        rows = np.zeros((*slopes.shape[:2], self.num_unknowns))
        rows[~met, :, : basis.shape[1]] = np.matmul(slopes[~met], way[~met, :, None]) * basis[~met, None]
        places = points[met] + distance[met, None] * directions[met]
        by_depth = -np.matmul(slopes[met], directions[met, :, None])
        by_depth /= ((directions[met] @ self.floor.up) * np.linalg.norm(places, axis=1))[:, None, None]
        moved = np.concatenate([places @ self.floor.tilts.T, np.ones((len(places), 1))], 1)
        rows[met, :, basis.shape[1] :] = by_depth * moved[:, None]
        return rows

    def slopes_by_mirrored(
        self,
        slopes: Float[np.ndarray, "P C 3"],
        points: Float[np.ndarray, "P 3"],
        directions: Float[np.ndarray, "P 3"],
    ) -> Float[np.ndarray, "P C 3"]:
        """Slopes a of the light by ω′, made those by ω: with s = √(1 − κ²‖x⊥‖²), κ being what it is there,

        (s − κ x·ω) a + (κ² (x·ω)/s − κ) (a·ω) x,

        and on the floor, with a across ω′, t/‖q‖ (a − (a·ω)/(u·ω) u).
        """
        if self.is_far:
            return slopes
        inverse = self.inverse_distance(self._on_walls(points, directions))
        height = (points * directions).sum(-1)
        along = np.sqrt(np.maximum(1 - inverse**2 * (across_rays(points, directions) ** 2).sum(-1), 0.1))
        by_way = np.matmul(slopes, directions[..., None])[..., 0]
        across = (inverse**2 * height / along - inverse)[:, None] * by_way
        found: np.ndarray = (along - inverse * height)[:, None, None] * slopes + across[..., None] * points[:, None]
        if self.floor is None:
            return found
        distance = self.floor.distance(points, directions)
        met = np.isfinite(distance)
        far = distance[met] / np.linalg.norm(points[met] + distance[met, None] * directions[met], axis=1)
        leaning = by_way[met] / (directions[met] @ self.floor.up)[:, None]
        found[met] = far[:, None, None] * (slopes[met] - leaning[..., None] * self.floor.up)
        return found


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
