"""Exposure and contrast: how much a difference of radiance counts, in photographs that are dark or mostly dark."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.views import Views

DARK = 0.2
"""Mean radiance of the object's pixels (linear) below which photographs are dark."""
BRIGHTNESS = 0.35
"""Mean radiance to which dark ones are exposed, all together."""
DARK_SHARE = 0.5
"""Share of the mean brightness below which a median one is dark."""
LARGEST_EXPOSURE = 100.0
"""More than so many times brighter nothing is made: darker photographs show noise."""
MEDIANS = 6.0
"""Radiance counts as it is up to the median brightness over this, and as its logarithm above."""
LEAST_KNEE = 0.002
"""But up to this at least (linear radiance), below which photographs show noise."""


@dataclass(frozen=True)
class Contrast:
    """Radiance c as ln(1 + c/k)/ln(1 + 1/k), which takes [0, 1] to itself; as it is where no knee k is given.

    Under a bright sky a dark ground has no weight in residuals of radiance, and what mirrors it gets no shape. As a
    logarithm it has the say that its contrast gives it.
    """

    knee: float | None = None

    @classmethod
    def of(cls, views: Views, *, least_knee: float = LEAST_KNEE) -> "Contrast":
        """What views require: logarithms where the median brightness of the object's pixels is far below the mean.

        The share of the two does not depend on the exposure, but for what that saturates.
        """
        brightness = _brightness(views)
        median = float(brightness.median()) if len(brightness) else 0.0
        if not len(brightness) or median >= DARK_SHARE * float(brightness.mean()):
            return cls()
        return cls(max(median / MEDIANS, least_knee))

    def shown(self, radiance: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
        """What stands for radiance; below 0 there is none."""
        if self.knee is None:
            return radiance
        return torch.log1p(radiance.clamp(min=0) / self.knee) / math.log1p(1 / self.knee)

    def applied(self, views: Views) -> Views:
        """The views with that contrast; themselves where it is that of radiance."""
        if self.knee is None:
            return views
        shown = (replace(view, radiance=self.shown(view.radiance)) for view in views.train)
        return replace(views, train=tuple(shown))


def _brightness(views: Views) -> Float[Tensor, "P"]:
    """Of all pixels of the object: means of channels."""
    return torch.cat([view.radiance_at(view.solid).mean(1) for view in views.train])


def exposure_of(views: Views, dark: float = DARK, brightness: float = BRIGHTNESS) -> float:
    """The factor that gives the object of dark photographs a mean brightness; 1 for others.

    These have a scale: the radiance at which they are saturated.
    """
    shown = _brightness(views)
    mean = float(shown.mean()) if len(shown) else 0.0
    return min(max(brightness / mean, 1.0), LARGEST_EXPOSURE) if 0 < mean < dark else 1.0


def exposed(views: Views, exposure: float) -> Views:
    """The views, that many times as bright, in a low dynamic range."""
    if exposure == 1:
        return views
    return replace(views, train=tuple(replace(view, radiance=exposure * view.radiance) for view in views.train))
