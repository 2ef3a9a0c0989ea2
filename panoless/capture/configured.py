"""The views that a configuration asks for."""

from panoless.capture.encoding import encoding_of
from panoless.capture.repair import with_repaired_masks
from panoless.capture.views import Views, load_views
from panoless.config import FitConfig
from shinypartial.dataset.schema import Dataset


def configured_views(dataset: Dataset, config: FitConfig) -> Views:
    """The training split as a configuration wants to see it, its masks repaired."""
    views = load_views(
        dataset,
        config.crop_margin_px,
        config.downscale,
        encoding_of(config),
        least_object_px=config.least_object_px,
        known_radius=config.sphere.radius,
    )
    return with_repaired_masks(views, config.mask_repair)
