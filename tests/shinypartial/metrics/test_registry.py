"""Every number that an evaluation can produce is defined once, under an unambiguous name."""

import dataclasses
import types
import typing

import pytest

from shinypartial.evaluation.scores import Counts, LeftOut, Scores, ViewScores
from shinypartial.metrics.direct_views import DirectScores
from shinypartial.metrics.registry import METRICS, PSNR_CEILING_DB, Direction, metric


def score_fields(kind: type) -> set[str]:
    """Names of all fields that hold numbers, in all nested score types."""
    names: set[str] = set()
    for name, hint in typing.get_type_hints(kind).items():
        options = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
        if float in options:
            names.add(name)
        for option in options:
            if dataclasses.is_dataclass(option) and option not in (Counts, LeftOut, ViewScores):
                names |= score_fields(typing.cast(type, option))
    return names


def test_every_score_is_registered_and_every_registered_metric_is_scored() -> None:
    direct = {name if name.startswith("psnr") else f"direct_{name}" for name in score_fields(DirectScores)}
    assert score_fields(Scores) | direct | {"lamp_error_deg"} == {entry.name for entry in METRICS}


def test_names_are_unique_and_never_the_ambiguous_one() -> None:
    names = [entry.name for entry in METRICS]
    assert len(set(names)) == len(names)
    assert not any("mae" in name.split("_") for name in names)


def test_values_print_with_unit_and_ceiling() -> None:
    assert metric("psnr").text(23.456) == "23.46 dB"
    assert metric("psnr").text(PSNR_CEILING_DB) == "≥ 100 dB"
    assert metric("mean_angular_error_deg").text(1.234) == "1.23°"
    assert metric("fraction_within_5deg").text(0.5) == "50.0%"
    assert metric("ssim").text(None) == "–"
    assert metric("psnr").direction is Direction.HIGHER
    with pytest.raises(KeyError):
        metric("mae")
