"""Configuration of a fit: frozen dataclasses whose docstrings are the help texts. Presets are data.

Durations are shares of `iterations`, so every schedule scales with the length of the fit.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Annotated, Any, Literal

import tyro

from panoless.selection.options import SelectionOptions
from shinypartial.core.errors import InputError

Model = Literal["auto", "plane", "height_field", "revolution", "surfels"]


@dataclass(frozen=True)
class SurfelConfig:
    """The set of surfels and how it starts."""

    initial: Literal["thin-plate", "hull", "random"] = "thin-plate"
    """`thin-plate`: on the visual hull where outlines touch the object, continued smoothly where none does;
    `hull`: on the visual hull of the masks; `random`: uniformly in the normalized cube, as the paper's code does."""
    count: int = 6000
    """Number of surfels at the start; denser where the first surface is strongly curved."""
    curved: bool = True
    """Give every surfel a linear normal field (three numbers of a shape operator) instead of one normal."""
    hull_resolution: int = 96
    """Voxels along a side of the cube in which the hull is carved; outlines count below the size of a voxel."""
    hull_votes: float = 0.96
    """Least share of the views whose mask must keep a point of the hull; all views count unless they contradict."""


@dataclass(frozen=True)
class EnvironmentConfig:
    """The learnable cubemap."""

    resolution: int = 128
    """Texels along a face side during the optimization."""
    activation: Literal["clamp", "sigmoid"] = "clamp"
    """`sigmoid`: Eq. 7 of the paper, started at random logits; `clamp`: radiance itself, kept in [0, 1]."""
    range: Literal["ldr", "hdr"] = "ldr"
    """`ldr`: views are clipped to [0, 1], as photographs are; `hdr`: radiance above 1 is fitted, too (needs EXR)."""
    warmup: float = 0.06
    """Share of the iterations in which only the environment learns, before the geometry moves."""
    solve: bool = True
    """Start and end with the closed-form robust least-squares map instead of what gradient descent left."""
    rays: int = 8_000_000
    """Most rays that the closed-form map is solved from; an eighth of them tells which surfels to trust."""
    fill: bool = True
    """Fill directions that no ray of the closed-form map met from what is known around them; else they stay gray."""
    trace: bool = True
    """Leave pixels out of the closed-form map whose mirrored ray meets a plane's frame, or a surface of revolution
    again; a bent plane always does, surfels can't tell."""
    solve_resolution: int = 0
    """Texels along a face side of the closed-form map that is exported; 0 lets held-out views choose 64, 128 or 256."""


@dataclass(frozen=True)
class LossConfig:
    """Terms of the objective (paper Eqs. 9–14)."""

    photometric: Literal["masked", "paper"] = "masked"
    """`paper`: Eq. 9 over the whole image; `masked`: mean √(‖e‖² + ε²) over pixels that lie wholly on the object."""
    robust_scale: float = 0.3
    """Residual (linear radiance) beyond which a pixel loses its vote in `masked`; 0 lets all pixels vote."""
    lambda_ssim: float = 0.2
    """Weight of D-SSIM in Eq. 9; read by `paper`."""
    lambda_normal_consistency: float = 0.05
    """Weight of the depth–normal term, Eq. 12."""
    lambda_silhouette: float = 1.0
    """Weight of the binary cross-entropy between alpha and mask, Eq. 13."""
    silhouette_until: float = 1.0
    """Share of the iterations in which the silhouette term acts (the paper's 3000 of 45000)."""
    lambda_distortion: float = 0.0
    """Weight of the depth distortion of the surfel paper (Huang et al. 2024, Eq. 13)."""
    depth_blend: float = 0.5
    """λ_d of Eq. 3: 0 takes the expected depth, 1 the median depth."""
    roughness_weighted: bool = False
    """Scale the specular term by a learned (1 − ρ)², the ablation of the paper's Table 3."""
    random_background: bool = False
    """Composite over a new random color at each step instead of black."""


@dataclass(frozen=True)
class DensityConfig:
    """Adaptive density control (Kerbl et al. 2023; Huang et al. 2024) and normal propagation (Ye et al. 2024)."""

    enabled: bool = False
    """Clone, split, prune and reset."""
    start: float = 500 / 45000
    """Share of the iterations after which it begins."""
    stop: float = 12000 / 45000
    """Share of the iterations after which it ends."""
    every: float = 100 / 45000
    """Share of the iterations between two rounds."""
    gradient_threshold: float = 2e-4
    """Mean screen-space gradient (per half image width) above which a surfel is cloned or split."""
    dense_share: float = 0.01
    """Surfels larger than this share of the scene's radius are split, smaller ones cloned."""
    prune_share: float = 0.5
    """Surfels larger than this share of the scene's radius are removed."""
    prune_opacity: float = 0.1
    """Surfels below this opacity are removed."""
    reset_every: float = 3000 / 45000
    """Share of the iterations between two opacity resets."""
    propagate_every: float = 1000 / 45000
    """Share of the iterations between two rounds of normal propagation; 0 turns it off."""
    propagate_until: float = 3000 / 45000
    """Share of the iterations after which there is none: it widens outlines, which only the silhouette term undoes."""
    max_surfels: int = 100_000
    """Growth stops at this number."""


@dataclass(frozen=True)
class RateConfig:
    """Learning rates of Adam, in the normalized frame; constant at first, then falling, which improves the normals."""

    means: float = 1e-4
    """In units of the scene's radius."""
    quats: float = 2e-3
    log_scales: float = 3e-3
    opacity_logits: float = 2e-2
    albedo: float = 2.5e-3
    curvatures: float = 3e-2
    roughness_logits: float = 1e-2
    environment: float = 3e-2
    drop_at: float = 0.4
    """Share of the iterations after which every rate falls geometrically."""
    drop_factor: float = 0.01
    """Factor of the rates at the last iteration."""
    means_fall_until: float = 0.0
    """Share of the iterations over which the means' rate falls to a hundredth; 0: it does not."""
    square_memory: float = 0.99
    """β₂ of Adam, the decay of the mean squared gradient that steps are divided by."""


@dataclass(frozen=True)
class FitConfig:
    """Everything that determines a fit, saved beside its result."""

    preset: str = "default"
    """Name of the preset that the values started from."""
    iterations: int = 1000
    """Number of optimization steps (one view each)."""
    seed: int = 0
    """Seed of the initial surfels and of the order of views."""
    model: Annotated[
        Literal["auto", "plane", "height_field", "revolution", "surfels"], tyro.conf.arg(prefix_name=False)
    ] = "auto"
    """`auto`: the simplest that explains held-out views; `plane`: three numbers and a boundary; `height_field`: a
    smooth height over that plane; `revolution`: an axis and a profile; `surfels`: curved."""
    albedo: bool = False
    """Learn a diffuse term A (Eq. 8); a perfect mirror has none."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Known reflectance of the mirror in red, green and blue (linear): what it shows is tint · environment."""
    alpha_applied: Literal["once", "paper"] = "once"
    """`paper`: (A + L)·α as Eq. 10 is written, though A is blended already; `once`: A + L·α."""
    downscale: int = 1
    """Average the training images over blocks of this many pixels a side."""
    crop_margin_px: int = 12
    """Work on the mask's bounding box with this margin; −1 works on whole images."""
    visibility: Literal["final", "online"] = "final"
    """`online`: evidence of every iteration, as in the paper; `final`: how far rays of the converged geometry agree."""
    scene_radius: Literal["object", "cameras"] = "object"
    """What the means' rate and the sizes of density control are shares of: the radius of the object, or 1.1 × the
    largest distance of a camera from the cameras' mean (Kerbl et al. 2023)."""
    visibility_alpha: float = 0.5
    """τ: only pixels with alpha above it count as observations."""
    surfels: SurfelConfig = field(default_factory=SurfelConfig)
    environment: EnvironmentConfig = field(default_factory=EnvironmentConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    rates: RateConfig = field(default_factory=RateConfig)
    selection: SelectionOptions = field(default_factory=SelectionOptions)


def config_from_dict(content: dict[str, Any]) -> FitConfig:
    """The configuration that `dataclasses.asdict` was taken from; InputError when its options are not today's."""
    return _rebuild(FitConfig(), content)


def _rebuild(default: Any, content: Any) -> Any:
    names = {item.name for item in fields(default)}
    found = set(content) if isinstance(content, dict) else set()
    if names != found:
        raise InputError(
            expected=f"the options of this version's {type(default).__name__}",
            found=f"others: {', '.join(sorted(names ^ found))}",
            remedy="Use the version of panoless that made the run, or fit again.",
        )
    values = {}
    for name in names:
        value = getattr(default, name)
        values[name] = _rebuild(value, content[name]) if is_dataclass(value) else content[name]
        if isinstance(value, tuple):  # JSON knows lists only.
            values[name] = tuple(content[name])
    return type(default)(**values)


_COUNTS = {
    "iterations": 1,
    "surfels.count": 1,
    "surfels.hull_resolution": 8,
    "environment.resolution": 2,
    "environment.solve_resolution": 0,
    "density.max_surfels": 1,
    "crop_margin_px": -1,
    "downscale": 1,
    "environment.rays": 8,
}
"""Smallest values of whole numbers; a hull of fewer voxels has no inside to speak of."""

_UNBOUNDED_NUMBERS = {"seed", "density.gradient_threshold", "density.dense_share", "loss.robust_scale"}


def check_config(config: FitConfig) -> None:
    """Raise InputError for a number outside its range: counts from their smallest value, weights and rates from 0,
    shares and opacities in [0, 1]; and for options that exclude each other.
    """
    _check_light(config)
    for name, value in _numbers(config, ""):
        high = math.inf
        if name in _COUNTS:
            low: float = _COUNTS[name]
        elif name in _UNBOUNDED_NUMBERS:
            low = -math.inf
        else:
            low = 0
            open_ended = name.startswith(("rates.", "loss.lambda_", "selection.")) and name not in (
                "rates.drop_at",
                "rates.means_fall_until",
                "rates.square_memory",
                "loss.lambda_ssim",
            )
            high = math.inf if open_ended else 1
        if not (low <= value <= high and math.isfinite(value)):
            raise InputError(
                expected=f"--config.{name.replace('_', '-')} to be a number of at least {low}"
                + (f" and at most {high}" if math.isfinite(high) else ""),
                found=str(value),
                remedy="See `panoless fit --help` for what it means.",
            )


def _check_light(config: FitConfig) -> None:
    if not all(0 < value < math.inf for value in config.tint):
        raise InputError(
            expected="--config.tint to be three numbers above 0",
            found=" ".join(map(str, config.tint)),
            remedy="Give the linear reflectance in red, green and blue, such as 1.0 0.86 0.57.",
        )
    linear = config.albedo or config.loss.photometric == "paper" or config.environment.activation == "sigmoid"
    if config.environment.range == "hdr" and linear:
        raise InputError(
            expected="a mirror without diffuse color, the masked photometric term and the activation `clamp` for hdr",
            found=f"options of the preset {config.preset} that work in [0, 1]",
            remedy="Use --preset fast, default or best, or leave --config.environment.range out.",
        )


def _numbers(config: Any, prefix: str) -> Iterator[tuple[str, float]]:
    for item in fields(config):
        value = getattr(config, item.name)
        if is_dataclass(value):
            yield from _numbers(value, f"{prefix}{item.name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield prefix + item.name, value
