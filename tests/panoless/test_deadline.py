"""A time limit ends what improves, completes what it has, and leaves checkpoints to go on from."""

from pathlib import Path

import pytest

from panoless.deadline import improving, is_past_limit, time_limit
from panoless.journal import journal_in, remembered

calls: list[str] = []


@pytest.fixture(autouse=True)
def _none_called() -> None:
    calls.clear()


@remembered()
def step(value: int) -> int:
    calls.append(f"step {value}")
    return value + 1


@remembered()
def improved(value: int, steps: int) -> int:
    with improving():
        for _ in range(steps):
            value = step(value)
    return value


def test_without_a_limit_every_step_is_taken() -> None:
    with time_limit(None):
        assert improved(0, 3) == 3
    assert not is_past_limit()


def test_past_the_limit_only_what_completes_is_computed(tmp_path: Path) -> None:
    with journal_in(tmp_path), time_limit(0.0):
        assert improved(5, 3) == 5
        assert step(5) == 6
        assert is_past_limit()


def test_what_a_limit_cut_is_computed_again_by_the_next_run(tmp_path: Path) -> None:
    with journal_in(tmp_path):
        step(0)
    with journal_in(tmp_path), time_limit(0.0):
        assert improved(0, 3) == 0
    with journal_in(tmp_path):
        assert improved(0, 3) == 3
    assert calls == ["step 0", "step 1", "step 2"]


def test_the_innermost_block_ends() -> None:
    reached = []
    with time_limit(0.0), improving():
        with improving():
            step(0)
            reached.append("after a checkpoint of the inner block")
        reached.append("after the inner block")
        step(0)
        reached.append("after a checkpoint")
    assert reached == ["after the inner block"]
