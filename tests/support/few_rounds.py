"""Fits in fewer rounds than usual, for tests that ask which kind is taken and not how well it fits."""

from functools import partial

import pytest

from panoless.geometry.height_field import kind as height_field
from panoless.geometry.height_field.fit import ROUNDS, fit_height_field
from panoless.geometry.revolution import kind as revolution
from panoless.geometry.revolution.fit import refine_revolution


def take_few_rounds(patch: pytest.MonkeyPatch, heights: int, revolutions: int) -> None:
    """So many of a height field and of each series of a surface of revolution, from the coarsest on."""
    patch.setattr(height_field, "fit_height_field", partial(fit_height_field, rounds=ROUNDS[:heights]))
    patch.setattr(revolution, "refine_revolution", partial(refine_revolution, rounds=revolutions))
