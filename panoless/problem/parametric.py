"""What a surface of few numbers states of rays: where they meet it, where they touch it, and all first derivatives."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, cast, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.environment.surroundings import Surroundings
from panoless.problem.rays import PixelRays
from shinypartial.core.camera import Similarity

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

LEAST_COSINE = 0.12
"""Cosine of the angle of incidence from which a ray is of use."""


@dataclass(frozen=True)
class MirrorHits:
    """Where rays meet a mirror (normalized frame), and how the normal changes there.

    At a fixed ray the normal changes by `rows` times the numbers of the surface in `columns`; along the surface by the
    shape operator, dn = S dx.
    """

    clear: Bool[np.ndarray, "P"]
    """Whether a ray sees the surroundings at a useful angle."""
    distance: Float[np.ndarray, "P"]
    points: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]
    """Unit; of either sign."""
    shape: Float[np.ndarray, "P 3 3"]
    rows: Float[np.ndarray, "P 3 K"]
    columns: Int[np.ndarray, "P K"]


@dataclass(frozen=True)
class Silhouette:
    """By how many pixels rays pass outside of the silhouette of a surface."""

    pixels: Float[np.ndarray, "S"]
    weights: Float[np.ndarray, "S"]
    """Precisions over that of a contour point; 0 where the derivatives are not known."""
    valid: Bool[np.ndarray, "S"]
    """Whether there is a distance at all."""
    jacobian: "csr_matrix"
    """Derivatives by the numbers of the surface, S rows."""
    by_motion: Float[np.ndarray, "S 6"]
    """By a turn ω (rad) and a shift τ (normalized frame) of the ray."""


def motion_rows(
    by_shift: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "S 3"], distance: Float[np.ndarray, "S"]
) -> Float[np.ndarray, "S 6"]:
    """w·(τ + t ω × d) by (ω, τ): what a point at the distance t of a ray d does with the derivative w by its shift."""
    return np.concatenate([np.cross(directions, distance[:, None] * by_shift), by_shift], 1)


@dataclass(frozen=True)
class Regularization:
    """½ vᵀ E v beside the data, with v the `value` and its change; without a value it only damps steps."""

    matrix: Float[np.ndarray, "D D"]
    value: Float[np.ndarray, "D"] | None = None


@dataclass(frozen=True)
class StepLimit:
    """Most that a step may change some of the numbers."""

    largest: float = np.inf
    limited: slice = field(default_factory=lambda: slice(None))


@runtime_checkable
class ParametricSurface(Protocol):
    """A surface of D numbers, which is immutable. A kind inherits what it does not say otherwise."""

    @property
    def surroundings(self) -> Surroundings:
        """What it mirrors."""
        return cast(Surroundings, self.shape.surroundings)

    @property
    def count(self) -> int:
        """D."""
        ...

    @property
    def limit(self) -> StepLimit:
        """Of a step: a fifth, in radii of the object or radians, of every number."""
        return StepLimit(0.2, slice(self.count))

    @property
    def unseen(self) -> Float[np.ndarray, "D U"] | None:
        """Orthonormal changes that photographs under a coarse map do not determine; None where there are none."""
        return None

    @property
    def walls_error(self) -> float:
        """Standard deviation of 1/D of walls (inverse radii) that errors of its bend amount to: none."""
        return 0.0

    def hits(self, rays: PixelRays) -> MirrorHits:
        """Where rays meet it."""
        ...

    def silhouette(self, rays: PixelRays) -> Silhouette:
        """How far rays pass outside."""
        ...

    def regularization(self, matrix: Float[np.ndarray, "D D"]) -> Regularization:
        """What stands beside data of that normal matrix: nothing."""
        return Regularization(np.zeros_like(matrix))

    def stepped(self, step: Float[np.ndarray, "D"]) -> "ParametricSurface":
        """After a step of its numbers."""
        ...

    def taken_back(self, common: Similarity) -> "ParametricSurface":
        """As it is in the world from which that motion of all cameras was taken back."""
        ...

    def settled(self) -> "ParametricSurface":
        """The same surface, sampled evenly, before a round; itself where the kind has no samples."""
        return self

    def refined(self) -> "ParametricSurface":
        """The same surface with more numbers; itself where the kind has no more."""
        return self

    @property
    def shape(self) -> Any:
        """As proposals of the kind have it."""
        ...
