"""What is remembered in a run folder is computed once, comes back to the last bit, and damage costs time only."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from panoless.capture.corrections import Corrections
from panoless.environment.surroundings import FAR
from panoless.journal import FOLDER, forget, journal_in, remembered, seconds_before
from panoless.selection.candidates import Candidate, Verdict
from shinypartial.io.progress import Progress

calls: list[str] = []


@pytest.fixture(autouse=True)
def _none_called() -> None:
    calls.clear()


@remembered()
def doubled(values: np.ndarray | torch.Tensor, progress: Progress | None = None) -> np.ndarray | torch.Tensor:
    calls.append("doubled")
    return 2 * values


@remembered(lambda values: f"sum of {len(values)}")
def summed(values: np.ndarray) -> float:
    calls.append("summed")
    if not len(values):
        raise KeyboardInterrupt
    return float(doubled(values).sum())


@remembered()
def same(value: object) -> tuple[object, object]:
    calls.append("same")
    return value, value


def entries(run: Path) -> list[Path]:
    return sorted((run / FOLDER).glob("*.pt"))


def test_outside_of_a_run_folder_nothing_is_remembered() -> None:
    assert summed(np.ones(2)) == summed(np.ones(2)) == 4.0
    assert calls == 2 * ["summed", "doubled"]


def test_a_later_run_computes_nothing_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It says what it found, and counts the time that went into that."""
    with journal_in(tmp_path):
        assert summed(np.ones(2)) == 4.0
        assert seconds_before() == 0
    with journal_in(tmp_path):
        assert summed(np.ones(2)) == 4.0
        assert seconds_before() > 0
    assert calls == ["summed", "doubled"]
    assert capsys.readouterr().err == "sum of 2\nsum of 2: found before\n"
    forget(tmp_path)
    assert not (tmp_path / FOLDER).exists()


def test_parts_stay_until_the_whole_is_finished(tmp_path: Path) -> None:
    """What was finished before an interruption is kept; a finished stage needs one file."""
    with journal_in(tmp_path):
        doubled(np.ones(3))
        with pytest.raises(KeyboardInterrupt):
            summed(np.ones(0))
    assert len(entries(tmp_path)) == 1
    with journal_in(tmp_path):
        assert summed(np.ones(3)) == 6.0
    assert calls == ["doubled", "summed", "summed"]
    assert [path.name.split("-")[0] for path in entries(tmp_path)] == ["summed"]


@pytest.mark.parametrize(
    "change",
    [
        lambda values: np.nextafter(values, 2),
        lambda values: values.astype(np.float32),
        lambda values: values[None],
        torch.from_numpy,
    ],
    ids=["last digit", "type", "shape", "tensor"],
)
def test_whatever_differs_is_computed(tmp_path: Path, change) -> None:
    values = np.ones(3)
    with journal_in(tmp_path):
        for each in (values, change(values)):
            doubled(each)
    assert calls == ["doubled", "doubled"]


def test_a_tensor_that_was_changed_in_place_is_another(tmp_path: Path) -> None:
    values = torch.ones(3)
    with journal_in(tmp_path):
        doubled(values)
        values += 1
        assert torch.equal(doubled(values), torch.full((3,), 4.0))


def test_a_line_of_progress_is_nothing_that_is_given(tmp_path: Path) -> None:
    with journal_in(tmp_path):
        doubled(np.ones(3), Progress("one", 3))
        doubled(np.ones(3), Progress("another", 5))
    assert calls == ["doubled"]


@pytest.mark.parametrize("damage", [b"", b"no such file", None])
def test_a_damaged_entry_is_computed_again(tmp_path: Path, damage: bytes | None) -> None:
    with journal_in(tmp_path):
        doubled(np.ones(3))
    (path,) = entries(tmp_path)
    path.write_bytes(path.read_bytes()[:-100] if damage is None else damage)
    for _ in range(2):
        with journal_in(tmp_path):
            assert np.array_equal(doubled(np.ones(3)), np.full(3, 2.0))
    assert calls == ["doubled", "doubled"]


def test_what_is_returned_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    """Of records, enumerations, arrays of any layout, tensors that are parts of others, and numbers of numpy."""

    @dataclass(frozen=True)
    class Unused:
        pass

    candidate = Candidate("plane", Verdict.CHOSEN, "reason", 1 / 3, corrections=Corrections(0.1, np.array([1.1, 0.9])))
    values = np.asfortranarray(np.random.default_rng(0).normal(size=(3, 4)))
    found = [candidate, values, values.T[::2], torch.rand(9, 3)[3], np.float32(0.1), {"a": (True, None)}, FAR]
    made = remembered()(_of_parts)
    with journal_in(tmp_path):
        first = made(found)
    with journal_in(tmp_path):
        second = made([*found])
    assert repr(first) == repr(second)
    assert first is not second
    assert second[0].verdict is Verdict.CHOSEN
    assert second[1].strides == values.strides
    assert type(second[4]) is np.float32
    assert sum(path.stat().st_size for path in entries(tmp_path)) < 20_000
    with journal_in(tmp_path), pytest.raises(TypeError, match="has no name that identifies it"):
        same(Unused())


def _of_parts(given: list) -> list:
    """Copies, so that nothing is what was given."""
    calls.append("parts")
    assert calls == ["parts"]
    candidate, values, part, row, *others, _ = given
    copied = replace(candidate, corrections=replace(candidate.corrections, gains=candidate.corrections.gains + 0))
    return [copied, values.copy(order="K"), part.copy(order="K"), torch.cat([row, row])[:3], *others, replace(FAR)]


def test_an_object_that_was_given_is_the_same_later(tmp_path: Path) -> None:
    """A choice between what was there and what is new is often made by identity."""
    for _ in range(2):
        given = Corrections(0.5)
        with journal_in(tmp_path):
            first, second = same(given)
        assert first is given
        assert second is given
    assert calls == ["same"]
