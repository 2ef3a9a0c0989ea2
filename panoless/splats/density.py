"""Adaptive density control (Kerbl et al. 2023, Huang et al. 2024) and normal propagation (Ye et al. 2024)."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.splats.kernels.reference.rasterize import rotation_matrices
from panoless.splats.model import Surfels

GRADIENT_THRESHOLD = 2e-4
"""Mean screen-space gradient (per half image width) above which a surfel is cloned or split."""
DENSE_SHARE = 0.01
"""Surfels larger than this share of the scene's radius are split, smaller ones cloned."""
PRUNE_SHARE = 0.1
"""Surfels larger than this share of the scene's radius are removed."""
SPLIT_INTO = 2
SPLIT_SHRINK = 0.8 * SPLIT_INTO
RESET_OPACITY = 0.01
PROPAGATED_OPACITY = 0.9
PROPAGATION_GROWTH = 1.5


@dataclass
class DensityStatistics:
    """Running mean of the screen-space gradient of each surfel, in units of half the image width."""

    gradient_sum: Float[Tensor, "K"]
    count: Float[Tensor, "K"]

    @classmethod
    def empty(cls, count: int, device: torch.device | None = None) -> "DensityStatistics":
        """Nothing seen yet."""
        return cls(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def observe(self, screen_gradient: Float[Tensor, "K 2"], in_frustum: Tensor, image_width: int) -> None:
        """Add one step's gradient of the surfels that were rasterized."""
        self.gradient_sum += screen_gradient.norm(dim=1) * (image_width / 2) * in_frustum
        self.count += in_frustum

    @property
    def mean(self) -> Float[Tensor, "K"]:
        """Mean gradient; zero for surfels never rasterized."""
        return self.gradient_sum / self.count.clamp(min=1)


@dataclass(frozen=True)
class Edit:
    """New surfels; row i comes from old row `source[i]` and keeps its optimizer moments where `unchanged[i]`."""

    surfels: Surfels
    source: Int[Tensor, "K"]
    unchanged: Bool[Tensor, "K"]


def grow_and_prune(
    surfels: Surfels,
    statistics: DensityStatistics,
    generator: torch.Generator,
    *,
    max_surfels: int,
    least_opacity: float,
    unit: float = 1.0,
    threshold: float = GRADIENT_THRESHOLD,
) -> Edit:
    """Clone small and split large surfels whose mean gradient is above threshold; prune faint and huge ones.

    A split replaces a surfel by two drawn from its own Gaussian, scales divided by 1.6. Where no opacity is required
    only huge surfels go: right after an opacity reset all are faint. `unit` is the scene's radius in radii of the
    object. Growth stops at `max_surfels`.
    """
    surfels = surfels.detached()
    largest = surfels.scales.amax(1)
    grows = (statistics.mean >= threshold) & (surfels.count < max_surfels)
    clones = torch.nonzero(grows & (largest <= DENSE_SHARE * unit))[:, 0]
    splits = torch.nonzero(grows & (largest > DENSE_SHARE * unit))[:, 0]
    room = max(max_surfels - surfels.count, 0)
    clones, splits = clones[:room], splits[: max(room - len(clones), 0)]
    stays = torch.ones_like(grows)
    stays[splits] = False
    kept = torch.nonzero(stays)[:, 0]
    children = splits.repeat(SPLIT_INTO)
    parts = (surfels.select(kept), surfels.select(clones), _split(surfels.select(children), generator))
    merged = type(surfels)(**{name: torch.cat([part.named()[name] for part in parts]) for name in surfels.named()})
    source = torch.cat([kept, clones, children])
    unchanged = torch.arange(len(source), device=source.device) < len(kept)
    alive = merged.scales.amax(1) < PRUNE_SHARE * unit
    if least_opacity > 0:
        alive &= merged.opacities >= least_opacity
    if not alive.any():
        alive[merged.opacities.argmax()] = True
    return Edit(merged.select(alive), source[alive], unchanged[alive])


def _split(children: Surfels, generator: torch.Generator) -> Surfels:
    axes = children.scales.shape[1]
    local = torch.randn(children.count, axes, generator=generator).to(children.scales) * children.scales
    rotation = rotation_matrices(children.quats)
    offset = rotation[:, :, 0] * local[:, :1]
    for axis in range(1, axes):
        offset = offset + rotation[:, :, axis] * local[:, axis : axis + 1]
    return replace(children, means=children.means + offset, log_scales=children.log_scales - math.log(SPLIT_SHRINK))


def reset_opacities(surfels: Surfels) -> Surfels:
    """Lower every opacity to at most 0.01, so that surfels must earn it again."""
    ceiling = math.log(RESET_OPACITY / (1 - RESET_OPACITY))
    return replace(surfels.detached(), opacity_logits=surfels.opacity_logits.detach().clamp(max=ceiling))


def propagate_normals(surfels: Surfels) -> Surfels:
    """Enlarge surfels by half and raise their opacity to at least 0.9, so that good normals cover their neighbors."""
    floor = math.log(PROPAGATED_OPACITY / (1 - PROPAGATED_OPACITY))
    return replace(
        surfels.detached(),
        opacity_logits=surfels.opacity_logits.detach().clamp(min=floor),
        log_scales=surfels.log_scales.detach() + math.log(PROPAGATION_GROWTH),
    )
