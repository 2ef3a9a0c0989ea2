"""Fits of surfels step by step, watched by nobody."""

from collections.abc import Callable

from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.splats.mirror import SurfelMirror
from panoless.splats.start import first_mirror, first_training
from panoless.splats.train import SurfelTrainer
from panoless.splats.training import Training


class Unobserved:
    """An observer that keeps nothing."""

    title = "fitting"

    def after_step(self, iteration: int, seconds: float, current: Callable[[], tuple[SurfelMirror, Training]]) -> None:
        """Nothing."""

    def record(self, point: dict[str, float]) -> None:
        """Nothing."""


def begin(views: Views, config: FitConfig) -> tuple[SurfelMirror, Training]:
    """Surfels and training before the first step."""
    mirror = first_mirror(views, config)
    return mirror, first_training(views, mirror, config)


def new_trainer(views: Views, config: FitConfig) -> SurfelTrainer:
    """A trainer before its first step."""
    return SurfelTrainer(views, *begin(views, config), config, Unobserved())
