"""The environment as a cubemap: lookup with its activation, the closed-form robust map, and the fill of gaps."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d

from panoless.config import EnvironmentConfig
from panoless.kernels.cubemap import cubemap_directions, sample_cubemap, scatter_cubemap
from shinypartial.sphere import cube_to_directions, directions_to_cube

INITIAL_LOGIT = 5.0
ROBUST_SCALES = (None, 0.3, 0.15, 0.08, 0.05)
REFINING_SCALES = (0.08, 0.05)
CONJUGATE_GRADIENT_STEPS = 6
CONFIDENT_WEIGHT = 1.0
MERGED_RAYS = 1_000_000
#: A level of L texels a side is relaxed this often over L: the coarse ones, which carry far and cost little, most.
RELAXED_TEXELS = 256
DAMPING = 0.8


@dataclass(frozen=True)
class Rays:
    """Observations of the environment: unit world directions and the linear radiance seen along them.

    `trust` says how far each is believed beforehand, in [0, 1]; None: all alike.
    """

    directions: Float[Tensor, "P 3"]
    radiance: Float[Tensor, "P 3"]
    trust: Float[Tensor, "P"] | None = None

    def initial_weight(self) -> Float[Tensor, "P"]:
        """The trust, or ones."""
        return torch.ones_like(self.radiance[:, 0]) if self.trust is None else self.trust.clone()

    def every(self, stride: int, first: int) -> "Rays":
        """Every stride-th ray from the first."""
        part = slice(first, None, stride)
        return Rays(self.directions[part], self.radiance[part], None if self.trust is None else self.trust[part])


def initial_environment(config: EnvironmentConfig, generator: torch.Generator) -> Float[Tensor, "6 3 L L"]:
    """Gray radiance for `clamp`; logits uniform in ±5 for `sigmoid`."""
    shape = (6, 3, config.resolution, config.resolution)
    if config.activation == "sigmoid":
        return (torch.rand(shape, generator=generator) * 2 - 1) * INITIAL_LOGIT
    return torch.full(shape, 0.5)


def look_up(
    environment: Float[Tensor, "6 3 L L"], directions: Float[Tensor, "P 3"], activation: str
) -> Float[Tensor, "P 3"]:
    """Specular radiance: σ(E(ω)) for `sigmoid` (Eq. 7), E(ω) for `clamp`; bilinear and seamless."""
    value = sample_cubemap(environment, directions)
    return torch.sigmoid(value) if activation == "sigmoid" else value


def solve_environment(
    rays: Sequence[Rays], resolution: int, start: Float[Tensor, "6 3 M M"] | None = None
) -> Float[Tensor, "6 3 L L"]:
    """Robust least squares of the map for fixed geometry: min_E Σ t w ‖E(ω) − c‖², gaps filled smoothly.

    Rounds of iteratively re-weighted least squares with the rays' trust t and Geman–McClure weights
    w = 1/(1 + ‖e‖²/s²)², so that pixels which see the object itself or a wrong normal lose their vote. Each round
    starts from the weighted splat Eᵀ(t w c)/Eᵀ(t w) and sharpens it by conjugate gradients on the normal equations.
    From a `start`, a map of the same rays at any resolution, only the last scales are needed. The map lies between 0
    and the brightest ray, or 1 where that is more.
    """
    rays = _merged(rays)
    weights = [batch.initial_weight() for batch in rays]
    device = rays[0].directions.device if rays else None
    environment = torch.zeros(6, 3, resolution, resolution, device=device)
    if start is not None:
        environment = resample(start, resolution)
    for scale in ROBUST_SCALES if start is None else REFINING_SCALES:
        if scale is not None:
            for batch, weight in zip(rays, weights, strict=True):
                error = sample_cubemap(environment, batch.directions) - batch.radiance
                weight.copy_(batch.initial_weight() * robust_weight(error, scale))
        total = _normal_product(torch.ones_like(environment[:, :1]), rays, weights)
        right_side = _right_side(rays, weights, environment)
        splat = fill_unobserved(right_side / total.clamp(min=1e-9), total[:, 0])
        environment = _sharpen(splat, right_side, total, rays, weights)
    brightest = max([1.0, *(float(batch.radiance.max()) for batch in rays if batch.radiance.numel())])
    return environment.clamp(0, brightest)


def _merged(rays: Sequence[Rays]) -> list[Rays]:
    """The same rays in batches of about a million: a lookup of ten thousand costs six times as much a ray."""
    groups: list[list[Rays]] = [[]]
    for batch in rays:
        if sum(len(each.directions) for each in groups[-1]) >= MERGED_RAYS:
            groups.append([])
        groups[-1].append(batch)
    return [
        Rays(
            torch.cat([each.directions for each in group]),
            torch.cat([each.radiance for each in group]),
            torch.cat([each.initial_weight() for each in group]),
        )
        for group in groups
        if group
    ]


def robust_weight(error: Float[Tensor, "P 3"], scale: float) -> Float[Tensor, "P"]:
    """Geman–McClure weight (1 + ‖e‖²/s²)⁻²."""
    return (1 + error.square().sum(1) / scale**2) ** -2


def _right_side(
    rays: Sequence[Rays], weights: Sequence[Tensor], environment: Float[Tensor, "6 3 L L"]
) -> Float[Tensor, "6 3 L L"]:
    """Eᵀ(w c), of the size and on the device of a map."""
    result = torch.zeros_like(environment)
    for batch, weight in zip(rays, weights, strict=True):
        result += scatter_cubemap(batch.radiance * weight[:, None], batch.directions, environment.shape[-1])
    return result


def _normal_product(
    environment: Float[Tensor, "6 C L L"], rays: Sequence[Rays], weights: Sequence[Tensor]
) -> Float[Tensor, "6 C L L"]:
    """EᵀWE applied to a map: look up, weigh, scatter."""
    result = torch.zeros_like(environment)
    for batch, weight in zip(rays, weights, strict=True):
        seen = sample_cubemap(environment, batch.directions) * weight[:, None]
        result += scatter_cubemap(seen, batch.directions, environment.shape[-1])
    return result


def _sharpen(
    start: Float[Tensor, "6 3 L L"],
    right_side: Float[Tensor, "6 3 L L"],
    total: Float[Tensor, "6 1 L L"],
    rays: Sequence[Rays],
    weights: Sequence[Tensor],
) -> Float[Tensor, "6 3 L L"]:
    """A few preconditioned conjugate-gradient steps; a unit-weight pull to the start keeps thin texels stable."""
    return conjugate_gradients(
        lambda image: _normal_product(image, rays, weights) + CONFIDENT_WEIGHT * image,
        start,
        right_side - _normal_product(start, rays, weights),
        1 / (total + CONFIDENT_WEIGHT),
    )


def conjugate_gradients(
    product: Callable[[Float[Tensor, "6 C L L"]], Float[Tensor, "6 C L L"]],
    start: Float[Tensor, "6 C L L"],
    residual: Float[Tensor, "6 C L L"],
    precondition: Float[Tensor, "6 _ L L"],
    steps: int = CONJUGATE_GRADIENT_STEPS,
) -> Float[Tensor, "6 C L L"]:
    """Steps on A x = b from a start, with its residual b − A x and the inverse of a diagonal near to A's."""
    result, residual = start.clone(), residual.clone()
    scaled = precondition * residual
    direction = scaled.clone()
    energy = (residual * scaled).sum()
    for _ in range(steps):
        ahead = product(direction)
        step = energy / (direction * ahead).sum().clamp(min=1e-12)
        result += step * direction
        residual -= step * ahead
        scaled = precondition * residual
        new_energy = (residual * scaled).sum()
        direction = scaled + (new_energy / energy.clamp(min=1e-12)) * direction
        energy = new_energy
    return result


def fill_unobserved(values: Float[Tensor, "6 C L L"], weight: Float[Tensor, "6 L L"]) -> Float[Tensor, "6 C L L"]:
    """A harmonic fill of gaps: a texel of weight 0 is the mean of its four neighbors, as far as some sweeps reach.

    Solved from coarse to fine. What is known is averaged to coarser levels (the push of Gortler et al. 1996), and each
    level starts from the coarser one and is relaxed. A texel whose weight w is at least one keeps its value, below that
    it is w of itself and 1 − w of the mean of its neighbors, so nothing leaves the range of what is known.
    """
    confidence = weight.clamp(max=1)[:, None]
    pyramid = [(values * confidence, confidence)]
    while pyramid[-1][0].shape[-1] > 1:
        color, known = (4 * avg_pool2d(level, 2, ceil_mode=True, count_include_pad=False) for level in pyramid[-1])
        scale = 1 / known.clamp(min=1)
        pyramid.append((color * scale, known * scale))
    color, known = pyramid[-1]
    everywhere = color.sum(0, keepdim=True) / known.sum(0, keepdim=True).clamp(min=1e-9)
    filled = color + (1 - known) * everywhere
    for color, known in reversed(pyramid[:-1]):
        filled = _relaxed(color, known, resample(filled, color.shape[-1]))
    return filled


def _relaxed(
    color: Float[Tensor, "6 C L L"], known: Float[Tensor, "6 1 L L"], start: Float[Tensor, "6 C L L"]
) -> Float[Tensor, "6 C L L"]:
    """Damped Jacobi sweeps of u = color + (1 − known) · mean of the four neighbors, across edges too."""
    resolution = color.shape[-1]
    gaps = torch.nonzero(known.flatten() < 1)[:, 0]
    if not len(gaps):
        return color
    around = _neighbors(resolution).to(gaps.device)[:, gaps]
    free = (1 - known.flatten()[gaps])[:, None]
    fixed = color.permute(0, 2, 3, 1).flatten(0, 2)[gaps]
    texels = (color + (1 - known) * start).permute(0, 2, 3, 1).flatten(0, 2)
    for _ in range(math.ceil(RELAXED_TEXELS / resolution)):
        texels[gaps] = torch.lerp(texels[gaps], fixed + free * texels[around].mean(0), DAMPING)
    return texels.view(6, resolution, resolution, -1).permute(0, 3, 1, 2).contiguous()


@lru_cache(maxsize=16)
def _neighbors(resolution: int) -> Int[Tensor, "4 P"]:
    """Flat indices of the texels to either side of each along s and t; at a border, of the one straight across."""
    centers = 2 * (np.arange(resolution) + 0.5) / resolution - 1
    face, t, s = np.meshgrid(np.arange(6), centers, centers, indexing="ij")
    beyond = 1 + 1e-6
    found = []
    for shift in np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]) * 2 / resolution:
        shifted = np.clip(np.stack([s, t], -1) + shift, -beyond, beyond)
        other, st = directions_to_cube(cube_to_directions(face, shifted))
        column, row = np.moveaxis(np.clip((st + 1) * resolution / 2, 0, resolution - 1).astype(int), -1, 0)
        found.append(((other * resolution + row) * resolution + column).ravel())
    return torch.from_numpy(np.stack(found))


def resample(environment: Float[Tensor, "6 C L L"], resolution: int) -> Float[Tensor, "6 C M M"]:
    """The map at the texel centers of another resolution, bilinear and seamless."""
    directions = cubemap_directions(resolution, dtype=environment.dtype, device=environment.device).reshape(-1, 3)
    sampled = sample_cubemap(environment, directions)
    return sampled.view(6, resolution, resolution, -1).permute(0, 3, 1, 2).contiguous()
