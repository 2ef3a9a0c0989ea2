"""Presets: configurations as data."""

from panoless.config import EnvironmentConfig, FitConfig
from panoless.first_surface.options import FirstSurfaceOptions
from panoless.geometry.free_form.options import FreeFormOptions
from panoless.splats.options import SplatConfig, SurfelConfig
from panoless.splats.presets import METHODS

PRESETS: dict[str, FitConfig] = {
    "fast": FitConfig(
        preset="fast",
        downscale=0,
        splats=SplatConfig(iterations=300, surfels=SurfelConfig(count=3000)),
        first_surface=FirstSurfaceOptions(hull_resolution=64),
        environment=EnvironmentConfig(resolution=64, rays=2_000_000),
        free_form=FreeFormOptions(finest_cells=28),
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
