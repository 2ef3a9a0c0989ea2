"""What a rough surface shows of far surroundings by the split sum (Karis 2013): a blurred map times a share of light.

With the facets' distribution D of Trowbridge and Reitz, α = roughness², and Smith's shadowing G in Schlick's form,
k = α/2,

    ∫ L f cos θ dω ≈ P(r, roughness) · (F₀ A(cos θ, roughness) + B(cos θ, roughness)),

r the mirrored direction. P is what the lobe seen from the front shows of the map (see `panoless.environment.lobe`), and
(A, B) are the integrals of (1 − s) w and s w over the hemisphere, w = f cos θ / F and s = (1 − v·h)⁵. At a roughness of
0 P is the map itself and F₀ A + B Schlick's F₀ + (1 − F₀)(1 − cos θ)⁵.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.environment.lobe import Lobes
from panoless.kernels.cubemap import sample_cubemap

LEVELS = (0.0, 0.08, 0.22, 0.36, 0.5, 1.0)
"""Roughnesses at which a map is blurred; in between it is mixed. The first is the map itself, which is what smooth
parts see and what is exported.
"""
TABLE_SIDE = 32
TABLE_SAMPLES = 512
"""Facets drawn for each entry of the table, which they bring to within 0.01."""


@dataclass(frozen=True)
class Prefiltered:
    """A map by the blurs that lobes of all roughnesses are made of."""

    maps: list[Tensor]
    weights: Float[Tensor, "N K"]
    """Of the blurs at each of the `LEVELS`."""


def prefiltered(environment: Float[Tensor, "6 3 L L"]) -> Prefiltered:
    """A map of radiance, blurred; L `halves_whole`. Gradient: to the map."""
    lobes = _lobes(environment.shape[-1])
    return Prefiltered(lobes.pyramid(environment), torch.from_numpy(lobes.weights).to(environment))


@lru_cache(maxsize=4)
def _lobes(resolution: int) -> Lobes:
    return Lobes.by_cosine(LEVELS, resolution)


def hat_weights(places: Float[Tensor, "P"], knots: tuple[float, ...]) -> Float[Tensor, "P N"]:
    """Weights of linear interpolation between increasing knots; what lies beyond takes the last of them."""
    at = torch.tensor(knots).to(places)
    places = places.clamp(knots[0], knots[-1])
    upper = torch.bucketize(places.detach(), at).clamp(1, len(knots) - 1)
    share = ((places - at[upper - 1]) / (at[upper] - at[upper - 1]))[:, None]
    columns = torch.arange(len(knots), device=places.device)
    return (columns == upper[:, None] - 1) * (1 - share) + (columns == upper[:, None]) * share


def look_up_rough(
    light: Prefiltered, directions: Float[Tensor, "P 3"], roughness: Float[Tensor, "P"]
) -> Float[Tensor, "P 3"]:
    """P(ω, roughness), bilinear and seamless over directions and linear between levels. Gradients: to all three."""
    shares = hat_weights(roughness, LEVELS) @ light.weights
    parts = [shares[:, k, None] * sample_cubemap(image, directions) for k, image in enumerate(light.maps)]
    return torch.stack(parts).sum(0)


@lru_cache(maxsize=1)
def brdf_table() -> Float[np.ndarray, "S S 2"]:
    """(A, B) at cos θ and roughness, both at equal steps from 0 to 1, by facets drawn from D."""
    steps = np.linspace(0, 1, TABLE_SIDE)
    cosine, alpha = np.maximum(steps, 1e-3)[:, None, None], np.maximum(steps, 1e-3)[None, :, None] ** 2
    index = np.arange(TABLE_SAMPLES)
    # The Hammersley points: evenly spaced, and their binary digits mirrored.
    turn = 2 * np.pi * (index + 0.5) / TABLE_SAMPLES
    height = sum((index >> bit & 1) / 2.0 ** (bit + 1) for bit in range(16)) + 0.5 / TABLE_SAMPLES
    facet_z = np.sqrt((1 - height) / (1 + (alpha**2 - 1) * height))
    facet_x = np.sqrt(1 - facet_z**2) * np.cos(turn)
    view_on_facet = (np.sqrt(1 - cosine**2) * facet_x + cosine * facet_z).clip(0)
    light_z = (2 * view_on_facet * facet_z - cosine).clip(0)
    k = alpha / 2
    shown = light_z / (light_z * (1 - k) + k) * view_on_facet / (facet_z * (cosine * (1 - k) + k))
    schlick = (1 - view_on_facet) ** 5
    table: np.ndarray = np.stack([((1 - schlick) * shown).mean(-1), (schlick * shown).mean(-1)], -1)
    return table


def split_sum_factors(cosines: Float[Tensor, "P"], roughness: Float[Tensor, "P"]) -> Float[Tensor, "P 2"]:
    """(A, B) of cos θ and roughness in [0, 1], bilinear in `brdf_table`. Gradients: to both."""
    table = torch.from_numpy(brdf_table()).to(cosines).flatten(0, 1)
    (row, down), (column, along) = (_cell(each) for each in (cosines, roughness))
    corner = row * TABLE_SIDE + column
    upper, lower = (
        table[at] * (1 - along)[:, None] + table[at + 1] * along[:, None] for at in (corner, corner + TABLE_SIDE)
    )
    return upper * (1 - down)[:, None] + lower * down[:, None]


def _cell(places: Float[Tensor, "P"]) -> tuple[Int[Tensor, "P"], Float[Tensor, "P"]]:
    """Between which two of the steps of the table a place in [0, 1] lies, and where between them."""
    scaled = places.clamp(0, 1) * (TABLE_SIDE - 1)
    first = scaled.detach().floor().clamp(max=TABLE_SIDE - 2)
    return first.long(), scaled - first


def specular_share(
    at_normal: Float[Tensor, "P 3"], cosines: Float[Tensor, "P"], roughness: Float[Tensor, "P"]
) -> Float[Tensor, "P 3"]:
    """F₀ A + B of the reflectance F₀ at normal incidence."""
    scale, bias = split_sum_factors(cosines, roughness)[:, :, None].unbind(1)
    return at_normal * scale + bias
