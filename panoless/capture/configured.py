"""The views that a configuration asks for."""

from dataclasses import replace

from panoless.capture.contrast import exposed, exposure_of
from panoless.capture.encoding import encoding_of
from panoless.capture.repair import with_repaired_masks
from panoless.capture.views import Views, load_views
from panoless.config import FitConfig, works_in_unit_range
from shinypartial.dataset.schema import Dataset


def configured_views(dataset: Dataset, config: FitConfig) -> tuple[Views, FitConfig]:
    """The training split as a configuration wants to see it, its masks repaired, and that configuration with the
    exposure that it left open.

    Where options work in [0, 1] photographs stay as they are, and in a high dynamic range, which knows no brightest
    radiance.
    """
    encoding = encoding_of(config)
    views = load_views(
        dataset,
        config.crop_margin_px,
        config.downscale,
        encoding,
        least_object_px=config.least_object_px,
        known_radius=config.sphere.radius,
    )
    if config.exposure == 0:
        as_it_is = encoding.high_dynamic_range or works_in_unit_range(config)
        config = replace(config, exposure=1.0 if as_it_is else exposure_of(views, config.contrast))
        views = exposed(views, config.exposure)
    return with_repaired_masks(views, config.mask_repair), config
