"""Presets: configurations as data."""

from dataclasses import replace

from panoless.config import DensityConfig, EnvironmentConfig, FitConfig, LossConfig, RateConfig, SurfelConfig
from panoless.geometry.free_form.options import FreeFormOptions, FreeFormRound

_PAPER = FitConfig(
    preset="paper",
    model="surfels",
    iterations=45_000,
    albedo=True,
    alpha_applied="paper",
    crop_margin_px=-1,
    visibility="online",
    scene_radius="cameras",
    surfels=SurfelConfig(initial="random", count=100_000, curved=False),
    environment=EnvironmentConfig(activation="sigmoid", warmup=0.0, solve=False),
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
)


PRESETS: dict[str, FitConfig] = {
    "fast": FitConfig(
        preset="fast",
        iterations=300,
        downscale=2,
        least_object_px=96.0,
        surfels=SurfelConfig(count=3000, hull_resolution=64),
        environment=EnvironmentConfig(resolution=64, rays=2_000_000),
        free_form=FreeFormOptions(
            rounds=(
                FreeFormRound(20, 16, 0.30, 1, 20_000, 100.0, 4),
                FreeFormRound(20, 32, 0.20, 1, 30_000, 100.0, 3),
                FreeFormRound(28, 64, 0.15, 4, 40_000, 30.0, 3),
            ),
            finer=(),
        ),
    ),
    "default": FitConfig(),
    "best": FitConfig(
        preset="best",
        iterations=8000,
        surfels=SurfelConfig(count=12_000, hull_resolution=128),
        environment=EnvironmentConfig(resolution=256),
    ),
    "paper": _PAPER,
    "paper-rho-weighted": replace(
        _PAPER, preset="paper-rho-weighted", loss=replace(_PAPER.loss, roughness_weighted=True)
    ),
    "paper-no-silhouette": replace(
        _PAPER, preset="paper-no-silhouette", loss=replace(_PAPER.loss, lambda_silhouette=0.0)
    ),
    "paper-no-normal": replace(
        _PAPER, preset="paper-no-normal", loss=replace(_PAPER.loss, lambda_normal_consistency=0.0)
    ),
}
