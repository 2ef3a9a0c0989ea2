"""The rounds of a free-form surface's fit: grids and maps from coarse to fine."""

from dataclasses import dataclass, replace
from typing import Literal

from panoless.geometry.free_form.options import FreeFormOptions

COARSE_SCALE = 0.2
"""Robust scale above which a round is coarse."""
SILHOUETTE_GAIN = 9.0
"""Factor of the silhouettes' weight where they count as if they were right to 0.05 px, not 0.15 px."""


@dataclass(frozen=True)
class Round:
    """Gauss–Newton steps on one grid and one map."""

    cells: int
    """Cells along the longest side of the box, of which the object takes about three quarters."""
    resolution: int
    """Texels along a face side of the map."""
    robust_scale: float
    """Residual (linear radiance) beyond which a pixel loses its weight."""
    samples: Literal[1, 4]
    """Mirrored rays over a pixel, 1 or 4."""
    rays: int
    """About so many pixels of all views take part."""
    smoothing: float
    """Weight λ of the integral of |D³φ|² in the normalized frame, against `COUNTED_RAYS` pixels."""
    steps: int
    """Most steps."""
    increment_prior: bool = False
    """Whether the change of the surface is to be smooth, in place of the surface: details that it has then stay."""
    silhouette_dominated: bool = False
    """Whether pixels count as if their σ was the robust scale, which is what they err by under a coarse map."""
    silhouette_gain: float = 1.0
    """Factor of the silhouettes' weight."""
    silhouette_points: int = 30_000
    """Most silhouette points of all views."""
    solver_steps: int = 30
    """Most conjugate-gradient steps for a Gauss–Newton step."""
    under_known_map: bool = False
    """Whether the map stays as trusted pixels determine it, and the surface alone moves."""
    least_gain: float = 3e-3
    """The round ends when a step lowers the cost by less than this share."""

    @property
    def is_coarse(self) -> bool:
        """Whether rays may be far off: then all pixels count alike by how far theirs are, and what all views share
        stays, as its derivative under a coarse map has the wrong sign.
        """
        return self.robust_scale > COARSE_SCALE


DESCENT = tuple(
    Round(20, resolution, scale, 1, 8000, 3000.0, 5, increment_prior=True, silhouette_points=4000)
    for resolution, scale in ((3, 0.5), (4, 0.5), (6, 0.4), (8, 0.4), (12, 0.3))
)
"""From a first surface that is far off: under maps so coarse that a normal may be wrong by 20°."""
COARSE = (
    Round(20, 16, 0.30, 1, 16_000, 100.0, 5, silhouette_gain=SILHOUETTE_GAIN),
    Round(28, 64, 0.80, 4, 24_000, 30.0, 8, silhouette_gain=SILHOUETTE_GAIN),
    Round(28, 64, 0.15, 4, 32_000, 30.0, 4, solver_steps=20),
)
"""Always taken. The first texels are as wide as a ray turns when its normal does by 2.8°. In the second round nearly
all pixels keep their weight, so flat faces turn as fast as others. In the third a gain of silhouettes would hide that
masks are too small."""
CLOSING_RAYS = (20_000, 40_000, 40_000)
"""Pixels of these rounds where no finer one comes after them."""
FINER = (
    Round(42, 128, 0.10, 4, 40_000, 10.0, 5, solver_steps=20),
    Round(60, 128, 0.10, 4, 52_000, 3.0, 4, solver_steps=20),
)
"""Each taken if held-out views gain by the one before it. The last one that was is taken again with all views."""
CONCAVE = (
    Round(28, 16, 0.30, 1, 40_000, 30.0, 5),
    Round(28, 32, 0.20, 1, 40_000, 30.0, 5),
    Round(36, 32, 0.20, 1, 60_000, 30.0, 3),
    Round(36, 64, 0.15, 4, 80_000, 30.0, 4),
)
"""From a surface with concavities, in place of the coarse rounds: these would smooth a socket away."""
REFIT = (
    Round(28, 16, 0.80, 4, 40_000, 30.0, 6, under_known_map=True),
    Round(28, 16, 0.80, 4, 40_000, 30.0, 6, under_known_map=True),
    Round(28, 64, 0.80, 4, 40_000, 30.0, 6),
    Round(28, 64, 0.15, 4, 40_000, 30.0, 4),
)
"""Of parts of the surface that pixels distrust, as long as held-out views gain by it."""
DETAILED = (
    Round(60, 4, 0.80, 1, 20_000, 10.0, 6),
    Round(60, 8, 0.80, 1, 20_000, 10.0, 6),
    Round(60, 16, 0.50, 1, 40_000, 3.0, 6),
    Round(60, 32, 0.50, 4, 60_000, 1.0, 6),
    Round(84, 32, 0.20, 4, 100_000, 0.3, 5),
)
"""From the hull, in place of the rounds before, where these leave much unexplained: coarse grids and smoothing lose
what is thin, the normals of small details turn by far more than a texel, and their pixels mirror more than one."""
FINEST = (
    Round(120, 32, 0.30, 4, 160_000, 0.1, 5),
    Round(120, 64, 0.20, 4, 160_000, 0.1, 5),
    Round(160, 64, 0.20, 4, 240_000, 0.1, 4),
)
"""After these, each taken if held-out views gain by the one before it, down to cells as wide as pixels."""


@dataclass(frozen=True)
class Schedule:
    """The rounds of a fit; a part that is left out has none."""

    descent: tuple[Round, ...] = DESCENT
    coarse: tuple[Round, ...] = COARSE
    finer: tuple[Round, ...] = FINER
    concave: tuple[Round, ...] = CONCAVE
    refit: tuple[Round, ...] = REFIT
    detailed: tuple[Round, ...] = DETAILED
    finest: tuple[Round, ...] = FINEST

    @classmethod
    def of(cls, options: FreeFormOptions) -> "Schedule":
        """The rounds that options leave."""
        finer = _up_to(options.finest_cells, FINER)
        most = FINEST[-1].cells if finer == FINER else FINER[-1].cells
        pixels = [each.rays for each in COARSE] if finer else CLOSING_RAYS
        coarse = tuple(replace(each, rays=rays) for each, rays in zip(COARSE, pixels, strict=True))
        return cls(
            DESCENT if options.starts else (),
            _up_to(options.finest_cells, coarse) or coarse[:1],
            finer,
            CONCAVE if options.concavities else (),
            _up_to(options.finest_cells, REFIT),
            _up_to(most, DETAILED) if options.starts else (),
            _up_to(most, FINEST) if options.starts else (),
        )


def _up_to(cells: int, rounds: tuple[Round, ...]) -> tuple[Round, ...]:
    """The rounds on grids of at most so many cells."""
    return tuple(each for each in rounds if each.cells <= cells)
