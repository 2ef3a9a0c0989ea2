"""A mirror in panes, such as a front of glass: a plane that lines cut, and polynomial heights over its cells."""

from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from jaxtyping import Float, Int
from numpy.polynomial import legendre

from panoless.geometry.height_field.model import ORDERS, STEPS_A_CELL, HeightField, HeightFieldHits
from panoless.geometry.plane.model import Plane
from shinypartial.core.camera import Similarity

DEGREE = 2
"""Of the heights, to begin with: offset, two slopes and three curvatures."""
PIECES = 4
"""Straight pieces of the mirror's edge along a pane."""
NEWTON_STEPS = 2
"""Toward the hit of a ray, from that of the plane: heights are small against panes."""
BESIDE = 1.5
"""Polynomials go on as constants from so many half sides of a pane on."""


@dataclass(frozen=True)
class CutPlane(Plane):
    """A plane in panes: cell (i, j) lies between the lines u = `cuts_u`[i], `cuts_u`[i + 1] and those of v. The first
    and the last lines are those of the boundary's box.
    """

    cuts_u: Float[np.ndarray, "A"] = field(kw_only=True)
    cuts_v: Float[np.ndarray, "B"] = field(kw_only=True)
    width: float = field(default=0.0, kw_only=True)
    """Of the bars between panes, which show no surroundings."""

    @property
    def cuts(self) -> tuple[Float[np.ndarray, "A"], Float[np.ndarray, "B"]]:
        """Along u and along v."""
        return self.cuts_u, self.cuts_v

    @property
    def num_parameters(self) -> int:
        """With the inner lines."""
        return super().num_parameters + sum(len(each) - 2 for each in self.cuts)

    @property
    def bars(self) -> list[Float[np.ndarray, "4 2"]]:
        """Corners of the bars between panes, from side to side of the box."""
        half, found = self.width / 2, []
        (low_u, *inner_u, high_u), (low_v, *inner_v, high_v) = self.cuts
        for u in inner_u if half > 0 else ():
            found.append(np.array([[u - half, low_v], [u + half, low_v], [u + half, high_v], [u - half, high_v]]))
        for v in inner_v if half > 0 else ():
            found.append(np.array([[low_u, v - half], [high_u, v - half], [high_u, v + half], [low_u, v + half]]))
        return found

    def taken_back(self, common: Similarity) -> "CutPlane":
        """As it is in the world from which a motion was taken back."""
        moved = cast(CutPlane, super().taken_back(common))
        shift = moved.boundary[0] - self.boundary[0] / common.scale
        cuts_u, cuts_v = (each / common.scale + by for each, by in zip(self.cuts, shift, strict=True))
        return replace(moved, cuts_u=cuts_u, cuts_v=cuts_v, width=self.width / common.scale)


@dataclass(frozen=True)
class Panes(HeightField):
    """x(u, v) = plane point (u, v) + h(u, v) n, with h = Σ c_kl P_k(x) P_l(y), k + l ≤ degree, over each pane.

    P are Legendre polynomials, x and y the place in the pane, from −1 to 1. Row i·N + j of the coefficients is that of
    pane (i, j).
    """

    plane: CutPlane

    @property
    def narrowest(self) -> float:
        """The shortest side of a pane."""
        return float(min(np.diff(each).min() for each in self.plane.cuts))

    @property
    def degree(self) -> int:
        """Of the polynomials."""
        return round(np.sqrt(2 * self.coefficients.shape[1] + 0.25) - 1.5)

    @property
    def powers(self) -> Int[np.ndarray, "T 2"]:
        """k and l of each coefficient of a pane."""
        degree = self.degree
        return np.array([(k, total - k) for total in range(degree + 1) for k in range(total, -1, -1)])

    def taken_back(self, common: Similarity) -> "Panes":
        """As it is in the world from which a motion was taken back."""
        return cast(Panes, super().taken_back(common))

    def pane_at(self, places: Float[np.ndarray, "P 2"]) -> Int[np.ndarray, "P 2"]:
        """Indices (i, j) of the panes at plane coordinates; the nearest beside all."""
        cuts = zip(places.T, self.plane.cuts, strict=True)
        return np.stack([np.searchsorted(each[1:-1], line) for line, each in cuts], 1)

    def joint_distance(self, places: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P"]:
        """From the nearest bar between panes."""
        least = np.full(len(places), np.inf)
        for line, cuts in zip(places.T, self.plane.cuts, strict=True):
            for cut in cuts[1:-1]:
                np.minimum(least, np.abs(line - cut), out=least)
        return least - self.plane.width / 2

    def basis(
        self, places: Float[np.ndarray, "P 2"], derivatives: int = 2
    ) -> tuple[Int[np.ndarray, "P T"], Float[np.ndarray, "K P T"]]:
        """See the height field."""
        pane = self.pane_at(places)
        terms = self.coefficients.shape[1]
        return self._row(pane)[:, None] * terms + np.arange(terms), np.stack(self._terms(places, pane, derivatives))

    def _row(self, pane: Int[np.ndarray, "P 2"]) -> Int[np.ndarray, "P"]:
        """Rows of the coefficients."""
        return pane[:, 0] * (len(self.plane.cuts_v) - 1) + pane[:, 1]

    def _terms(
        self, places: Float[np.ndarray, "P 2"], pane: Int[np.ndarray, "P 2"], derivatives: int
    ) -> list[Float[np.ndarray, "P T"]]:
        """Polynomials of panes and their derivatives, in the order of `ORDERS`."""
        powers, values = self.powers, []
        for axis, cuts in enumerate(self.plane.cuts):
            half, middle = _halves(cuts)[pane[:, axis]], _middles(cuts)[pane[:, axis]]
            by_power = legendre.legvander(((places[:, axis] - middle) / half).clip(-BESIDE, BESIDE), self.degree)
            of_axis = [by_power[:, powers[:, axis]]]
            for order in range(1, derivatives + 1):
                derived = np.zeros((self.degree + 1, self.degree + 1))
                derived[: self.degree + 1 - order] = legendre.legder(np.eye(self.degree + 1), order)
                of_axis.append(by_power @ derived[:, powers[:, axis]] / half[:, None] ** order)
            values.append(of_axis)
        return [values[0][i] * values[1][j] for i, j in ORDERS if i + j <= derivatives]

    def edge_basis(
        self, side: Int[np.ndarray, "P"], along: Float[np.ndarray, "P"]
    ) -> tuple[Int[np.ndarray, "P T"], Float[np.ndarray, "P T"]]:
        """See the height field; the edge is that of the panes above the sides."""
        sides = np.roll(self.plane.boundary, -1, 0) - self.plane.boundary
        index, weights = self.basis(self.plane.boundary[side] + along[:, None] * sides[side], 0)
        return index, weights[0]

    def hits(
        self,
        origins: Float[np.ndarray, "P 3"],
        directions: Float[np.ndarray, "P 3"],
        pane: Int[np.ndarray, "P 2"] | None = None,
    ) -> HeightFieldHits:
        """Where rays meet the front of the panes in which they meet the plane, to a Newton step, or of given ones."""
        starts, ways = origins @ self.frame.T - [0, 0, self.plane.offset], directions @ self.frame.T
        met = (ways[:, 2] < 0) & (starts[:, 2] > 0)
        distance = np.where(met, -starts[:, 2] / np.where(met, ways[:, 2], -1.0), 0.0)
        given, (height, *slopes) = pane, np.zeros((3, len(distance)))
        for step in range(NEWTON_STEPS + 1):
            places = (starts + distance[:, None] * ways)[:, :2]
            if given is None and step < NEWTON_STEPS:
                pane = self.pane_at(places)
            assert pane is not None, "panes are given or met"
            coefficients = self.coefficients[self._row(pane)]
            height, *slopes = (
                np.einsum("pt,pt->p", each, coefficients) for each in self._terms(places, pane, derivatives=1)
            )
            rate = ways[:, 2] - slopes[0] * ways[:, 0] - slopes[1] * ways[:, 1]
            met &= rate < 0
            if step < NEWTON_STEPS:
                distance -= np.where(
                    met, (starts[:, 2] + distance * ways[:, 2] - height) / np.where(met, rate, -1.0), 0
                )
        return HeightFieldHits(np.where(met & (distance > 0), distance, np.inf), places, np.stack(slopes, 1))

    def with_halved_cells(self) -> "Panes":
        """With polynomials of two degrees more."""
        finer = flat_panes(self.plane, self.degree + 2)
        coefficients = np.zeros_like(finer.coefficients)
        coefficients[:, : self.coefficients.shape[1]] = self.coefficients
        return replace(self, coefficients=coefficients)

    def bending(self) -> Float[np.ndarray, "D D"]:
        """B with cᵀ B c the sum of squared coefficients, without what tilts the whole."""
        tilts = self.tilts()
        return np.eye(len(tilts)) - tilts @ tilts.T

    def tilts(self) -> Float[np.ndarray, "D 3"]:
        """An orthonormal basis of the coefficients whose height is linear over all panes."""
        halves, middles = ([f(each) for each in self.plane.cuts] for f in (_halves, _middles))
        found = np.zeros((*map(len, middles), self.coefficients.shape[1], 3))
        found[:, :, 0, 0] = 1.0
        found[:, :, 0, 1], found[:, :, 1, 1] = middles[0][:, None], halves[0][:, None]
        found[:, :, 0, 2], found[:, :, 2, 2] = middles[1], halves[1]
        return np.linalg.qr(found.reshape(-1, 3))[0]

    def quadrilaterals(self) -> tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, "F 4"]]:
        """Points in the normalized frame, over a grid of each pane, and the faces within the boundary."""
        share = np.linspace(-1, 1, STEPS_A_CELL * PIECES + 1)
        # Places on a line between two panes belong to one of them only.
        lines = [
            (_middles(each)[:, None] + (_halves(each)[:, None] - max(self.plane.width / 2, 1e-9)) * share)
            for each in self.plane.cuts
        ]
        u, v = np.broadcast_arrays(lines[0][:, None, :, None], lines[1][None, :, None, :])
        return self.faces_over(np.stack([u, v], -1))


def _halves(cuts: Float[np.ndarray, "M"]) -> Float[np.ndarray, "M-1"]:
    return np.diff(cuts) / 2


def _middles(cuts: Float[np.ndarray, "M"]) -> Float[np.ndarray, "M-1"]:
    return (cuts[1:] + cuts[:-1]) / 2


def flat_panes(plane: CutPlane, degree: int = DEGREE) -> Panes:
    """Panes without height."""
    panes = int(np.prod([len(each) - 1 for each in plane.cuts]))
    flat = Panes(plane, plane.boundary.min(0), 1.0, np.zeros((panes, (degree + 1) * (degree + 2) // 2)))
    return replace(flat, spacing=flat.narrowest / PIECES)
