"""Unknowns beside the surface and the map: cameras, their lens, exposures, and how far masks are off.

A block has B groups of M numbers, one group a view or one of all views, with a normal prior of mean zero. It states how
rays, radiance and silhouettes change with it. A ray is moved by a turn ω (rad, world axes) and a shift τ (normalized
frame), so a surface needs the derivatives by these two alone.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import numpy as np
from jaxtyping import Float, Int

from panoless.capture.lens import LensChange
from panoless.capture.poses import Poses, StatedCameras
from panoless.capture.views import Views
from panoless.environment.surroundings import Surroundings
from panoless.problem.rays import PixelRays

CHROMATICITIES = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, -2.0]]) / np.sqrt([[2.0], [6.0]])
"""Orthonormal directions of log gains of the channels that leave their mean."""
AnyBlock = TypeVar("AnyBlock", bound="Block")


@dataclass(frozen=True)
class Block:
    """Unknowns of one kind."""

    name: ClassVar[str]
    by_view: ClassVar[bool] = True
    size: ClassVar[int] = 1
    unit: ClassVar[str] = ""
    scale: ClassVar[float] = 1.0
    """Of a number of the block, in that unit."""
    floor: ClassVar[float] = 0.0
    """Standard deviation of an unknown by errors of surface, map and masks, which noise does not show."""
    moves_silhouettes: ClassVar[bool] = False
    """Whether its numbers are pixels by which silhouettes of masks lie outside of those of the object."""
    values: Float[np.ndarray, "B M"]
    precision: Float[np.ndarray, "B M M"]
    """Inverse covariances of the prior."""

    @property
    def rms(self) -> float:
        """Root mean square of the unknowns that have the unit."""
        return self.scale * float(np.sqrt((self.values[:, self.measured] ** 2).mean()))

    @property
    def measured(self) -> slice:
        """Those of a group that have the unit."""
        return slice(None)

    @classmethod
    def at_prior(cls: type[AnyBlock], groups: int, sigma: float) -> AnyBlock:
        """At the mean of the prior, with this standard deviation of each number."""
        return cls(np.zeros((groups, cls.size)), np.tile(np.eye(cls.size) / sigma**2, (groups, 1, 1)))

    def joined(self: AnyBlock, other: AnyBlock, order: Int[np.ndarray, "B"]) -> AnyBlock:
        """Groups of both, in an order."""
        values, precision = (
            np.concatenate([getattr(self, name), getattr(other, name)])[order] for name in ("values", "precision")
        )
        return replace(self, values=values, precision=precision)

    def stepped(self: AnyBlock, step: Float[np.ndarray, "B M"]) -> AnyBlock:
        """Changed by a step."""
        return replace(self, values=self.values + step)

    def moved(self, rays: PixelRays, axes: Float[np.ndarray, "P 3"]) -> PixelRays:
        """Rays as the block has them; `axes` are the optical ones of their cameras."""
        return rays

    def motions(self, rays: PixelRays, axes: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 6 M"] | None:
        """(ω, τ) of rays by the unknowns; None: rays stay."""
        return None

    def gain_rows(self) -> Float[np.ndarray, "3 M"] | None:
        """∂ log g of the channels by the unknowns of their group, where c = g E is seen; None: g is 1."""
        return None

    def log_gains(self) -> Float[np.ndarray, "B 3"] | None:
        """log g of the channels of each group, which is linear in the unknowns; None: g is 1."""
        rows = self.gain_rows()
        return None if rows is None else self.values @ rows.T


class Lens(Block):
    """An unknown of the lens of all views."""

    by_view = False

    @property
    def lens(self) -> LensChange:
        """As a change of the lens."""
        raise NotImplementedError

    def moved(self, rays: PixelRays, axes: Float[np.ndarray, "P 3"]) -> PixelRays:
        """Through that lens."""
        return rays.through_lens(self.lens, axes)

    def motions(self, rays: PixelRays, axes: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 6 M"]:
        """See `LensChange.motions`."""
        return self.lens.motions(rays.origins, rays.directions, axes)


class FocalLength(Lens):
    """s: cameras are eˢ as far away as stated and see through a lens of eˢ times the focal length."""

    name = "focal length"
    unit, scale = "%", 100.0
    floor = 0.001

    @property
    def lens(self) -> LensChange:
        """Of that focal length."""
        return LensChange(focal=float(self.values[0, 0]))


class Distortion(Lens):
    """k₁ of the radial distortion of all views."""

    name = "distortion"
    floor = 0.005

    @property
    def lens(self) -> LensChange:
        """Of that distortion."""
        return LensChange(k1=float(self.values[0, 0]))


class CameraPoses(Block):
    """Turns (rad, world axes) and shifts (normalized frame) of the cameras against what is stated."""

    name = "poses"
    size = 6
    unit, scale = "°", 180 / math.pi
    floor = 2e-4

    @property
    def measured(self) -> slice:
        """Turns."""
        return slice(0, 3)

    @property
    def poses(self) -> Poses:
        """The same as poses."""
        return Poses(self.values[:, :3], self.values[:, 3:])

    def stepped(self, step: Float[np.ndarray, "B M"]) -> "CameraPoses":
        """Turned and shifted once more."""
        return replace(self, values=self.poses.after(step).stacked)

    def moved(self, rays: PixelRays, axes: Float[np.ndarray, "P 3"]) -> PixelRays:
        """From cameras that are turned and shifted."""
        return rays.moved(self.poses)

    def motions(self, rays: PixelRays, axes: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 6 M"]:
        """(ω, τ) themselves."""
        return np.broadcast_to(np.eye(6), (len(rays.size), 6, 6))


class Deviations(Block):
    """Unknowns of views against their mean, which is zero."""

    def stepped(self: AnyBlock, step: Float[np.ndarray, "B M"]) -> AnyBlock:
        """Changed, less the mean."""
        values = self.values + step
        return replace(self, values=values - values.mean(0))


class Exposures(Deviations):
    """log g of each view; the mean of all is one with the brightness of the map."""

    name = "exposures"
    unit, scale = "stops", 1 / math.log(2)
    floor = 0.005

    def gain_rows(self) -> Float[np.ndarray, "3 M"]:
        """Ones."""
        return np.ones((3, 1))


class WhiteBalances(Deviations):
    """Log gains of the channels of each view against its exposure, along `CHROMATICITIES`."""

    name = "white balances"
    size = 2
    unit, scale = "stops", 1 / math.log(2)
    floor = 0.005

    def gain_rows(self) -> Float[np.ndarray, "3 M"]:
        """The directions."""
        return CHROMATICITIES.T


class Walls(Block):
    """κ = 1/D: how near the walls are that the object mirrors, beside what is known of them (inverse radii)."""

    name = "walls"
    by_view = False
    unit = "1/radius"
    floor = 0.001

    def stepped(self, step: Float[np.ndarray, "1 1"]) -> "Walls":
        """No farther than infinitely far."""
        return replace(self, values=np.maximum(self.values + step, 0.0))

    def around(self, known: Surroundings) -> Surroundings:
        """Surroundings with those walls."""
        near = known.with_degree(max(known.degree, 0))
        return near.after_walls(np.pad(self.values[0], (0, len(near.coefficients) - 1)))


class MaskOffset(Block):
    """δ (px): by how much all masks are too large."""

    name = "mask offset"
    by_view = False
    unit = "px"
    floor = 0.05
    moves_silhouettes = True


class MaskOffsets(Deviations):
    """By how much the mask of each view is too large (px), beside what all masks share."""

    name = "mask offsets"
    unit = "px"
    floor = 0.05
    moves_silhouettes = True


BLOCKS: tuple[type[Block], ...] = (
    FocalLength,
    Distortion,
    CameraPoses,
    Exposures,
    WhiteBalances,
    Walls,
    MaskOffset,
    MaskOffsets,
)
"""All kinds, in the order in which they move rays."""


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

    @property
    def locked(self) -> "Nuisance":
        """With those free that differ by view, and no others: what all views share is known by a fine map alone."""
        return self.freed([each.name for each in self.free_blocks(by_view=True)])

    def without(self, names: Collection[str]) -> "Nuisance":
        """With blocks at the means of their priors: they are gone."""
        left = Nuisance(tuple(each for each in self.blocks if each.name not in names))
        return left.freed(self.free)

    def without_common(self, cameras: StatedCameras) -> "Nuisance":
        """With poses in a world without what moves all cameras alike, of which damped steps leave some."""
        found = self.get(CameraPoses)
        if found is None:
            return self
        _, poses = found.poses.without_common(cameras, found.precision)
        return self.replaced([replace(found, values=poses.stacked)])

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
        """What is known of the surroundings, with the walls where these are an unknown."""
        walls = self.get(Walls)
        return known if walls is None else walls.around(known)

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
        return sum(float(np.einsum("bi,bij,bj", each.values, each.precision, each.values)) for each in self.blocks) / 2


NO_NUISANCE = Nuisance()


def block_diagonal(parts: Sequence[Float[np.ndarray, "B _ _"]]) -> Float[np.ndarray, "B M M"]:
    """Matrices of each group along the diagonal of one."""
    ends = np.cumsum([0, *(each.shape[1] for each in parts)])
    joined = np.zeros((len(parts[0]), ends[-1], ends[-1]))
    for each, first, last in zip(parts, ends[:-1], ends[1:], strict=True):
        joined[:, first:last, first:last] = each
    return joined


TURN_DEG, SHIFT = 0.5, 0.005
"""Standard deviations of a camera's turn and shift (radii of the object), where a dataset states none."""
STATED_FLOOR = 0.1
"""Share of both that is added, in squares, to a stated covariance: an adjustment knows of noise alone."""
SIGMAS: dict[type[Block], float] = {
    FocalLength: 0.02,
    Distortion: 0.1,
    Exposures: 0.2,
    WhiteBalances: 0.1,
    Walls: 0.1,
    MaskOffset: 1.0,
    MaskOffsets: 1.0,
}
"""Standard deviations of the other blocks: of log focal length, k₁, log gains, 1/D, and pixels."""


def nuisance_of(views: Views, kinds: Collection[type[Block]] = BLOCKS) -> Nuisance:
    """Blocks of those kinds at their priors, all free."""
    count = len(views.train)
    prior = StatedCameras.of(views).prior(math.radians(TURN_DEG), SHIFT, STATED_FLOOR)
    blocks = tuple(
        kind(np.zeros((count, 6)), prior)
        if kind is CameraPoses
        else kind.at_prior(count if kind.by_view else 1, SIGMAS[kind])
        for kind in BLOCKS
        if kind in kinds
    )
    return Nuisance(blocks, tuple(each.name for each in blocks))
