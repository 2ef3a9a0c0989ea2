"""What models without a mirror explain of held-out views: one color a view, and one color a place on the surface, as a
matte object has.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.contrast import Contrast
from panoless.capture.views import TrainView, Views, at_most_pixels, split_held_out
from panoless.environment.resolution import ERROR_SCALE
from panoless.geometry.base import Geometry, SurfaceBuffers
from panoless.numeric.robust import bounded_error

CELLS = 48
"""Along a side of the grid on which a matte surface has its colors."""

Seen = Sequence[tuple[TrainView, SurfaceBuffers]]
"""Views, and a surface in each."""


@dataclass
class Mean:
    """A weighted mean of what was added."""

    summed: float = 0.0
    weight: float = 0.0

    def add(self, values: Float[Tensor, "P"], weights: Float[Tensor, "P"]) -> None:
        """Count values in."""
        self.summed += float((values * weights).sum())
        self.weight += float(weights.sum())

    @property
    def value(self) -> float:
        """Zero where nothing was added."""
        return self.summed / max(self.weight, 1e-9)


@dataclass
class Cells:
    """Summed values of pixels, and their number, by the cells of a grid through which the surface passes."""

    side: int
    summed: Float[Tensor, "N C"]
    count: Float[Tensor, "N"]

    @classmethod
    def empty(cls, side: int, values: int, device: torch.device) -> "Cells":
        """Before any pixel."""
        return cls(side, torch.zeros(side**3, values, device=device), torch.zeros(side**3, device=device))

    def add(
        self, view: TrainView, surface: SurfaceBuffers, pixels: Int[Tensor, "P"], values: Float[Tensor, "P C"]
    ) -> None:
        """Count pixels of a view in."""
        index = self._index(view, surface, pixels)
        self.summed.index_add_(0, index, values)
        self.count.index_add_(0, index, torch.ones_like(values[:, 0]))

    def means(self, view: TrainView, surface: SurfaceBuffers, pixels: Int[Tensor, "P"]) -> Float[Tensor, "P C"]:
        """Of the cells that pixels see; that of all cells where nothing was added."""
        index, overall = self._index(view, surface, pixels), self.summed.sum(0) / self.count.sum().clamp(min=1)
        count = self.count[index][:, None]
        return torch.where(count > 0, self.summed[index] / count.clamp(min=1), overall)

    def share_above(self, limit: float) -> float:
        """The share of the pixels that lie in cells whose mean is above a limit."""
        above = self.summed[:, 0] > limit * self.count
        return float(self.count[above].sum() / self.count.sum().clamp(min=1))

    def _index(self, view: TrainView, surface: SurfaceBuffers, pixels: Int[Tensor, "P"]) -> Int[Tensor, "P"]:
        """Cells of the cube of side 2 in which pixels see the surface; the nearest for what lies beyond."""
        points = surface.points(view.camera, pixels)
        grid = ((points.T + 1) / 2 * self.side).long().clamp(0, self.side - 1)
        return (grid[0] * self.side + grid[1]) * self.side + grid[2]


@dataclass(frozen=True)
class WithoutMirror:
    """Mean ‖e‖²/(‖e‖² + s²) of held-out views under models that know no mirror."""

    one_color: float
    """Under the mean color of each view."""
    matte: float
    """Under one color for each place on the surface, from the other views."""

    @classmethod
    def of(cls, views: Views, kept: Seen, held_out: Seen, contrast: Contrast, most_pixels: int) -> "WithoutMirror":
        """Of the surface in both parts of the views; about so many pixels of the held-out ones."""
        places, plain, matte = Cells.empty(CELLS, 3, views.train[0].mask.device), Mean(), Mean()
        for view, surface in kept:
            places.add(view, surface, view.solid, contrast.shown(view.radiance_at(view.solid)))
        tested = replace(views, train=tuple(view for view, _ in held_out))
        for (view, surface), (_, pixels) in zip(held_out, at_most_pixels(tested, most_pixels), strict=True):
            radiance = contrast.shown(view.radiance_at(pixels))
            equal = torch.ones_like(radiance[:, 0])
            plain.add(bounded_error(radiance.mean(0) - radiance, ERROR_SCALE), equal)
            matte.add(bounded_error(places.means(view, surface, pixels) - radiance, ERROR_SCALE), equal)
        return cls(plain.value, matte.value)


def surfaces_of(views: Views, geometry: Geometry, count: int) -> tuple[Seen, Seen]:
    """About so many of the kept and of the held-out views, with the surface in each."""
    kept, held_out = (
        [(view, geometry.buffers(view.camera)) for view in part[:: -(-len(part) // count) or 1]]
        for part in split_held_out(views.train)
    )
    return kept, held_out
