"""How well each direction of the environment was observed (paper Sec. 3.5)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from panoless.environment.rays import Rays
from panoless.kernels.cubemap import cubemap_solid_angles, sample_cubemap, scatter_cubemap
from panoless.numeric.robust import robust_weight
from shinypartial.core.color import linear_to_srgb

VOTE_SCALE = 0.05
"""Residual (linear radiance) beyond which a ray does not agree with the map."""
HALVING_DISAGREEMENT = 0.05
"""Mean difference of rays from the map (sRGB, 0 to 1) that halves the confidence."""
HALVING_CONTRAST = 0.1
"""Difference of a texel's neighbors (linear radiance) that halves it."""

SATURATING_QUANTILE = 0.9
"""Of the observed texels, from which evidence counts as full."""


@dataclass(frozen=True)
class Agreement:
    """What the rays that look in a texel's direction say about it, on the cubemap's grid.

    `votes` is the sum of their robust weights: how many rays agree that this is the environment. `share` is what part
    of all their trust that is. `disagreement` is the weighted mean of their absolute sRGB difference from the map, in
    [0, 1]: small only where they all see the same. `contrast` is the larger difference of the map's mean radiance
    between the two neighbors of a texel, by row and by column.
    """

    votes: Float[Tensor, "6 L L"]
    share: Float[Tensor, "6 L L"]
    disagreement: Float[Tensor, "6 L L"]
    contrast: Float[Tensor, "6 L L"]


def accumulate(
    evidence: Float[Tensor, "6 L L"],
    directions: Float[Tensor, "P 3"],
    alpha: Float[Tensor, "P"],
    alpha_threshold: float,
) -> None:
    """Add to `evidence`, in place, alpha at the reflection direction of every pixel with alpha > τ."""
    kept = alpha > alpha_threshold
    evidence += scatter_cubemap(alpha[kept][:, None], directions[kept], evidence.shape[-1])[:, 0]


def visibility_from_evidence(evidence: Float[Tensor, "6 L L"]) -> Float[Tensor, "6 L L"]:
    """Map evidence to [0, 1]: log(1 + e/Ω) over its 90 % quantile among observed texels; Ω is the relative solid angle.

    Zero exactly where no ray fell.
    """
    relative = cubemap_solid_angles(evidence.shape[-1]).to(evidence)
    density = torch.log1p(evidence / (relative / relative.mean()))
    observed = density[density > 0]
    if not len(observed):
        return torch.zeros_like(evidence)
    return (density / torch.quantile(observed[:: max(1, len(observed) // 100_000)], SATURATING_QUANTILE)).clamp(0, 1)


def agreement(
    rays: Sequence[Rays],
    environment: Float[Tensor, "6 3 L L"],
    saturation: Float[Tensor, "3"] | None = None,
) -> Agreement:
    """Weigh each ray by t (1 + ‖e‖²/s²)⁻², t its trust and s the `VOTE_SCALE`; average its sRGB residual by texel.

    Rays end at `saturation`, if given: there a map may be brighter and agrees.
    """
    saturation = environment.new_full((3,), math.inf) if saturation is None else saturation.to(environment)
    resolution = environment.shape[-1]
    votes = environment.new_zeros(6, resolution, resolution)
    residual, trusted = torch.zeros_like(votes), torch.zeros_like(votes)
    for batch in rays:
        seen = sample_cubemap(environment, batch.directions).minimum(saturation)
        trust = batch.initial_weight()
        weight = trust * robust_weight(seen - batch.radiance, VOTE_SCALE)
        difference = (_srgb(seen) - _srgb(batch.radiance)).abs().mean(1)
        summed = scatter_cubemap(torch.stack([weight, weight * difference, trust], 1), batch.directions, resolution)
        votes += summed[:, 0]
        residual += summed[:, 1]
        trusted += summed[:, 2]
    share = (votes / trusted.clamp(min=1e-6)).clamp(max=1)
    contrast = _contrast(environment.minimum(saturation[:, None, None]).mean(1))
    return Agreement(votes, share, residual / votes.clamp(min=1e-6), contrast)


def _contrast(radiance: Float[Tensor, "6 L L"]) -> Float[Tensor, "6 L L"]:
    """Difference of the neighbors on both sides, within a face; at its edge that of the texel and its neighbor."""
    padded = pad(radiance[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    across = (padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]).abs()
    return across.maximum((padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]).abs())


def _srgb(radiance: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    return torch.from_numpy(linear_to_srgb(radiance.clamp(min=0).cpu().numpy())).to(radiance.device)


def visibility_from_agreement(found: Agreement) -> Float[Tensor, "6 L L"]:
    """Confidence in [0, 1]: v/(1 + v) · s · 1/(1 + d/d½) · 1/(1 + c/c½), with v the votes a mean-sized texel would
    have had, s the share that agrees, d the disagreement and c the contrast, and d½ and c½ those that halve it.

    Zero exactly where no ray fell; ½ at most where a single ray did or where rays disagree by d½. It uses training
    views only, yet orders directions by their actual error: rays disagree where normals are wrong, where the map is
    too coarse, and where the object sees itself; and where the map is steep, a small shift is a large error.
    """
    relative = cubemap_solid_angles(found.votes.shape[-1]).to(found.votes)
    votes = found.votes / (relative / relative.mean())
    sure = votes / (1 + votes) * found.share
    return sure / (1 + found.disagreement / HALVING_DISAGREEMENT) / (1 + found.contrast / HALVING_CONTRAST)
