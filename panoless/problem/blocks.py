"""Kinds of unknowns beside the surface and the map: cameras, their lens, exposures, and how far masks are off.

A block has B groups of M numbers, one group a view or one of all views, with a normal prior of mean zero. It states how
rays, radiance and silhouettes change with it. A ray is moved by a turn ω (rad, world axes) and a shift τ (normalized
frame), so a surface needs the derivatives by these two alone.
"""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import numpy as np
from jaxtyping import Float, Int

from panoless.capture.lens import LensChange
from panoless.capture.poses import Poses, StatedCameras
from panoless.capture.views import Views
from panoless.environment.surroundings import FLOOR_UNKNOWNS, SHARPEST, Floor, Surroundings
from panoless.problem.rays import PixelRays

CHROMATICITIES = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, -2.0]]) / np.sqrt([[2.0], [6.0]])
"""Orthonormal directions of log gains of the channels that leave their mean."""
TURN_DEG, SHIFT = 0.5, 0.005
"""Standard deviations of a camera's turn and shift (radii of the object), where a dataset states none."""
STATED_FLOOR = 0.1
"""Share of both that is added, in squares, to a stated covariance: an adjustment knows of noise alone."""
SURROUNDINGS_RESOLUTION = 16
"""Texels along a face side from which near walls and a floor are free."""
AnyBlock = TypeVar("AnyBlock", bound="Block")


@dataclass(frozen=True)
class Block:
    """Unknowns of one kind."""

    name: ClassVar[str]
    by_view: ClassVar[bool] = True
    count: ClassVar[int] = 1
    unit: ClassVar[str] = ""
    scale: ClassVar[float] = 1.0
    """Of a number of the block, in that unit."""
    model_error: ClassVar[float] = 0.0
    """Standard deviation of an unknown by errors of surface, map and masks, which noise does not show."""
    sigma: ClassVar[float] = 1.0
    """Standard deviation of the prior of an unknown."""
    most_deviations: ClassVar[float] = math.inf
    """Root mean square of its unknowns, in standard deviations of the prior, above which something else is wrong."""
    moves_silhouettes: ClassVar[bool] = False
    """Whether its numbers are pixels by which silhouettes of masks lie outside of those of the object."""
    values: Float[np.ndarray, "B M"]
    precision: Float[np.ndarray, "B M M"]
    """Inverse covariances of the prior."""

    @property
    def surroundings_columns(self) -> slice | None:
        """Its columns of `Surroundings.rows`; None: it is no part of the surroundings."""
        return None

    @property
    def least_resolution(self) -> int | None:
        """Texels along a face side of the coarsest map that determines it where it is one of all views; None: a fine
        one alone does.
        """
        return None

    @property
    def rms(self) -> float:
        """Root mean square of the unknowns that have the unit."""
        return self.scale * float(np.sqrt((self.values[:, self.measured] ** 2).mean()))

    @property
    def from_prior(self) -> float:
        """Σ xᵀ P x."""
        return float(np.einsum("bi,bij,bj", self.values, self.precision, self.values))

    @property
    def size(self) -> int:
        """M."""
        return self.values.shape[1]

    @property
    def floor(self) -> Float[np.ndarray, "M"]:
        """`model_error` in the units of the unknowns of a group."""
        return np.full(self.size, self.model_error)

    def with_model_errors(self, variances: Float[np.ndarray, "B M"]) -> Float[np.ndarray, "B M"]:
        """Posterior variances with those of model errors."""
        return np.asarray(variances + self.floor**2)

    @property
    def measured(self) -> slice:
        """Those of a group that have the unit."""
        return slice(None)

    @classmethod
    def at_prior(cls: type[AnyBlock], groups: int, sigma: float | None = None) -> AnyBlock:
        """At the mean of the prior, with its standard deviation or another one."""
        precision = np.eye(cls.count) / (cls.sigma if sigma is None else sigma) ** 2
        return cls(np.zeros((groups, cls.count)), np.tile(precision, (groups, 1, 1)))

    @classmethod
    def of(cls: type[AnyBlock], views: Views, around: Surroundings) -> AnyBlock | None:
        """As it starts, of views of an object in proposed surroundings; None where it has no meaning."""
        return cls.at_prior(len(views.train) if cls.by_view else 1)

    def joined(self: AnyBlock, other: AnyBlock, order: Int[np.ndarray, "B"]) -> AnyBlock:
        """Groups of both, in an order."""
        values, precision = (
            np.concatenate([getattr(self, name), getattr(other, name)])[order] for name in ("values", "precision")
        )
        return replace(self, values=values, precision=precision)

    def stepped(self: AnyBlock, step: Float[np.ndarray, "B M"]) -> AnyBlock:
        """Changed by a step."""
        return replace(self, values=self.values + step)

    def around(self, known: Surroundings) -> Surroundings:
        """Surroundings with the block's part of them."""
        return known

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
    """An unknown of the lens of all views, for which lenses are made within five standard deviations of its prior."""

    by_view = False
    most_deviations = 5.0

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
    model_error = 0.002
    sigma = 0.02

    @classmethod
    def of(cls, views: Views, around: Surroundings) -> "FocalLength":
        """As stated, and as far as that is known."""
        stated = views.focal_sigma
        return cls.at_prior(1, None if stated is None else math.hypot(stated, cls.model_error))

    @property
    def lens(self) -> LensChange:
        """Of that focal length."""
        return LensChange(focal=float(self.values[0, 0]))


class Distortion(Lens):
    """k₁ of the radial distortion of all views."""

    name = "distortion"
    model_error = 0.01
    sigma = 0.1

    @property
    def lens(self) -> LensChange:
        """Of that distortion."""
        return LensChange(k1=float(self.values[0, 0]))


@dataclass(frozen=True)
class CameraPoses(Block):
    """Turns (rad, world axes) and shifts (normalized frame) of the cameras against what is stated."""

    name = "poses"
    count = 6
    unit, scale = "°", 180 / math.pi
    model_error = 0.2
    """In pixels: the standard deviation of contours, whose errors in a view are alike."""
    pixel: tuple[float, float] = (0.0, 0.0)
    """Turn (rad) and shift (normalized frame) by which the object moves by a pixel: medians over views."""

    @classmethod
    def of(cls, views: Views, around: Surroundings) -> "CameraPoses":
        """As they are stated."""
        cameras = StatedCameras.of(views)
        prior = cameras.prior(math.radians(TURN_DEG), SHIFT, STATED_FLOOR)
        pixel = float(np.median([1 / view.camera.fx for view in views.train]))
        distance = float(np.median(np.linalg.norm(cameras.centers, axis=1)))
        return cls(np.zeros((len(prior), cls.count)), prior, (pixel, pixel * distance))

    @property
    def floor(self) -> Float[np.ndarray, "6"]:
        """Of turns and of shifts."""
        return self.model_error * np.repeat(self.pixel, 3)

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
    model_error = 0.005
    sigma = 0.2

    def gain_rows(self) -> Float[np.ndarray, "3 M"]:
        """Ones."""
        return np.ones((3, 1))


class WhiteBalances(Deviations):
    """Log gains of the channels of each view against its exposure, along `CHROMATICITIES`."""

    name = "white balances"
    count = 2
    unit, scale = "stops", 1 / math.log(2)
    model_error = 0.005
    sigma = 0.1

    def gain_rows(self) -> Float[np.ndarray, "3 M"]:
        """The directions."""
        return CHROMATICITIES.T


class Walls(Block):
    """How near the walls are that the object mirrors: the coefficients of 1/D (inverse radii), one for a sphere."""

    name = "walls"
    by_view = False
    unit = "1/radius"
    model_error = 0.0015
    sigma = 0.1

    @classmethod
    def of(cls, views: Views, around: Surroundings) -> "Walls":
        """As they are proposed, or infinitely far."""
        return cls.about(around)

    @classmethod
    def about(cls, around: Surroundings) -> "Walls":
        """Those of surroundings."""
        values = around.coefficients if len(around.coefficients) else np.zeros(1)
        return cls(values[None], np.eye(len(values))[None] / cls.sigma**2)

    @property
    def least_resolution(self) -> int | None:
        """Walls that are near already; those that are far look like a longer lens."""
        return SURROUNDINGS_RESOLUTION if self.values.any() else None

    @property
    def surroundings_columns(self) -> slice:
        """The first."""
        return slice(self.size)

    def stepped(self, step: Float[np.ndarray, "1 M"]) -> "Walls":
        """In the mean neither farther than infinitely far nor nearer than the object."""
        values = self.values + step
        values[:, 0] = np.clip(values[:, 0], 0.0, SHARPEST)
        return replace(self, values=values)

    def around(self, known: Surroundings) -> Surroundings:
        """With these walls."""
        return replace(known, coefficients=self.values[0])


@dataclass(frozen=True)
class Ground(Block):
    """How the floor below the object differs from the proposed one: two tilts (rad), then its depth (radii)."""

    name = "ground"
    by_view = False
    count = FLOOR_UNKNOWNS
    unit = "radii"
    model_error = 0.01
    sigma = 0.1
    stated_sigma: ClassVar[float] = 0.005
    """The same where photographs of the ground state it."""
    floor_now: Floor

    @classmethod
    def of(cls, views: Views, around: Surroundings) -> "Ground | None":
        """As proposed; None where there is no floor."""
        if around.floor is None:
            return None
        sigma = cls.sigma if views.ground is None else cls.stated_sigma
        return cls(np.zeros((1, cls.count)), np.eye(cls.count)[None] / sigma**2, around.floor)

    @property
    def surroundings_columns(self) -> slice:
        """The last."""
        return slice(-FLOOR_UNKNOWNS, None)

    @property
    def least_resolution(self) -> int:
        """As near walls."""
        return SURROUNDINGS_RESOLUTION

    @property
    def rms(self) -> float:
        """The depth."""
        return self.floor_now.depth

    @property
    def measured(self) -> slice:
        """The depth."""
        return slice(2, 3)

    def stepped(self, step: Float[np.ndarray, "1 3"]) -> "Ground":
        """Tilted about its foot, and moved."""
        return replace(self, values=self.values + step, floor_now=self.floor_now.after(step[0]))

    def around(self, known: Surroundings) -> Surroundings:
        """With this floor."""
        return replace(known, floor=self.floor_now)


class MaskOffset(Block):
    """δ (px): by how much all masks are too large."""

    name = "mask offset"
    by_view = False
    unit = "px"
    model_error = 0.05
    moves_silhouettes = True


class MaskOffsets(Deviations):
    """By how much the mask of each view is too large (px), beside what all masks share."""

    name = "mask offsets"
    unit = "px"
    model_error = 0.05
    moves_silhouettes = True


BLOCKS: tuple[type[Block], ...] = (
    FocalLength,
    Distortion,
    CameraPoses,
    Exposures,
    WhiteBalances,
    Walls,
    Ground,
    MaskOffset,
    MaskOffsets,
)
"""All kinds, in the order in which they move rays."""
