"""What places of a surface that is no even mirror mirror and scatter, measured with each step as trust is.

A pixel that sees the place x shows

c = (s + (1 − s)(1 − cos θ)⁵) E + d,

with the mirrored share s(x), the scattered radiance d(x) and the light E of the mirrored direction. So (c − d)/s is
what a perfect mirror would have shown, and its residual counts s times as much.

Light and material are known up to E → a E + b. The gauge: the best mirrors of the surface are perfect, and scatter
nothing.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from panoless.environment.material_field import MaterialField, MaterialPixels
from panoless.problem.observations import is_saturated

if TYPE_CHECKING:
    from panoless.geometry.free_form.photometric import Linearization

LEAST_SHARE = 0.03
"""Mirrored share below which a channel of a pixel shows nothing of the surroundings."""
PIXELS = 60_000
"""About so many pixels at most determine the material."""
CELLS = 40
"""Cells along a side of the lattice."""
BEST = 90.0
"""Percentile of the mirrored shares of pixels from which they are those of the best mirrors."""


@dataclass(frozen=True)
class Material:
    """s and d over places in the normalized frame."""

    field: MaterialField

    def at(
        self, points: Float[np.ndarray, "P 3"], facing: Float[np.ndarray, "P"]
    ) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
        """Mirrored share and scattered radiance of pixels that see points, where cos θ is `facing`."""
        share, scattered = self.field.at(points)
        share = np.clip(1 + share, 0.0, 1.0)
        return share + (1 - share) * (1 - np.clip(facing, 0, 1))[:, None] ** 5, scattered

    def mirrored(
        self,
        radiance: Float[np.ndarray, "P 3"],
        points: Float[np.ndarray, "P 3"],
        facing: Float[np.ndarray, "P"],
    ) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
        """What a perfect mirror would have shown, and the share by which a residual of that counts."""
        share, scattered = self.at(points, facing)
        shown = share > LEAST_SHARE
        return np.where(shown, radiance - scattered, 0.0) / np.maximum(share, LEAST_SHARE), share * shown


EVEN = Material(MaterialField(CELLS, np.zeros(1, np.int64), np.zeros((1, 3)), np.zeros((1, 3))))
"""A perfect mirror everywhere."""


def measured_material(linearization: "Linearization") -> Material:
    """By the light of the map that a linearization has; a perfect mirror where no pixel sees the surroundings."""
    chosen = np.flatnonzero(linearization.free > 0)
    if not len(chosen):
        return EVEN
    chosen = chosen[:: -(-len(chosen) // PIXELS)]
    points, light = linearization.points[chosen], linearization.light[chosen]
    radiance, facing = linearization.radiance[chosen], linearization.facing[chosen]
    pale = 1 - (1 - np.clip(facing, 0, 1))[:, None] ** 5
    shown = linearization.light_shown[chosen]
    brighter = is_saturated(linearization.task.pixels.radiance)[chosen] & (shown > radiance)
    pixels = MaterialPixels.of(points, CELLS)
    found = pixels.fitted(light * pale, np.where(brighter, shown, radiance) - light)
    share, scattered = found.at(points)
    share = 1 + share
    mean = share.mean(1)
    best = mean >= np.percentile(mean, BEST)
    whole, most = 1 + found.share, np.maximum(np.median(share[best], axis=0), LEAST_SHARE)
    # With E = (F − d₀)/s₀ of the best mirrors, c = s F/s₀ + d − s d₀/s₀.
    shift = np.median(scattered[best] / np.maximum(share[best], LEAST_SHARE), axis=0)
    return Material(replace(found, share=whole / most - 1, scattered=np.maximum(found.scattered - whole * shift, 0.0)))
