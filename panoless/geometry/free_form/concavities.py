"""A concavity of few parameters under a patch of a surface, and the surface from which it is carved."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from panoless.geometry.free_form.surface import NODE, LevelSet
from panoless.numeric.factorize import regularize
from shinypartial.core.sphere import tangents

KNOTS = np.linspace(0, np.pi / 2, 5)
"""Angles from a concavity's axis at which its reach is given; at the first and the last of them it is 1."""
HALF_SIDE, SIDE = 1.8, 73
"""Half the side of a chart in its radii, and points along the side."""
FAR_CELLS = 8.0
"""Most distance from a concavity's wall that counts."""
ROUNDING_CELLS = 0.7
"""Width over which concavity and surface melt together at the rim."""
RIM_SHARE = 0.08
"""The cap is fitted to the surface within so much of the rim, in ways to it."""
LID_STIFFNESS = 0.02
"""Weight of a cap's squared curvatures, in heights."""


@dataclass(frozen=True)
class Chart:
    """Coordinates (u, v, w) over a patch, in its radii; w points outward."""

    origin: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    """Rows: the directions of u, v and w."""
    radius: float

    @classmethod
    def about(cls, origin: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"], radius: float) -> "Chart":
        """With w along a unit normal."""
        return cls(origin, np.stack([*tangents(normal), normal]), radius)

    def coordinates(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Of points of the normalized frame."""
        return (points - self.origin) @ self.axes.T / self.radius

    def points(self, coordinates: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """The inverse of `coordinates`."""
        return coordinates @ self.axes * self.radius + self.origin


@dataclass(frozen=True)
class Concavity:
    """A concavity under a cap, given in radii of a chart.

    Its rim lies at log r(θ) = size + a₂ cos 2θ + b₂ sin 2θ + a₃ cos 3θ + b₃ sin 3θ about its middle. With ρ the share
    of the way to the rim, δ what lies below the cap in depths, and ψ = atan2(ρ, δ), it contains the points whose
    g = √(ρ² + δ²)/s(ψ) < 1. The reach s is a monotone cubic through its values at the knots, so walls may be steep; an
    ellipsoid has s = 1. The middle shifts by the lean down to the depth.
    """

    middle: Float[np.ndarray, "2"]
    size: float
    waves: Float[np.ndarray, "4"]
    depth: float
    reach: Float[np.ndarray, "3"]
    lean: Float[np.ndarray, "2"]

    @property
    def vector(self) -> Float[np.ndarray, "13"]:
        """All numbers in one array."""
        return np.concatenate([self.middle, [self.size], self.waves, [self.depth], self.reach, self.lean])

    @classmethod
    def from_vector(cls, values: Float[np.ndarray, "13"]) -> "Concavity":
        """The inverse of `vector`, with the least depth and reach that a concavity has."""
        depth, reach = max(float(values[7]), 0.02), np.clip(values[8:11], 0.2, 2.0)
        return cls(values[:2], float(values[2]), values[3:7], depth, reach, values[11:])

    @classmethod
    def bowl(cls, size: float, waves: Float[np.ndarray, "4"], depth: float, exponent: float = 2.0) -> "Concavity":
        """About the middle of the chart, with the superellipse ρᵖ + δᵖ = 1 for a profile."""
        inner = KNOTS[1:-1]
        reach = (np.sin(inner) ** exponent + np.cos(inner) ** exponent) ** (-1 / exponent)
        return cls(np.zeros(2), size, waves, depth, reach, np.zeros(2))

    def share(self, u: Float[np.ndarray, "*P"], v: Float[np.ndarray, "*P"]) -> Float[np.ndarray, "*P"]:
        """ρ at places of the chart whose middle is that of the rim."""
        away = (u - self.middle[0]) + 1j * (v - self.middle[1])
        distance: np.ndarray = np.abs(away)
        turn = away / np.maximum(distance, 1e-9)
        twice, thrice = turn**2, turn**3
        a, b, c, d = self.waves
        rim = self.size + a * twice.real + b * twice.imag + c * thrice.real + d * thrice.imag
        return distance * np.exp(-rim)

    def level(
        self, u: Float[np.ndarray, "*P"], v: Float[np.ndarray, "*P"], below: Float[np.ndarray, "*P"]
    ) -> Float[np.ndarray, "*P"]:
        """g at places so far below the cap; above it the concavity goes on as a cylinder."""
        from scipy.interpolate import PchipInterpolator

        sunk = np.maximum(below, 0) / self.depth
        down = np.minimum(sunk, 1)
        share = self.share(u - self.lean[0] * down, v - self.lean[1] * down)
        reach = PchipInterpolator(KNOTS, np.concatenate([[1.0], self.reach, [1.0]]))
        fine = np.linspace(0, np.pi / 2, 257)
        found: np.ndarray = np.hypot(share, sunk) / np.interp(np.arctan2(share, sunk), fine, reach(fine))
        return found


@dataclass(frozen=True)
class Relief:
    """A surface over a chart."""

    surface: LevelSet
    chart: Chart

    @cached_property
    def grid(self) -> tuple[Float[np.ndarray, "N N"], Float[np.ndarray, "N N"]]:
        """u and v of the points of the chart."""
        axis = np.linspace(-HALF_SIDE, HALF_SIDE, SIDE)
        u, v = np.meshgrid(axis, axis, indexing="ij")
        return u, v

    @cached_property
    def heights(self) -> Float[np.ndarray, "N N"]:
        """w of the surface as seen from above; not a number where there is none."""
        u, v = self.grid
        above = np.stack([u.ravel(), v.ravel(), np.full(u.size, 2 * HALF_SIDE)], 1)
        down = np.tile(-self.chart.axes[2], (u.size, 1))
        hits = self.surface.hits(self.chart.points(above), down)
        found: np.ndarray = np.where(hits.met, 2 * HALF_SIDE - hits.distance / self.chart.radius, np.nan)
        return found.reshape(u.shape)

    @cached_property
    def values(self) -> Float[np.ndarray, "A B C"]:
        """φ of the surface at its nodes."""
        return self.surface.at_nodes()

    @cached_property
    def box(self) -> tuple[slice, slice, slice]:
        """The nodes about the chart."""
        middle = self.surface.places(self.chart.origin[None])[0] + NODE
        half = HALF_SIDE * self.chart.radius / self.surface.spacing + 2
        first = np.clip(np.floor(middle - half), 0, np.array(self.surface.shape) - 4).astype(int)
        last = np.clip(np.ceil(middle + half), first + 4, self.surface.shape).astype(int)
        one, two, three = (slice(int(low), int(high)) for low, high in zip(first, last, strict=True))
        return one, two, three

    @cached_property
    def places(self) -> Float[np.ndarray, "a b c 3"]:
        """Coordinates of those nodes over the chart."""
        nodes = self.surface.nodes()[self.box]
        found = self.chart.coordinates(self.surface.points(nodes.reshape(-1, 3)))
        return found.reshape(nodes.shape)

    def cap(self, concavity: Concavity) -> Float[np.ndarray, "6"]:
        """Coefficients of 1, u, v, u², uv and v² of the height that passes through the surface along a rim."""
        u, v = self.grid
        at_rim = (np.abs(concavity.share(u, v) - 1) < RIM_SHARE) & np.isfinite(self.heights)
        rows, heights = _quadric(u[at_rim], v[at_rim]), self.heights[at_rim]
        stiff = np.diag([1e-6, 1e-6, 1e-6, 1.0, 1.0, 1.0]) * LID_STIFFNESS * max(len(rows), 1)
        found: np.ndarray = np.linalg.solve(regularize(rows.T @ rows + stiff, "a cap"), rows.T @ heights)
        return found

    def carved(self, concavity: Concavity, rounding_cells: float = ROUNDING_CELLS) -> LevelSet:
        """The surface without the concavity and what lies above its cap: max(φ, (1 − g)/‖∇g‖)."""
        u, v, w = np.moveaxis(self.places, -1, 0)
        level = concavity.level(u, v, _quadric(u, v) @ self.cap(concavity) - w)
        slope = np.sqrt(sum(each**2 for each in np.gradient(level)))
        values = self.values.copy()
        concave = (1 - level) / np.maximum(slope, 1e-3)
        values[self.box] = smooth_maximum(values[self.box], np.minimum(concave, FAR_CELLS), rounding_cells)
        return self.surface.interpolating(values)


def _quadric(u: Float[np.ndarray, "*P"], v: Float[np.ndarray, "*P"]) -> Float[np.ndarray, "*P 6"]:
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], -1)


def smooth_maximum(
    one: Float[np.ndarray, "*P"], other: Float[np.ndarray, "*P"], width: float
) -> Float[np.ndarray, "*P"]:
    """max(a, b) + (k − |a − b|)₊²/4k: smooth where they differ by less than k."""
    return np.maximum(one, other) + np.maximum(width - np.abs(one - other), 0) ** 2 / (4 * width)
