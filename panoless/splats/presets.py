"""Presets of the paper's method, its ablations and the compared methods: configurations as data."""

from dataclasses import replace

from panoless.config import EnvironmentConfig, FitConfig
from panoless.splats.options import DensityConfig, LossConfig, RateConfig, SplatConfig, SurfelConfig

_PAPER = FitConfig(
    preset="paper",
    model="surfels",
    crop_margin_px=-1,
    environment=EnvironmentConfig(activation="sigmoid", warmup=0.0, solve=False),
    splats=SplatConfig(
        iterations=45_000,
        albedo=True,
        alpha_applied="paper",
        visibility="online",
        scene_radius="cameras",
        surfels=SurfelConfig(initial="random", count=100_000, curved=False),
        loss=LossConfig(
            photometric="paper",
            lambda_normal_consistency=0.5,
            silhouette_until=3000 / 45000,
            random_background=True,
        ),
        density=DensityConfig(enabled=True, prune_share=0.1, max_surfels=200_000),
        rates=RateConfig(
            means=1.6e-4,
            quats=1e-3,
            log_scales=5e-3,
            opacity_logits=5e-2,
            albedo=2.5e-3,
            environment=2e-2,
            drop_at=1.0,
            means_fall_until=30000 / 45000,
            square_memory=0.999,
        ),
    ),
)

_REF_GAUSSIAN = replace(
    _PAPER,
    preset="ref-gaussian",
    crop_margin_px=12,
    environment=EnvironmentConfig(activation="sigmoid", noise=0.0, warmup=0.0, solve=False),
    splats=replace(
        _PAPER.splats,
        iterations=50_000,
        alpha_applied="once",
        visibility="final",
        surfels=SurfelConfig(initial="random", count=100_000, curved=False, shading="ref-gaussian"),
        loss=LossConfig(
            photometric="paper",
            lambda_normal_consistency=0.05,
            lambda_silhouette=0.0,
            depth_blend=0.0,
            white_background=True,
        ),
        density=DensityConfig(
            enabled=True,
            start=500 / 50000,
            stop=25000 / 50000,
            every=500 / 50000,
            prune_share=0.1,
            prune_opacity=0.05,
            reset_every=3000 / 50000,
            propagate_every=1000 / 50000,
            propagate_until=25000 / 50000,
            opacities_rest=200 / 50000,
            max_surfels=200_000,
        ),
        rates=replace(
            _PAPER.splats.rates,
            harmonics=7.5e-3,
            base_color_logits=7.5e-3,
            strength_logits=5e-3,
            roughness_logits=5e-3,
            environment=1e-2,
            means_fall_until=30000 / 50000,
        ),
    ),
)

_3DGS_DR = replace(
    _REF_GAUSSIAN,
    preset="3dgs-dr",
    environment=replace(_REF_GAUSSIAN.environment, noise=5.0),
    splats=replace(
        _REF_GAUSSIAN.splats,
        iterations=61_000,
        surfels=replace(_REF_GAUSSIAN.splats.surfels, shading="3dgs-dr"),
        loss=replace(_REF_GAUSSIAN.splats.loss, lambda_normal_consistency=0.0),
        density=DensityConfig(
            enabled=True,
            start=500 / 61000,
            stop=30000 / 61000,
            every=500 / 61000,
            prune_share=0.1,
            prune_opacity=0.005,
            reset_every=3000 / 61000,
            propagate_every=1000 / 61000,
            propagate_from=3000 / 61000,
            propagate_until=24000 / 61000,
            opacities_rest=200 / 61000,
            max_surfels=200_000,
        ),
        rates=replace(
            _PAPER.splats.rates,
            harmonics=2.5e-3,
            strength_logits=6e-3,
            environment=5e-2,
            means_fall_until=30000 / 61000,
        ),
    ),
)

_GAUSSIAN_SHADER = replace(
    _REF_GAUSSIAN,
    preset="gaussian-shader",
    environment=EnvironmentConfig(activation="clamp", gray=0.8, warmup=0.0, solve=False),
    splats=replace(
        _REF_GAUSSIAN.splats,
        iterations=30_000,
        surfels=replace(_REF_GAUSSIAN.splats.surfels, shading="gaussian-shader"),
        loss=replace(_REF_GAUSSIAN.splats.loss, lambda_normal_consistency=0.0),
        density=DensityConfig(
            enabled=True,
            start=500 / 30000,
            stop=15000 / 30000,
            every=100 / 30000,
            prune_share=0.1,
            prune_opacity=0.005,
            reset_every=3000 / 30000,
            propagate_every=0.0,
            max_surfels=200_000,
        ),
        rates=replace(
            _PAPER.splats.rates,
            harmonics=5e-3,
            base_color_logits=5e-3,
            roughness_logits=5e-3,
            normal_residuals=5e-3,
            environment=5e-3,
            means_fall_until=1.0,
        ),
    ),
)

_MATERIAL_REFGS = replace(
    _REF_GAUSSIAN,
    preset="material-refgs",
    splats=replace(
        _REF_GAUSSIAN.splats,
        surfels=replace(_REF_GAUSSIAN.splats.surfels, shading="material-refgs"),
        loss=replace(_REF_GAUSSIAN.splats.loss, lambda_normal_consistency=0.0, lambda_silhouette=0.01),
        density=replace(
            _REF_GAUSSIAN.splats.density,
            stop=30000 / 50000,
            propagate_from=3000 / 50000,
            propagate_until=30000 / 50000,
        ),
    ),
)

METHODS: dict[str, FitConfig] = {
    "paper": _PAPER,
    "3dgs-dr": _3DGS_DR,
    "gaussian-shader": _GAUSSIAN_SHADER,
    "ref-gaussian": _REF_GAUSSIAN,
    "material-refgs": _MATERIAL_REFGS,
    "material-refgs-silhouette": replace(
        _MATERIAL_REFGS,
        preset="material-refgs-silhouette",
        splats=replace(
            _MATERIAL_REFGS.splats,
            loss=replace(_MATERIAL_REFGS.splats.loss, lambda_silhouette=1.0, silhouette_until=3000 / 45000),
        ),
    ),
    "paper-rho-weighted": replace(
        _PAPER,
        preset="paper-rho-weighted",
        splats=replace(_PAPER.splats, loss=replace(_PAPER.splats.loss, roughness_weighted=True)),
    ),
    "paper-no-silhouette": replace(
        _PAPER,
        preset="paper-no-silhouette",
        splats=replace(_PAPER.splats, loss=replace(_PAPER.splats.loss, lambda_silhouette=0.0)),
    ),
    "paper-no-normal": replace(
        _PAPER,
        preset="paper-no-normal",
        splats=replace(_PAPER.splats, loss=replace(_PAPER.splats.loss, lambda_normal_consistency=0.0)),
    ),
}
