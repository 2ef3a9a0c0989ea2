"""Configuration of splatting: surfels, the terms of their loss, density control, learning rates, and tuned numbers."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from shinypartial.io.records import Count, NonNegative, Positive, Share


@dataclass(frozen=True)
class SurfelOptions:
    """How surfels are placed on a first surface, and what the map that follows them takes. All were chosen on the
    development scenes.
    """

    overlap: Positive = 0.8
    """Radius of surfels over the side of the square that each has to itself."""
    sag_px: Positive = 1.0
    """A surfel's disk may leave the first surface, or the hull, by so much at twice its radius."""
    least_radius_px: Positive = 1.5
    """Strong curvature makes no smaller surfels than these."""
    shrinking_steps: Count = 6
    """Times that a surfel which sticks out of the hull is shrunk at most…"""
    shrinkage: Share = 0.75
    """…and the factor each time."""
    candidates: Count = 8
    """Points drawn for each surfel, to be spread."""
    relaxation_rounds: Count = 3
    """Rounds of Lloyd's relaxation by which surfels spread."""
    initial_rays: Count = 1_000_000
    """Most rays of the map that steps begin with."""
    trial_share: Share = 1 / 8
    """Share of the rays that is enough to tell whom to trust and how fine a map is worth it."""
    trial_resolution: Count = 128
    """Texels along a face side of the map that tells it."""
    trust_views: Count = 40
    """From so many views at most the trust in surfels is told."""
    trust_scale: Positive = 0.15
    """Residual (linear radiance) beyond which a pixel tells against its surfels."""
    prior_pixels: NonNegative = 1.0
    """Pixels' worth of an opinion that every surfel starts with, so that one that is hardly seen is hardly believed…"""
    prior_trust: Share = 0.2
    """…and the trust that this opinion is."""
    trust_power: NonNegative = 4.0
    """The power of the blended trust by which a ray counts."""


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
    tuned: Annotated[SurfelOptions, tyro.conf.Suppress] = field(default_factory=SurfelOptions)


@dataclass(frozen=True)
class LossConfig:
    """Terms of the objective (paper Eqs. 9–14)."""

    photometric: Literal["masked", "paper"] = "masked"
    """`paper`: Eq. 9 over the whole image; `masked`: mean √(‖e‖² + ε²) over pixels that lie wholly on the object."""
    robust_scale: NonNegative = 0.3
    """Residual (linear radiance) beyond which a pixel loses its vote in `masked`; 0 lets all pixels vote."""
    lambda_ssim: Share = 0.2
    """Weight of D-SSIM in Eq. 9; read by `paper`."""
    lambda_normal_consistency: NonNegative = 0.05
    """Weight of the depth–normal term, Eq. 12."""
    lambda_silhouette: NonNegative = 1.0
    """Weight of the binary cross-entropy between alpha and mask, Eq. 13."""
    silhouette_until: Share = 1.0
    """Share of the iterations in which the silhouette term acts (the paper's 3000 of 45000)."""
    lambda_distortion: NonNegative = 0.0
    """Weight of the depth distortion of the surfel paper (Huang et al. 2024, Eq. 13)."""
    depth_blend: Share = 0.5
    """λ_d of Eq. 3: 0 takes the expected depth, 1 the median depth."""
    roughness_weighted: bool = False
    """Scale the specular term by a learned (1 − ρ)², the ablation of the paper's Table 3."""
    random_background: bool = False
    """Composite over a new random color at each step instead of black."""
    white_background: bool = False
    """Composite over white."""


@dataclass(frozen=True)
class DensityConfig:
    """Adaptive density control (Kerbl et al. 2023; Huang et al. 2024) and normal propagation (Ye et al. 2024)."""

    enabled: bool = False
    """Clone, split, prune and reset."""
    start: Share = 500 / 45000
    """Share of the iterations after which it begins."""
    stop: Share = 12000 / 45000
    """Share of the iterations after which it ends."""
    every: Share = 100 / 45000
    """Share of the iterations between two rounds."""
    gradient_threshold: NonNegative = 2e-4
    """Mean screen-space gradient (per half image width) above which a surfel is cloned or split."""
    dense_share: NonNegative = 0.01
    """Surfels larger than this share of the scene's radius are split, smaller ones cloned."""
    prune_share: Share = 0.5
    """Surfels larger than this share of the scene's radius are removed."""
    prune_opacity: Share = 0.1
    """Surfels below this opacity are removed."""
    reset_every: Share = 3000 / 45000
    """Share of the iterations between two opacity resets."""
    propagate_every: Share = 1000 / 45000
    """Share of the iterations between two rounds of normal propagation; 0 turns it off."""
    propagate_from: Share = 0.0
    """Share of the iterations before which there is none."""
    propagate_until: Share = 3000 / 45000
    """Share of the iterations after which there is none: it widens outlines, which only the silhouette term undoes."""
    opacities_rest: Share = 0.0
    """Share of the iterations after each propagation in which opacities hold still."""
    max_surfels: Count = 100_000
    """Growth stops at this number."""


@dataclass(frozen=True)
class RateConfig:
    """Learning rates of Adam, in the normalized frame; constant at first, then falling, which improves the normals."""

    means: NonNegative = 1e-4
    """In units of the scene's radius."""
    quats: NonNegative = 2e-3
    log_scales: NonNegative = 3e-3
    opacity_logits: NonNegative = 2e-2
    albedo: NonNegative = 2.5e-3
    curvatures: NonNegative = 3e-2
    roughness_logits: NonNegative = 1e-2
    harmonics: NonNegative = 2.5e-3
    strength_logits: NonNegative = 6e-3
    base_color_logits: NonNegative = 7.5e-3
    normal_residuals: NonNegative = 5e-3
    indirect_harmonics: NonNegative = 7.5e-3
    environment: NonNegative = 3e-2
    drop_at: Share = 0.4
    """Share of the iterations after which every rate falls geometrically."""
    drop_factor: NonNegative = 0.01
    """Factor of the rates at the last iteration."""
    means_fall_until: Share = 0.0
    """Share of the iterations over which the means' rate falls to a hundredth; 0: it does not."""
    square_memory: Annotated[float, Meta(ge=0, lt=1)] = 0.99
    """β₂ of Adam, the decay of the mean squared gradient that steps are divided by."""


@dataclass(frozen=True)
class SplatConfig:
    """A fit of surfels, in steps of gradient descent."""

    iterations: Count = 1000
    """Number of optimization steps (one view each)."""
    albedo: bool = False
    """Learn a diffuse term A (Eq. 8); a perfect mirror has none."""
    alpha_applied: Literal["once", "paper"] = "once"
    """`paper`: (A + L)·α as Eq. 10 is written, though A is blended already; `once`: A + L·α."""
    visibility: Literal["final", "online"] = "final"
    """`online`: evidence of every iteration, as in the paper; `final`: how far rays of the converged geometry agree."""
    scene_radius: Literal["object", "cameras"] = "object"
    """What the means' rate and the sizes of density control are shares of: the radius of the object, or 1.1 × the
    largest distance of a camera from the cameras' mean (Kerbl et al. 2023)."""
    visibility_alpha: Share = 0.5
    """τ: only pixels with alpha above it count as observations."""
    surfels: SurfelConfig = field(default_factory=SurfelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    rates: RateConfig = field(default_factory=RateConfig)
