"""The unknowns beside the surface and the map as one: blocks, and which of them are free."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from panoless.capture.poses import StatedCameras
from panoless.capture.views import Views
from panoless.environment.surroundings import FAR, Surroundings
from panoless.problem.blocks import BLOCKS, AnyBlock, Block, CameraPoses
from panoless.problem.rays import PixelRays
from shinypartial.core.camera import Similarity


@dataclass(frozen=True)
class Nuisance:
    """Blocks in the order of `BLOCKS`, and which of them are free. The others stay at their values."""

    blocks: tuple[Block, ...] = ()
    free: tuple[str, ...] = ()

    def get(self, kind: type[AnyBlock]) -> AnyBlock | None:
        """The block of that kind; None where there is none."""
        return next((block for block in self.blocks if isinstance(block, kind)), None)

    def free_blocks(self, *, by_view: bool) -> tuple[Block, ...]:
        """Free ones of views, or of all views."""
        return tuple(each for each in self.blocks if each.name in self.free and each.by_view == by_view)

    def freed(self, names: Collection[str]) -> "Nuisance":
        """With those of the blocks free, and no others."""
        return replace(self, free=tuple(each.name for each in self.blocks if each.name in names))

    def under_coarse(self, resolution: int) -> "Nuisance":
        """With those free that a map of so few texels along a face side determines, and those of views."""
        of_all = [
            each
            for each in self.free_blocks(by_view=False)
            if each.least_resolution is not None and resolution >= each.least_resolution
        ]
        return self.freed([each.name for each in (*self.free_blocks(by_view=True), *of_all)])

    def without(self, names: Collection[str]) -> "Nuisance":
        """With blocks at the means of their priors: they are gone."""
        left = Nuisance(tuple(each for each in self.blocks if each.name not in names))
        return left.freed(self.free)

    def without_common(self, cameras: StatedCameras) -> tuple[Similarity | None, "Nuisance"]:
        """What moves all cameras alike, of which damped steps leave some, and poses in a world without it."""
        found = self.get(CameraPoses)
        if found is None:
            return None, self
        common, poses = found.poses.without_common(cameras, found.precision)
        return common, self.replaced([replace(found, values=poses.stacked)])

    def of_views(self, numbers: Sequence[int]) -> "Nuisance":
        """Of some of the views."""
        index = np.asarray(numbers, dtype=np.int64)
        return replace(
            self,
            blocks=tuple(
                replace(each, values=each.values[index], precision=each.precision[index]) if each.by_view else each
                for each in self.blocks
            ),
        )

    def replaced(self, changed: Sequence[Block]) -> "Nuisance":
        """With other blocks in the place of those of the same kind."""
        known = {each.name: each for each in changed}
        return replace(self, blocks=tuple(known.get(each.name, each) for each in self.blocks))

    def stepped(self, by_view: Float[np.ndarray, "V M"] | None, shared: Float[np.ndarray, "N"] | None) -> "Nuisance":
        """With the free blocks changed by steps of their numbers in a row."""
        changed = []
        for step, blocks in (
            (by_view, self.free_blocks(by_view=True)),
            (None if shared is None else shared[None], self.free_blocks(by_view=False)),
        ):
            start = 0
            for each in blocks:
                assert step is not None, "free blocks have a step"
                changed.append(each.stepped(step[:, start : start + each.size]))
                start += each.size
        return self.replaced(changed)

    def moved(self, rays: PixelRays, cameras: StatedCameras) -> PixelRays:
        """Rays through the lens of all views, from where their cameras are."""
        axes = cameras.rotations[rays.view, 2]
        for block in self.blocks:
            rays = block.moved(rays, axes)
        return rays

    def around(self, known: Surroundings) -> Surroundings:
        """What is known of the surroundings, with what is unknown of them."""
        for block in self.blocks:
            known = block.around(known)
        return known

    def log_gains(self, view: Int[np.ndarray, "P"]) -> Float[np.ndarray, "P 3"] | float:
        """log g of the pixels of those views; 0 where no block changes it."""
        parts = [found for each in self.blocks if (found := each.log_gains()) is not None]
        return sum(parts)[view] if parts else 0.0  # type: ignore[index]

    def equalized(self, radiance: Float[np.ndarray, "P 3"], view: Int[np.ndarray, "P"]) -> Float[np.ndarray, "P 3"]:
        """c/g of the pixels of those views: what they would have seen at equal exposures."""
        return radiance * np.exp(-self.log_gains(view))

    def offsets_px(self, view: Int[np.ndarray, "S"]) -> Float[np.ndarray, "S"]:
        """By how many pixels the masks of those views are too large."""
        moving = (each for each in self.blocks if each.moves_silhouettes)
        return sum((each.values[view if each.by_view else 0, 0] for each in moving), np.zeros(len(view)))

    @property
    def prior_cost(self) -> float:
        """½ Σ xᵀ P x."""
        return sum(each.from_prior for each in self.blocks) / 2


NO_NUISANCE = Nuisance()


def block_diagonal(parts: Sequence[Float[np.ndarray, "B _ _"]]) -> Float[np.ndarray, "B M M"]:
    """Matrices of each group along the diagonal of one."""
    ends = np.cumsum([0, *(each.shape[1] for each in parts)])
    joined = np.zeros((len(parts[0]), ends[-1], ends[-1]))
    for each, first, last in zip(parts, ends[:-1], ends[1:], strict=True):
        joined[:, first:last, first:last] = each
    return joined


def nuisance_of(views: Views, kinds: Collection[type[Block]] = BLOCKS, around: Surroundings = FAR) -> Nuisance:
    """Blocks of those kinds as they start in proposed surroundings, all free."""
    started = (kind.of(views, around) for kind in BLOCKS if kind in kinds)
    blocks = tuple(each for each in started if each is not None)
    return Nuisance(blocks, tuple(each.name for each in blocks))
