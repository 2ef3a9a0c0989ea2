"""Presets of the paper's method, its ablations and the compared methods: configurations as data."""

from dataclasses import replace

from panoless.config import EnvironmentConfig, FitConfig
from panoless.splats.options import DensityConfig, LossConfig, SplatConfig, SurfelConfig

_PAPER = FitConfig(
    preset="paper",
    model="surfels",
    crop_margin_px=-1,
    environment=EnvironmentConfig(activation="sigmoid", warmup=0.0, solve=False),
    splats=SplatConfig(
        iterations=45_000,
        rates="published",
        albedo=True,
        alpha_applied="paper",
        visibility="online",
        surfels=SurfelConfig(initial="random", count=100_000, curved=False),
        loss=LossConfig(
            photometric="paper",
            lambda_normal_consistency=0.5,
            silhouette_until=3000 / 45000,
        ),
        density=DensityConfig(enabled=True, max_surfels=200_000),
    ),
)

_REF_GAUSSIAN = replace(
    _PAPER,
    preset="ref-gaussian",
    crop_margin_px=12,
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
        ),
    ),
)

_3DGS_DR = replace(
    _REF_GAUSSIAN,
    preset="3dgs-dr",
    splats=replace(
        _REF_GAUSSIAN.splats,
        iterations=61_000,
        surfels=replace(_REF_GAUSSIAN.splats.surfels, shading="3dgs-dr"),
        loss=replace(_REF_GAUSSIAN.splats.loss, lambda_normal_consistency=0.0),
    ),
)

_GAUSSIAN_SHADER = replace(
    _REF_GAUSSIAN,
    preset="gaussian-shader",
    environment=EnvironmentConfig(activation="clamp", warmup=0.0, solve=False),
    splats=replace(
        _REF_GAUSSIAN.splats,
        iterations=30_000,
        surfels=replace(_REF_GAUSSIAN.splats.surfels, shading="gaussian-shader"),
        loss=replace(_REF_GAUSSIAN.splats.loss, lambda_normal_consistency=0.0),
    ),
)

_MATERIAL_REFGS = replace(
    _REF_GAUSSIAN,
    preset="material-refgs",
    splats=replace(
        _REF_GAUSSIAN.splats,
        surfels=replace(_REF_GAUSSIAN.splats.surfels, shading="material-refgs"),
        loss=replace(_REF_GAUSSIAN.splats.loss, lambda_normal_consistency=0.0, lambda_silhouette=0.01),
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
