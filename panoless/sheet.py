"""A mirror that bends: a plane with an outline and a smooth height over it.

Surfels are free to tilt without moving; a height is not, because its slope is its normal. So a nearly flat mirror can't
drift into a tilt that the environment turns after.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.initialize import surfels_on_plane
from panoless.plane import Plane
from panoless.surfels import Surfels

ORDERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
"""Derivatives along u and v: height, slopes, bending."""


@dataclass(frozen=True)
class Sheet:
    """x(u, v) = plane point (u, v) + h(u, v) n, with h a uniform cubic B-spline of M × N coefficients.

    The coefficient of row i and column j has its peak at `low` + spacing·(i − 1, j − 1), in plane coordinates.
    """

    plane: Plane
    low: Float[np.ndarray, "2"]
    spacing: float
    coefficients: Float[Tensor, "M N"]

    @property
    def numbers(self) -> int:
        """How many numbers it is made of: those of the plane and its outline, and the coefficients."""
        return self.plane.numbers + self.coefficients.numel()

    def tilted(self, slope_u: float, slope_v: float) -> "Sheet":
        """The sheet plus slope_u u + slope_v v, about the middle of the outline. Splines hold a plane exactly."""
        rows, columns = (torch.arange(count) - 1.0 for count in self.coefficients.shape)
        middle = (self.plane.outline.min(0) + self.plane.outline.max(0)) / 2 - self.low
        added = slope_u * (rows[:, None] * self.spacing - middle[0]) + slope_v * (columns * self.spacing - middle[1])
        return replace(self, coefficients=self.coefficients + added.to(self.coefficients))


def flat_sheet(plane: Plane, cells: int) -> Sheet:
    """A sheet without height, of that many cells along the longer side of the outline."""
    low, extent = plane.outline.min(0), np.ptp(plane.outline, 0)
    spacing = float(extent.max()) / cells
    rows, columns = (int(np.ceil(length / spacing - 1e-9)) + 3 for length in extent)
    return Sheet(plane, low, spacing, torch.zeros(rows, columns))


class SheetSurfels:
    """Surfels at fixed places (u, v) of a sheet, as a differentiable function of its coefficients."""

    def __init__(self, sheet: Sheet, count: int, seed: int) -> None:
        """About `count` surfels, evenly within the outline."""
        self._flat = surfels_on_plane(sheet.plane, count, seed)
        self._normal = torch.from_numpy(sheet.plane.normal).float()
        tangents = torch.from_numpy(np.stack([sheet.plane.tangent_u, sheet.plane.tangent_v], 1)).float()
        place = ((self._flat.means @ tangents) - torch.from_numpy(sheet.low).float()) / sheet.spacing
        rows, columns = sheet.coefficients.shape
        cell = place.floor().clamp(min=0).minimum(torch.tensor([rows - 4.0, columns - 4.0]))
        along = [_cubic_basis((place - cell)[:, axis]) for axis in (0, 1)]
        row, column = (cell[:, axis, None].long() + torch.arange(4) for axis in (0, 1))
        self._index = (row[:, :, None] * columns + column[:, None]).flatten(1)
        self._weights = [
            (along[0][i][:, :, None] * along[1][j][:, None]).flatten(1) / sheet.spacing ** (i + j) for i, j in ORDERS
        ]

    def heights(self, coefficients: Float[Tensor, "M N"]) -> list[Float[Tensor, "K"]]:
        """h, h_u, h_v, h_uu, h_uv and h_vv at the surfels."""
        near = coefficients.flatten()[self._index]
        return [(near * weight).sum(1) for weight in self._weights]

    def surfels(self, coefficients: Float[Tensor, "M N"]) -> Surfels:
        """Means p + h n, normals ∝ n − h_u t_u − h_v t_v, and curvatures D²h/√(1 + |∇h|²), which is the shape operator
        but for terms of second order in the slope.
        """
        h, h_u, h_v, h_uu, h_uv, h_vv = self.heights(coefficients)
        norm = (1 + h_u.square() + h_v.square()).sqrt()
        # The least rotation, in axes of the plane, that takes (0, 0, 1) to (−h_u, −h_v, 1)/norm.
        turn = torch.stack([1 + 1 / norm, h_v / norm, -h_u / norm, torch.zeros_like(norm)], 1)
        return replace(
            self._flat,
            means=self._flat.means + h[:, None] * self._normal,
            quats=_product(self._flat.quats, turn),
            curvatures=torch.stack([h_uu, h_uv, h_vv], 1) / norm[:, None],
        )

    def bending(self, coefficients: Float[Tensor, "M N"]) -> Float[Tensor, ""]:
        """Mean of h_uu² + 2 h_uv² + h_vv²."""
        _, _, _, h_uu, h_uv, h_vv = self.heights(coefficients)
        return (h_uu.square() + 2 * h_uv.square() + h_vv.square()).mean()


def sheet_surfels(sheet: Sheet, count: int, seed: int) -> Surfels:
    """About `count` surfels on a sheet."""
    return SheetSurfels(sheet, count, seed).surfels(sheet.coefficients)


def _cubic_basis(t: Float[Tensor, "K"]) -> list[Float[Tensor, "K 4"]]:
    """The four uniform cubic B-splines over a cell, t in [0, 1], and their first and second derivatives by t."""
    values = ((1 - t) ** 3 / 6, (3 * t**3 - 6 * t**2 + 4) / 6, (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6, t**3 / 6)
    slopes = (-((1 - t) ** 2) / 2, (9 * t**2 - 12 * t) / 6, (-9 * t**2 + 6 * t + 3) / 6, t**2 / 2)
    bends = (1 - t, 3 * t - 2, 1 - 3 * t, t)
    return [torch.stack(each, 1) for each in (values, slopes, bends)]


def _product(left: Float[Tensor, "K 4"], right: Float[Tensor, "K 4"]) -> Float[Tensor, "K 4"]:
    """Quaternion product, wxyz."""
    w, x, y, z = left.unbind(1)
    a, b, c, d = right.unbind(1)
    return torch.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        1,
    )
