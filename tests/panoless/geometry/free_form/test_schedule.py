"""Which rounds options leave."""

from dataclasses import replace

from panoless.geometry.free_form.options import FreeFormOptions
from panoless.geometry.free_form.schedule import COARSE, DETAILED, FINER, FINEST, REFIT, Schedule


def test_the_default_options_leave_all_rounds() -> None:
    assert Schedule.of(FreeFormOptions()) == Schedule()


def test_no_usual_round_has_more_cells_than_the_finest_grid() -> None:
    """But for the first, which is always taken."""
    for cells in (1, 20, 27, 28, 41, 42, 59, 60):
        schedule = Schedule.of(FreeFormOptions(finest_cells=cells))
        assert all(each.cells <= cells for each in (*schedule.coarse[1:], *schedule.finer, *schedule.refit))
    assert len(Schedule.of(FreeFormOptions(finest_cells=1)).coarse) == 1


def test_a_grid_of_28_cells_leaves_out_the_finer_rounds_alone() -> None:
    """Those after details among them. And the others differ by their pixels only."""
    schedule = Schedule.of(FreeFormOptions(finest_cells=28))
    pixels = [each.rays for each in COARSE]
    assert tuple(replace(each, rays=rays) for each, rays in zip(schedule.coarse, pixels, strict=True)) == COARSE
    whole = replace(schedule, coarse=COARSE, finer=FINER, refit=REFIT, detailed=DETAILED, finest=FINEST)
    assert whole == Schedule()
    assert max(each.cells for each in schedule.detailed) == 60
    assert schedule.finest == ()
    assert schedule.finer == ()


def test_what_is_not_looked_for_has_no_rounds() -> None:
    assert Schedule.of(FreeFormOptions(concavities=False)) == Schedule(concave=())
    assert Schedule.of(FreeFormOptions(starts=False)) == Schedule(descent=(), detailed=(), finest=())
