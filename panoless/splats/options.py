"""What a user may sweep in splatting: surfels, the terms of their loss, and how many there may be."""

from dataclasses import dataclass, field
from typing import Literal

from shinypartial.io.records import Count, NonNegative, Share


@dataclass(frozen=True)
class SurfelConfig:
    """The set of surfels and how it starts."""

    initial: Literal["thin-plate", "hull", "random"] = "thin-plate"
    """`thin-plate`: on the visual hull where outlines touch the object, continued smoothly where none does;
    `hull`: on the visual hull of the masks; `random`: uniformly in the normalized cube, as the paper's code does."""
    count: Count = 6000
    """Number of surfels at the start; denser where the first surface is strongly curved."""
    curved: bool = True
    """Give every surfel a linear normal field (three numbers of a shape operator) instead of one normal."""
    shading: Literal["mirror", "3dgs-dr", "gaussian-shader", "ref-gaussian", "material-refgs"] = "mirror"
    """`mirror`: each pixel mirrors the environment; else as another method shades its primitives."""


@dataclass(frozen=True)
class LossConfig:
    """Terms of the objective (paper Eqs. 9–14)."""

    photometric: Literal["masked", "paper"] = "masked"
    """`paper`: Eq. 9 over the whole image; `masked`: mean √(‖e‖² + ε²) over pixels that lie wholly on the object."""
    robust_scale: NonNegative = 0.3
    """Residual (linear radiance) beyond which a pixel loses its vote in `masked`; 0 lets all pixels vote."""
    lambda_normal_consistency: NonNegative = 0.05
    """Weight of the depth–normal term, Eq. 12."""
    lambda_silhouette: NonNegative = 1.0
    """Weight of the binary cross-entropy between alpha and mask, Eq. 13."""
    silhouette_until: Share = 1.0
    """Share of the iterations in which the silhouette term acts (the paper's 3000 of 45000)."""
    roughness_weighted: bool = False
    """Scale the specular term by a learned (1 − ρ)², the ablation of the paper's Table 3."""


@dataclass(frozen=True)
class DensityConfig:
    """Adaptive density control (Kerbl et al. 2023; Huang et al. 2024) and normal propagation (Ye et al. 2024)."""

    enabled: bool = False
    """Clone, split, prune and reset, when the method of `surfels.shading` does."""
    max_surfels: Count = 100_000
    """Growth stops at this number."""


@dataclass(frozen=True)
class SplatConfig:
    """A fit of surfels, in steps of gradient descent."""

    iterations: Count = 1000
    """Number of optimization steps (one view each)."""
    rates: Literal["ours", "published"] = "ours"
    """Learning rates of Adam: ours, or those that the method of `surfels.shading` published."""
    albedo: bool = False
    """Learn a diffuse term A (Eq. 8); a perfect mirror has none."""
    alpha_applied: Literal["once", "paper"] = "once"
    """`paper`: (A + L)·α as Eq. 10 is written, though A is blended already; `once`: A + L·α."""
    visibility: Literal["final", "online"] = "final"
    """`online`: evidence of every iteration, as in the paper; `final`: how far rays of the converged geometry agree."""
    surfels: SurfelConfig = field(default_factory=SurfelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
