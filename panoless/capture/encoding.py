"""How the radiance of pixels is encoded for a fit, and that of its map decoded after it."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.config import FitConfig
from shinypartial.core.color import linear_to_srgb, srgb_to_linear
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Frame, View

NO_TINT = (1.0, 1.0, 1.0)
LEAST_ALPHA = 1e-6
"""Premultiplied radiance is divided by alpha, but at least by this."""
SATURATED = 0.998
"""Of the largest value, from which a pixel is saturated: below the last step of 8-bit sRGB, 0.991, none is."""


@dataclass(frozen=True)
class RadianceEncoding:
    """Encoding c ↦ f(c/F) of the radiance c of a mirror with the tint F, so that residuals mean the same everywhere.

    With a low dynamic range c is clipped to [0, 1], as photographs are, and f(x) = x. With a high one f(x) = x up to 1
    and 1 + ln x above: below 1 a fit works as ever, above it a residual is a relative one. f is increasing with a
    continuous derivative, f(x) ≤ x.
    """

    high_dynamic_range: bool = False
    tint: tuple[float, float, float] = NO_TINT
    srgb: bool = False
    """f is the curve of sRGB instead: values as they stand in an 8-bit image, in which other methods compute."""
    exposure: float = 1.0
    """By which views of a low dynamic range were multiplied after they were encoded: saturation knows of it, while
    `encoded` and `decoded` do not."""

    def clipped(self, frame: Frame, view: View) -> Float[np.ndarray, "H W 3"]:
        """Radiance of a view, not encoded, without what its range excludes.

        Raises InputError when a high dynamic range is requested of an 8-bit image.
        """
        if self.high_dynamic_range and not view.high_dynamic_range:
            raise InputError(
                expected=f"radiance above 1 for --config.environment.range hdr: an EXR of {frame.name}",
                found="an 8-bit image",
                remedy="Leave the option out, or add the EXR images.",
            )
        return np.clip(view.radiance, 0, None if self.high_dynamic_range else 1)

    def encoded(
        self, radiance: Float[np.ndarray, "H W 3"], alpha: Float[np.ndarray, "H W"] | float = 1.0
    ) -> Float[np.ndarray, "H W 3"]:
        """f(c/F). With sRGB α f(c/(α F)) of radiance c that is premultiplied by alpha, as such an image holds it."""
        if self.tint != NO_TINT:
            radiance = radiance / np.array(self.tint, radiance.dtype)
        if self.srgb:
            share = np.asarray(alpha, radiance.dtype)[..., None]
            return share * linear_to_srgb((radiance / np.maximum(share, LEAST_ALPHA)).clip(0, 1))
        if not self.high_dynamic_range:
            return radiance
        return np.where(radiance > 1, 1 + np.log(np.maximum(radiance, 1)), radiance)

    def without_gain(self, encoded: Float[Tensor, "3 *S"], gain: float | Tensor) -> Float[Tensor, "3 *S"]:
        """c/g, at most the saturation, of an encoded photograph c that was exposed g times as long as others, in a low
        dynamic range; a gain may differ from pixel to pixel.

        What is saturated stays so: it may be any brighter.
        """
        largest = self.saturation.to(encoded).reshape(3, *[1] * (encoded.ndim - 1))
        return torch.where(encoded >= SATURATED * largest, largest, torch.minimum(encoded / gain, largest))

    @property
    def saturation(self) -> Float[Tensor, "3"]:
        """The largest encoded radiance that a view can show: 1/F times its exposure, or ∞ with a high dynamic range."""
        return torch.full((3,), math.inf) if self.high_dynamic_range else self.exposure / torch.tensor(self.tint)

    def shown(self, radiance: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
        """f of radiance in [0, 1] of a mirror without tint; without a gradient."""
        return torch.from_numpy(linear_to_srgb(radiance.cpu().numpy())).to(radiance) if self.srgb else radiance

    def decoded(self, environment: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
        """f⁻¹ of a map: the radiance of the environment itself, before any mirror."""
        if self.srgb:
            return torch.from_numpy(srgb_to_linear(environment.cpu().numpy())).to(environment)
        if not self.high_dynamic_range:
            return environment
        return torch.where(environment > 1, torch.exp(environment.clamp(min=1) - 1), environment)


#: Photographs in a mirror without color.
LDR = RadianceEncoding()


def encoding_of(config: FitConfig) -> RadianceEncoding:
    """The encoding that a configuration requires."""
    high, srgb = config.environment.range == "hdr", config.splats.surfels.shading != "mirror"
    return RadianceEncoding(high, config.tint, srgb, config.exposure or 1.0)
