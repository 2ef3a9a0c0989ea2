"""What a finished dataset amounts to: object pixels, how many see the object itself, and what the views cover."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from shinypartial.core.camera import ray_directions_world, reflect
from shinypartial.dataset.read import read_view
from shinypartial.dataset.schema import Frame
from shinypartial.evaluation.masks import environment_mask, solid_mask
from shinypartial.metrics.coverage import ObservedCells, cells_of_view, coverage, nothing_observed


@dataclass(frozen=True)
class SplitStatistics:
    """Sums over the views of one split; `cells` are the directions in which its pixels mirror the environment."""

    views: int
    object_pixels: int
    self_reflecting_pixels: int
    cells: ObservedCells

    @property
    def self_reflection(self) -> float:
        """Share of the object's pixels that see the object or its frame, in [0, 1]."""
        return self.self_reflecting_pixels / max(self.object_pixels, 1)


def split_statistics(frames: Sequence[Frame]) -> SplitStatistics:
    """Read every view; pixels count where they lie wholly on the object."""
    pixels = reflecting = 0
    cells = nothing_observed()
    for frame in frames:
        view = read_view(frame)
        solid, alone = solid_mask(view), environment_mask(view)
        pixels += int(solid.sum())
        reflecting += int((solid & ~alone).sum())
        if view.normals_world is not None:
            mirrored = reflect(ray_directions_world(frame.camera)[alone], view.normals_world[alone])
            cells = cells.union(cells_of_view(mirrored))
    return SplitStatistics(len(frames), pixels, reflecting, cells)


def dataset_statistics(train: Sequence[Frame], test: Sequence[Frame]) -> dict[str, Any]:
    """The manifest's `statistics`: counts of views, and what docs/reference/dataset-format.md says about the rest."""
    by_split = {"train": split_statistics(train), "test": split_statistics(test)}
    training = by_split["train"].cells
    return {
        **{name: split.views for name, split in by_split.items()},
        "object_pixels": {name: split.object_pixels for name, split in by_split.items()},
        "self_reflection": {name: round(split.self_reflection, 6) for name, split in by_split.items()},
        "coverage": round(coverage(training.observed), 6),
        "resolved_coverage": round(coverage(training.resolved), 6),
    }
