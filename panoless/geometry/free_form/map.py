"""The map that a fit works with: weighted least squares of pixels as means of a few rays, from the one before."""

from jaxtyping import Float
from torch import Tensor

from panoless.environment.cubemap import by_face, by_texel
from panoless.environment.fill import fill_unobserved, texel_neighbors
from panoless.environment.footprints import PixelFootprints, splat
from panoless.numeric.conjugate_gradients import conjugate_gradients

SMOOTHNESS = 0.05
"""Weight λ of squared differences of neighboring texels, in rays."""
STEPS = 6
"""Conjugate-gradient steps of a robust round."""


def splatted_map(pixels: PixelFootprints, weights: Float[Tensor, "P"], resolution: int) -> Float[Tensor, "6 3 L L"]:
    """Each texel the mean of what fell on it, gaps filled."""
    light, total = splat(pixels, weights, resolution).split((3, 1), 1)
    return fill_unobserved(light / total.clamp(min=1e-9), total[:, 0])


def smoothed_map(
    environment: Float[Tensor, "6 3 L L"],
    pixels: PixelFootprints,
    weights: Float[Tensor, "P"],
) -> Float[Tensor, "6 3 L L"]:
    """min_E Σ w ‖mean_k E(ω_k) − c‖² + λ Σ ‖E_i − E_j‖² over neighboring texels: a few steps from a map on."""
    resolution = environment.shape[-1]
    of_pixels = pixels.normal_product(weights[:, None], resolution)
    around = texel_neighbors(resolution).to(environment.device)

    def differences(image: Tensor) -> Tensor:
        texels = by_texel(image)
        return by_face(4 * texels - texels[around].sum(0), resolution)

    def product(image: Tensor) -> Tensor:
        return of_pixels(image) + SMOOTHNESS * differences(image)

    light, total = splat(pixels, weights, resolution).split((3, 1), 1)
    diagonal = total + 4 * SMOOTHNESS
    found = conjugate_gradients(product, environment, light - product(environment), 1 / diagonal, STEPS)
    return found.clamp(min=0)
