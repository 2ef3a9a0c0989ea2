"""Recipes small enough to render within a second, and a world that is colored by direction."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from shinypartial.core.sphere import latlong_directions
from shinypartial.io.images import write_exr_rgb
from shinypartial.scene import SceneSpec, load_scene

WORLD_HEIGHT = 64
RECIPE = """
format = 1
name = "tiny"
title = "A small mirror"
provenance = "Made for tests."
license = "CC0-1.0"
split = "development"
object = {object}
world = {{ kind = "file", path = "world.exr", license = "CC0-1.0", source = "computed" }}
camera = {{ radius = 4.0, facing_azimuth_deg = {facing}, azimuth_deg = {azimuth}, elevation_deg = {elevation}, \
sweeps = {sweeps}, train = {train}, test = {test} }}
render = {{ samples = {samples}, resolution = {resolution} }}
"""
SPHERE = '{ kind = "sphere", radius = 1.0, segments = 128, rings = 64 }'


def direction_colors(height: int) -> Float[np.ndarray, "H 2*H 3"]:
    """A lat-long world whose color is (d + 1)/2 of its direction d: no two directions look alike."""
    return ((latlong_directions(height) + 1) / 2).astype(np.float32)


def write_recipe(
    folder: Path,
    shape: str = SPHERE,
    facing: float = 0.0,
    azimuth: str = "[-60, 60]",
    elevation: str = "[10, 30]",
    sweeps: int = 2,
    train: int = 2,
    test: int = 2,
    samples: int = 4,
    resolution: int = 16,
) -> Path:
    """Write scene.toml and its world to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_exr_rgb(folder / "world.exr", direction_colors(WORLD_HEIGHT))
    text = RECIPE.format(
        object=shape,
        facing=facing,
        azimuth=azimuth,
        elevation=elevation,
        sweeps=sweeps,
        train=train,
        test=test,
        samples=samples,
        resolution=resolution,
    )
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return folder / "scene.toml"


def tiny_scene(folder: Path, **options) -> SceneSpec:
    """Write a recipe and read it."""
    return load_scene(str(write_recipe(folder, **options)))
