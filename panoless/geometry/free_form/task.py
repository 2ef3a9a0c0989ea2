"""What one round of steps is solved for: pixels and silhouettes with their weights."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from panoless.capture.poses import StatedCameras
from panoless.capture.views import Views
from panoless.geometry.free_form.material import Material
from panoless.geometry.free_form.schedule import SILHOUETTE_GAIN, Round
from panoless.problem.blocks import Exposures, WhiteBalances
from panoless.problem.nuisance import NO_NUISANCE, Nuisance
from panoless.problem.observations import Pixels, background_rays, is_saturated, silhouette_rays, solid_pixels
from panoless.problem.rays import PixelRays

COUNTED_RAYS = 100_000.0
"""The photographs weigh as much as so many pixels, however many take part."""
RADIANCE_SIGMA = 0.02
"""Standard deviation of a pixel of mean brightness (linear radiance)."""
SILHOUETTE_SIGMA_PX = 0.15
"""Standard deviation of a silhouette's point."""
LEAST_BRIGHTNESS = 1e-6
"""Photographs that are black count as this bright (linear radiance)."""
MAP_ROUNDS = 2
"""Robust rounds of the map after each step."""
TEXEL_PRIOR = 0.5
"""Rays of zero residual in the mean of a texel."""
KNOWN = 1e9
"""The same under which the map stays."""


@dataclass(frozen=True)
class Task:
    """What one round of steps is solved for."""

    pixels: Pixels
    silhouettes: PixelRays
    background: PixelRays
    """Of pixels outside of the masks."""
    photograph_weight: float
    """Of a pixel, in units of 1/σ²."""
    silhouette_weight: float
    """Of a silhouette's point."""
    settings: Round
    cameras: StatedCameras
    """Of all views."""
    brightness: float
    """Mean over all pixels and channels (linear radiance)."""
    views: Views
    """For what is seen past the object."""
    reference: Float[np.ndarray, "A B C"] | None = None
    """Coefficients the change from which is to be smooth; None: the surface is."""
    prior_factor: float = 1.0
    """Of the precision of nuisance blocks, in whose units pixels count more than they are worth."""
    material: Material | None = None
    """What places mirror and scatter; None: they are perfect mirrors."""

    @property
    def map_rounds(self) -> int:
        """Robust rounds of the map after each step."""
        return 0 if self.settings.under_known_map else MAP_ROUNDS

    @property
    def texel_prior(self) -> float:
        """Rays of zero residual in the mean of a texel."""
        return KNOWN if self.settings.under_known_map else TEXEL_PRIOR

    def with_silhouette_gain(self, gain: float) -> "Task":
        """The same with another factor of the silhouettes' weight."""
        settings = replace(self.settings, silhouette_gain=gain)
        return replace(
            self, settings=settings, silhouette_weight=self.silhouette_weight * gain / self.settings.silhouette_gain
        )


def make_task(
    views: Views, settings: Round, nuisance: Nuisance = NO_NUISANCE, material: Material | None = None
) -> Task:
    """The pixels and silhouettes of a round, weighted as if `COUNTED_RAYS` pixels took part.

    Under coarse maps pixels are wrong by the robust scale s, not by their noise σ: where silhouettes dominate, they
    count (s/σ)² times as much.
    """
    pixels, silhouettes = solid_pixels(views, settings.rays), silhouette_rays(views)
    total = max(views.num_solid, 1)
    chosen = silhouettes.chosen(slice(None, None, max(1, -(-len(silhouettes.size) // settings.silhouette_points))))
    if material is None and {Exposures.name, WhiteBalances.name} & set(nuisance.free):
        # A saturated pixel has no radiance to divide by a gain.
        pixels = replace(pixels, inner_px=np.where(is_saturated(pixels.radiance).any(1), 0.0, pixels.inner_px))
    share = COUNTED_RAYS / RADIANCE_SIGMA**2 / max(len(pixels.inner_px), 1)
    density = COUNTED_RAYS / total * len(silhouettes.size) / max(len(chosen.size), 1)
    dominance = (settings.robust_scale / RADIANCE_SIGMA) ** 2 if settings.silhouette_dominated else 1.0
    of_silhouettes = settings.silhouette_gain * dominance * density / SILHOUETTE_SIGMA_PX**2
    # Where masks are stated as rough, no gain takes them for right.
    of_silhouettes /= 1 + SILHOUETTE_GAIN * (views.mask_sigma_px / SILHOUETTE_SIGMA_PX) ** 2
    brightness = max(float(pixels.radiance.mean()), LEAST_BRIGHTNESS)
    background = background_rays(views, settings.rays)
    cameras = StatedCameras.of(views)
    return Task(
        pixels, chosen, background, share, of_silhouettes, settings, cameras, brightness, views, material=material
    )
