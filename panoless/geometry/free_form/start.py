"""The level set that a fit starts from: of a few plates between contacts, the one that makes pixels agree best."""

from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.first_surface.completion import completed, trusted_hull
from panoless.first_surface.mesh import TriangleMesh
from panoless.first_surface.visual_hull import carve_hull
from panoless.geometry.free_form.concave import Scored
from panoless.geometry.free_form.observations import solid_pixels
from panoless.geometry.free_form.surface import LevelSet, level_set_of


def first_level_set(views: Views, config: FitConfig) -> LevelSet:
    """The first surface as a level set, under the tension of the plate that leaves least disagreement.

    Outlines don't tell how far an object bulges between their contacts: a stone does, a box does not. Candidates are
    solved once, without what holds them inside the hull, which hardly changes their disagreement.
    """
    options, first = config.free_form, config.first_surface
    known = trusted_hull(
        carve_hull(views, config.surfels.hull_resolution, config.surfels.hull_votes, first), views, first
    )

    def level_set(mesh: TriangleMesh) -> LevelSet:
        return level_set_of(mesh, options.start_cells, options.margin)

    pixels = solid_pixels(views, options.start_pixels)
    inner = pixels.inner_px > options.inner_px
    scored = Scored(pixels.rays.chosen(inner), pixels.radiance[inner], options.concave)

    def disagreement(tension: float) -> float:
        candidate = level_set(completed(known, first, tension, rounds=1))
        return scored(candidate, options.concave.resolutions[-1])

    tensions = options.start_tensions
    tension = min(tensions, key=disagreement) if len(tensions) > 1 and inner.any() else tensions[0]
    return level_set(completed(known, first, tension))
