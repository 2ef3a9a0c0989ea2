"""The views that a configuration requires."""

from dataclasses import replace

from panoless.capture.background import load_background
from panoless.capture.contrast import exposed, exposure_of
from panoless.capture.encoding import encoding_of
from panoless.capture.repair import with_repaired_masks
from panoless.capture.views import Views, load_views
from panoless.config import FitConfig, can_be_exposed
from shinypartial.dataset.read import read_ball_evidence
from shinypartial.dataset.schema import BallEvidence, Dataset

PHOTOGRAPHER_DEG = 30.0
"""About each camera, seen from a ball: who holds it reaches so far, legs included, in 37 photographs of a lobby."""
COARSE_DOWNSCALE = 2
"""Side of the blocks of pixels where none is configured…"""
LEAST_OBJECT_PX = 96.0
"""…and fewest blocks across the object, the root of its area, for which they are that large."""
FEW_VIEWS = 5
"""Of a ball, from which one can be spared to judge how near the surroundings are."""


def of_ball(config: FitConfig, ball: BallEvidence, views: int) -> FitConfig:
    """The configuration of a fit to a capture of a polished ball from so many views."""
    corrections = replace(config.corrections, poses="off", masks="off", lens="off")
    if ball.exposures_known:
        corrections = replace(corrections, exposure="off")
    surroundings = config.surroundings
    if views < FEW_VIEWS and surroundings.mode == "auto":
        surroundings = replace(surroundings, mode="off")
    return replace(
        config,
        model="sphere",
        corrections=corrections,
        surroundings=surroundings,
        material=replace(config.material, roughness="off", blur="off", scattering="off"),
        sphere=replace(config.sphere, operator_deg=PHOTOGRAPHER_DEG),
    )


def configured_views(dataset: Dataset, config: FitConfig) -> tuple[Views, FitConfig]:
    """The training split as a configuration wants to see it, its masks repaired, and that configuration with the
    exposure that it left open.

    Photographs stay as they are where options don't bear another exposure. A capture of a ball knows its shape and its
    cameras, by its rim and what it mirrors: nothing of that is chosen.
    """
    ball = read_ball_evidence(dataset)
    if config.model in ("auto", "sphere") and ball is not None:
        config = of_ball(config, ball, len(dataset.train))
    views = load_views(
        dataset,
        config.crop_margin_px,
        config.downscale or COARSE_DOWNSCALE,
        encoding_of(config),
        least_object_px=0.0 if config.downscale else LEAST_OBJECT_PX,
        known_radius=config.sphere.radius,
    )
    if ball is not None and ball.background:
        views = replace(views, background=load_background(dataset, encoding_of(config)))
    exposure = config.exposure
    if exposure == 0:
        exposure = exposure_of(views) if can_be_exposed(config) else 1.0
    config = replace(config, exposure=exposure)
    views = exposed(views, exposure)
    return (views if config.corrections.repair == "off" else with_repaired_masks(views)), config
