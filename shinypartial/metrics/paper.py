"""Protocol paper-v1: the steps of the published tables as far as they are known, for comparison with them only.

Tone-mapped 8-bit pictures, full frame, every texel and pixel alike; normals where the prediction claims the object.
Nothing here corrects for solid angle, coverage or holes, so no other claim should rest on these numbers.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.color import linear_to_srgb
from shinypartial.metrics.angular import angular_statistics
from shinypartial.metrics.environment import to_protocol_size
from shinypartial.metrics.image import l1, psnr, ssim

PAPER_PROTOCOL = "paper-v1"
#: Maps are compared at 512 × 1024.
PAPER_HEIGHT = 512
#: The prediction claims a pixel with this much alpha.
CLAIMED_ALPHA = 0.5

Image = Float[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class PaperEnvironment:
    """Environment maps as tone-mapped 8-bit pictures."""

    psnr_reinhard: float
    ssim_reinhard: float
    l1_reinhard: float
    lpips_alex: float | None


@dataclass(frozen=True)
class PaperNormals:
    """Angular errors pooled over the pixels that the prediction claims and the truth knows; holes don't count."""

    mean_angular_error_deg: float
    median_angular_error_deg: float
    rmse_angular_error_deg: float
    fraction_within_5deg: float
    fraction_within_11_25deg: float
    fraction_within_22_5deg: float


@dataclass(frozen=True)
class PaperRender:
    """8-bit sRGB renders on black, full frame: means over views."""

    psnr: float
    ssim: float
    l1: float


@dataclass(frozen=True)
class PaperScores:
    """All groups of the protocol; None for a group that dataset or prediction lacks."""

    protocol: str
    environment: PaperEnvironment | None
    normals: PaperNormals | None
    render: PaperRender | None


@dataclass(frozen=True)
class PaperView:
    """What one test view adds."""

    render: PaperRender
    normal_errors: Float[np.ndarray, "P"] | None


def eight_bit(image: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Values in [0, 1] as an 8-bit picture stores them."""
    return (np.rint(np.clip(image, 0, 1) * 255) / 255).astype(np.float32)


def reinhard_picture(radiance: Float[np.ndarray, "_H _W 3"]) -> Float[np.ndarray, "h w 3"]:
    """8-bit sRGB of L/(1 + L) per channel (Reinhard et al. 2002, simple operator), at the size of the protocol."""
    positive = np.maximum(radiance, 0)
    return eight_bit(linear_to_srgb(to_protocol_size(positive / (1 + positive), PAPER_HEIGHT)))


def paper_environment(prediction: Image, truth: Image, lpips_alex: float | None) -> PaperEnvironment:
    """Compare two pictures that `reinhard_picture` made."""
    return PaperEnvironment(
        psnr(prediction, truth, data_range=1.0), ssim(prediction, truth), l1(prediction, truth), lpips_alex
    )


def paper_render(prediction: Image, truth: Image) -> PaperRender:
    """Compare two sRGB renders in [0, 1] after rounding them to 8 bits."""
    pair = eight_bit(prediction), eight_bit(truth)
    return PaperRender(psnr(*pair, data_range=1.0), ssim(*pair), l1(*pair))


def claimed_mask(
    predicted_alpha: Float[np.ndarray, "H W"], predicted_normals: Image, true_normals: Image
) -> Bool[np.ndarray, "H W"]:
    """Pixels that the prediction claims, where both have a normal."""
    present = [np.linalg.norm(normals, axis=-1) > 0.5 for normals in (predicted_normals, true_normals)]
    return (predicted_alpha > CLAIMED_ALPHA) & present[0] & present[1]


def pool_paper(environment: PaperEnvironment | None, views: list[PaperView]) -> PaperScores:
    """The protocol's scores from those of the environment and of all test views."""
    errors = [view.normal_errors for view in views if view.normal_errors is not None]
    pooled = np.concatenate(errors) if errors else np.zeros(0, np.float32)
    normals = None
    if pooled.size:
        statistics = vars(angular_statistics(pooled))
        normals = PaperNormals(**{name: statistics[name] for name in PaperNormals.__dataclass_fields__})
    render = None
    if views:
        means = (float(np.mean([getattr(view.render, name) for view in views])) for name in ("psnr", "ssim", "l1"))
        render = PaperRender(*means)
    return PaperScores(PAPER_PROTOCOL, environment, normals, render)
