"""Fits in fewer rounds than usual, for tests that compare kinds and not how well these fit."""

from functools import partial

import pytest

from panoless.geometry import exact
from panoless.geometry.revolution import kind as revolution
from panoless.geometry.revolution.fit import refine_revolution
from panoless.problem.solve import ROUNDS, solve


def take_few_rounds(patch: pytest.MonkeyPatch, joint: int, revolutions: int) -> None:
    """So many of the joint solve and of those after it of a surface of revolution, from the coarsest on."""
    patch.setattr(exact, "solve", partial(solve, rounds=ROUNDS[:joint]))
    patch.setattr(revolution, "refine_revolution", partial(refine_revolution, rounds=revolutions))
