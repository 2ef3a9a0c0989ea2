"""Changing the profile of a surface of revolution: even sampling, and cubic splines of its shift along the normals."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.numeric.bspline import cubic_bsplines_at

LEAST_CORNER_SINE = 0.5
"""A vertex whose sides turn by more than half a right angle or so is a corner: it moves to where both sides move."""
UNEVEN = 0.3
"""Share of the mean length by which sides may differ before a profile is resampled."""
LARGEST_SHIFT_SIDES = 1.5
"""A vertex moves by at most this many lengths of a side in one step, or the profile could fold."""


def resample_profile(surface: SurfaceOfRevolution, spacing: float) -> SurfaceOfRevolution:
    """The same surface with vertices about `spacing` apart outside and inside; base and lip stay where they are.

    A part whose vertices are nearly so is left alone: resampling cuts its corners.
    """
    outer, inner = surface.profile[1 : surface.lip + 1], surface.profile[surface.lip :]
    even = [_even(part, spacing) for part in (outer, inner)]
    if all(each is part for each, part in zip(even, (outer, inner), strict=True)):
        return surface
    outer, inner = even
    profile = np.concatenate([[[0.0, outer[0, 1]]], outer, inner[1:]])
    return replace(surface, profile=profile, lip=len(outer))


def _even(points: Float[np.ndarray, "N 2"], spacing: float) -> Float[np.ndarray, "M 2"]:
    """A polyline at equal steps of its length; itself where its steps are nearly equal."""
    if len(points) < 2:
        return points
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    length = np.append(0.0, np.cumsum(steps))
    pieces = max(int(np.ceil(length[-1] / spacing)), 1)
    if len(steps) == pieces and (np.abs(steps * pieces / max(length[-1], 1e-12) - 1) < UNEVEN).all():
        return points
    where = np.linspace(0, length[-1], pieces + 1)
    kept = np.append(True, np.diff(length) > 1e-12)
    return np.stack([np.interp(where, length[kept], column[kept]) for column in points.T], 1)


@dataclass(frozen=True)
class ProfileSplines:
    """Uniform cubic B-splines over the arc length of the outer and of the inner profile, each with its own ones."""

    surface: SurfaceOfRevolution
    starts: tuple[float, float]
    knots: tuple[float, float]
    counts: tuple[int, int]

    @classmethod
    def of(cls, surface: SurfaceOfRevolution, knot: float) -> "ProfileSplines":
        """Splines with knots about `knot` apart. The base has none: it moves with the outer profile."""
        length = surface.arc_lengths
        bounds = (length[1], length[surface.lip], length[-1])
        pieces = [max(round((bounds[i + 1] - bounds[i]) / knot), 1) for i in (0, 1)]
        open_ended = surface.lip == len(surface.profile) - 1
        return cls(
            surface,
            (float(bounds[0]), float(bounds[1])),
            (
                float((bounds[1] - bounds[0]) / pieces[0]),
                1.0 if open_ended else float((bounds[2] - bounds[1]) / pieces[1]),
            ),
            (pieces[0] + 3, 0 if open_ended else pieces[1] + 3),
        )

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return sum(self.counts)

    def values(
        self, side: Int[np.ndarray, "P"], along: Float[np.ndarray, "P"], derivative: bool = False
    ) -> tuple[Float[np.ndarray, "P 4"], Int[np.ndarray, "P 4"]]:
        """Values, or derivatives by arc length, of the four splines that act at a place, and which they are.

        On the base they are zero.
        """
        place = self.surface.arc_length_at(side, along)
        inner = (side >= self.surface.lip).astype(np.int64)
        start, knot = np.array(self.starts)[inner], np.array(self.knots)[inner]
        pieces = np.array(self.counts)[inner] - 3
        # A part without length has only its beginning.
        knot = np.where(knot > 0, knot, 1.0)
        first, basis = cubic_bsplines_at(np.clip((place - start) / knot, 0, pieces), pieces + 3, 1)
        values = basis[1] / knot[:, None] if derivative else basis[0]
        values = np.where((side == 0)[:, None], 0.0, values)
        return values, np.where((side == 0)[:, None], 0, (first + inner * self.counts[0])[:, None]) + np.arange(4)

    def bending(self, weight: float) -> Float[np.ndarray, "C C"]:
        """Matrix of weight · Σ (second differences)², within each piece."""
        matrix = np.zeros((self.count, self.count))
        begin = 0
        for count in self.counts:
            if count:
                second = np.diff(np.eye(count), 2, axis=0)
                matrix[begin : begin + count, begin : begin + count] = weight * second.T @ second
            begin += count
        return matrix


def side_normals(surface: SurfaceOfRevolution) -> Float[np.ndarray, "S 2 2"]:
    """Outward normals (ρ, h) at both ends of every side."""
    return np.stack([np.sin(surface.angles), -np.cos(surface.angles)], 2)


def vertex_motions(surface: SurfaceOfRevolution) -> tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, "M 2"]]:
    """How vertices between two sides move (ρ, h) with the shifts of the side before and of the one after them.

    They take the mean; over an edge, they go to the corner of both shifted sides.
    """
    normal = side_normals(surface)
    before, after = normal[:-1, 1], normal[1:, 0]
    sine = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    corner = (np.abs(sine) > LEAST_CORNER_SINE)[:, None]
    divisor = np.where(corner, sine[:, None], 1.0)
    across = np.stack([after[:, 1], -after[:, 0]], 1), np.stack([-before[:, 1], before[:, 0]], 1)
    by_before, by_after = (
        np.where(corner, edge / divisor, normal / 2) for edge, normal in zip(across, (before, after), strict=True)
    )
    return by_before, by_after


def apply_step(
    surface: SurfaceOfRevolution, splines: ProfileSplines, step: Float[np.ndarray, "D"]
) -> SurfaceOfRevolution:
    """The surface after a turn and a shift of its axis (four numbers) and a shift of its profile (coefficients)."""
    turn, shift = step[:2] @ surface.frame[:2], step[2:4] @ surface.frame[:2]
    axis = surface.axis + np.cross(turn, surface.axis)
    profile, last = surface.profile.copy(), len(surface.profile) - 1
    spacing = float(np.median(np.linalg.norm(np.diff(profile[1:], axis=0), axis=1)))
    limit = LARGEST_SHIFT_SIDES * spacing
    sides = np.arange(last)
    shifts = []
    for end in (0, 1):
        values, index = splines.values(sides, np.full(last, float(end)))
        shifts.append(np.clip((values * step[4:][index]).sum(1), -limit, limit))
    normal = side_normals(surface)
    by_before, by_after = vertex_motions(surface)
    profile[1:-1] += by_before * shifts[1][:-1, None] + by_after * shifts[0][1:, None]
    profile[1] = surface.profile[1] + normal[1, 0] * shifts[0][1]
    # Beyond a thin lip nothing holds a spline: it takes the shift of the vertex before.
    profile[-1] += normal[-1, 1] * (shifts[1][-1] if splines.counts[1] else shifts[0][-1])
    profile[:, 0] = np.maximum(profile[:, 0], 0.0)
    profile[0] = 0.0, profile[1, 1]
    if surface.profile[-1, 0] < 1e-9:
        profile[-1, 0] = 0.0
    return replace(surface, origin=surface.origin + shift, axis=axis / np.linalg.norm(axis), profile=profile)
