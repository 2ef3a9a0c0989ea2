"""What photographs get wrong, by what a geometry explains of them: exposures that differ, masks that are off, and a
lens that is.

They are believed to be right until held-out views speak against it.
"""

from dataclasses import replace

from panoless.capture.encoding import encoding_of
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.geometry.base import Family
from panoless.selection.exposures import earned_exposures, equal_exposures, examined, fitted_to_equal_exposures
from panoless.selection.fitted import Fitted, Refit
from panoless.selection.held_out import held_out_parts
from panoless.selection.lens import with_lens
from panoless.selection.mask_offset import masks_are_doubted, with_moved_masks


def with_corrections(source: Family, views: Views, first: Fitted, config: FitConfig, refit: Refit) -> Fitted:
    """A fit, or another of corrected photographs where held-out views are clearly better explained by it.

    `source` makes the proposals of the kind. Exposures come first: they need no other geometry to be told. The lens
    comes last, and only of fits that explain the photographs with masks and exposures as they are: what is left
    of other errors pulls at it as well.
    """
    options, best = config.corrections, first
    if options.masks == options.exposure == options.lens == "off" or held_out_parts(views) is None:
        return first
    errors, equal = examined(views, first, config), None
    if options.exposure == "auto" and not encoding_of(config).high_dynamic_range:
        equal = earned_exposures(views, first, errors, config)
    if equal is not None:
        best, errors = replace(first, corrections=equal[0]), equal[1]
    if options.masks == "auto" and masks_are_doubted(views, best.geometry, errors, config):
        best = with_moved_masks(source, views, best, config, refit)
    is_as_said = best.corrections.gains is None and not best.corrections.mask_offset_px
    is_explained = errors.mean() <= config.selection.largest_error
    if options.lens == "on" or (options.lens == "auto" and is_as_said and is_explained):
        best = with_lens(views, best, config, refit)
    if best.corrections.gains is None:
        return best
    if best.geometry is first.geometry:
        best = fitted_to_equal_exposures(views, best, config, refit)
    return replace(best, corrections=equal_exposures(views, best, config))
