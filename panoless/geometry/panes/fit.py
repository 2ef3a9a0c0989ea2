"""Panes from photographs: heights in rounds from coarse maps to fine ones, joints between the rounds."""

from panoless.capture.views import Views
from panoless.geometry.height_field.fit import refined
from panoless.geometry.panes.joints import located
from panoless.geometry.panes.model import Panes
from panoless.problem.equations import Round
from shinypartial.io.progress import Progress

REACH = 0.1
"""Joints move by at most this share of the narrowest pane between rounds."""
FINER = 2
"""The round from which heights have two degrees more."""
ROUNDS = (
    Round(64, 0.15, 120_000, 4),
    Round(128, 0.1, 120_000, 3),
    *(Round(256, 0.1, count, 4) for count in (250_000, 500_000, 1_000_000)),
)
"""Panes are few numbers, so that few pixels determine them under coarse maps. Coarser maps than the last flatten panes
that alone see a part of the surroundings."""


def fit_panes(views: Views, panes: Panes) -> Panes:
    """Heights and joints that explain silhouettes and photographs best, from a start that is near."""
    progress = Progress("fitting panes", len(ROUNDS))
    for each in ROUNDS:
        if each is ROUNDS[FINER]:
            panes = panes.with_halved_cells()
        panes = located(views, refined(views, panes, each), each, REACH * panes.narrowest)
        progress.advance()
    return panes
