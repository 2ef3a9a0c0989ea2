"""Presets: configurations as data."""

from panoless.config import EnvironmentConfig, FitConfig
from panoless.first_surface.options import FirstSurfaceOptions
from panoless.geometry.free_form.options import FreeFormOptions, FreeFormRound
from panoless.splats.options import SplatConfig, SurfelConfig
from panoless.splats.presets import METHODS

PRESETS: dict[str, FitConfig] = {
    "fast": FitConfig(
        preset="fast",
        downscale=0,
        splats=SplatConfig(iterations=300, surfels=SurfelConfig(count=3000)),
        first_surface=FirstSurfaceOptions(hull_resolution=64),
        environment=EnvironmentConfig(resolution=64, rays=2_000_000),
        free_form=FreeFormOptions(
            rounds=(
                FreeFormRound(20, 16, 0.30, 1, 20_000, 100.0, 5, outline_gain=9.0),
                FreeFormRound(28, 64, 0.80, 4, 40_000, 30.0, 8, outline_gain=9.0),
                FreeFormRound(28, 64, 0.15, 4, 40_000, 30.0, 4, solver_steps=20),
            ),
            finer=(),
        ),
    ),
    "default": FitConfig(),
    "best": FitConfig(
        preset="best",
        splats=SplatConfig(iterations=8000, surfels=SurfelConfig(count=12_000)),
        first_surface=FirstSurfaceOptions(hull_resolution=128),
        environment=EnvironmentConfig(resolution=256),
    ),
    **METHODS,
}
