"""The environment as a cubemap, by robust least squares of rays."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.environment.cubemap import resample
from panoless.environment.fill import fill_unobserved
from panoless.environment.footprints import grouped, splat
from panoless.environment.rays import Rays, joined_rays, normalize_confidence
from panoless.kernels.cubemap import apply_gram, lookup_gram, sample_cubemap
from panoless.numeric.conjugate_gradients import conjugate_gradients
from panoless.numeric.robust import robust_weight

ROBUST_SCALES = (None, 0.3, 0.15, 0.08, 0.05)
"""Residuals (linear radiance) beyond which rays lose their vote, round by round; all vote in the first."""
REFINING_SCALES = (0.08, 0.05)
START_WEIGHT = 1.0
"""Pull of a texel to its splat, in rays."""
MERGED_RAYS = 1_000_000
"""About so many rays make a batch: a lookup of ten thousand costs six times as much a ray."""


def solve_environment(
    rays: Sequence[Rays], resolution: int, start: Float[Tensor, "6 3 M M"] | None = None
) -> Float[Tensor, "6 3 L L"]:
    """Robust least squares of the map for fixed geometry: min_E Σ t w ‖E(ω) − c‖², gaps filled smoothly.

    Rounds of iteratively re-weighted least squares with the rays' trust t, in units of its mean, and Geman–McClure
    weights w = 1/(1 + ‖e‖²/s²)², so that pixels which see the object itself or a wrong normal lose their vote. Each
    round starts from the weighted splat Eᵀ(t w c)/Eᵀ(t w) and sharpens it by conjugate gradients on the normal
    equations. From a `start`, a map of the same rays at any resolution, only the last scales are needed. The map lies
    between 0 and the brightest ray, or 1 where that is more.
    """
    rays = merged(normalize_confidence(rays))
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
        right_side, total = _right_side(rays, weights, environment)
        splat = fill_unobserved(right_side / total.clamp(min=1e-9), total[:, 0])
        environment = _sharpen(splat, right_side, total, rays, weights)
    brightest = max([1.0, *(float(batch.radiance.max()) for batch in rays if batch.radiance.numel())])
    return environment.clamp(0, brightest)


def merged(rays: Iterable[Rays]) -> list[Rays]:
    """The rays in batches of about a million, without where they came from, which a map does not require. Those that
    come one by one need memory once.
    """
    groups = grouped((replace(batch, incoming=None) for batch in rays), MERGED_RAYS)
    return [group[0] if len(group) == 1 else joined_rays(group) for group in groups]


def _right_side(
    rays: Sequence[Rays], weights: Sequence[Tensor], environment: Float[Tensor, "6 3 L L"]
) -> tuple[Float[Tensor, "6 3 L L"], Float[Tensor, "6 1 L L"]]:
    """Eᵀ(w c) and Eᵀw, of the size and on the device of a map."""
    both = torch.cat([torch.zeros_like(environment), torch.zeros_like(environment[:, :1])], 1)
    for batch, weight in zip(rays, weights, strict=True):
        both += splat(batch, weight, environment.shape[-1])
    return both[:, :3], both[:, 3:]


def _sharpen(
    start: Float[Tensor, "6 3 L L"],
    right_side: Float[Tensor, "6 3 L L"],
    total: Float[Tensor, "6 1 L L"],
    rays: Sequence[Rays],
    weights: Sequence[Tensor],
) -> Float[Tensor, "6 3 L L"]:
    """A few preconditioned conjugate-gradient steps; a unit-weight pull to the start keeps thin texels stable."""
    resolution = start.shape[-1]
    gram = start.new_zeros(6, resolution + 2, resolution + 2, 5)
    for batch, weight in zip(rays, weights, strict=True):
        gram += lookup_gram(batch.directions, weight, resolution)
    return conjugate_gradients(
        lambda image: apply_gram(gram, image) + START_WEIGHT * image,
        start,
        right_side - apply_gram(gram, start),
        1 / (total + START_WEIGHT),
    )
