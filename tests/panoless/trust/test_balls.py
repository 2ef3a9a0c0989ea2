"""Captures of balls are judged by their rim and what lies beside it, not by what unknown shapes are doubted for."""

from dataclasses import replace

import pytest

from panoless.trust.evidence import Evidence
from panoless.trust.verdict import judge

GOOD = Evidence(
    unexplained=0.05,
    one_color=0.5,
    matte=0.5,
    unexplained_part=0.0,
    noise=0.01,
    error_in_noise=1.0,
    silhouette_px=0.1,
    view_shift_px=0.1,
    view_shift_deg=0.01,
    overlap=0.99,
    missed=0.0,
    left_out=0.0,
    saturated=0.0,
    coverage=0.99,
    rank_correlation=-0.5,
    camera_turn_deg=0.0,
    views=4,
    viewed=0.9,
    rim_px=0.1,
    agreement=0.6,
)
SINGLE = replace(GOOD, unexplained=None, one_color=None, matte=None, unexplained_part=None, views=1, viewed=0.1)


def test_a_single_photograph_of_a_ball_is_trusted_by_its_rim() -> None:
    """No view is left to hold out, and it sees one side: the rim and what lies beside it decide."""
    found = judge(SINGLE)
    assert found.verdict == "trust"
    assert found.reason == (
        "the rim of the ball is a circular cone to 0.1 px, and what lies beside it is what it mirrors (0.60)"
    )
    assert judge(replace(SINGLE, rim_px=None)).verdict == "do not trust"


def test_a_ball_is_not_doubted_for_what_only_unknown_shapes_are() -> None:
    assert judge(replace(GOOD, matte=0.06, viewed=0.05, view_shift_px=5.0, missed=0.5)).verdict == "trust"
    assert judge(replace(GOOD, rim_px=None, viewed=0.05)).verdict != "trust"


@pytest.mark.parametrize(
    ("figures", "reason"),
    [
        ({"rim_px": 30.0}, "rim of the ball is 30 px off a circular cone"),
        ({"agreement": 0.0}, "what lies beside the ball is not what it mirrors"),
        ({"agreement": -0.4}, "what lies beside the ball is not what it mirrors"),
    ],
)
@pytest.mark.parametrize("evidence", [SINGLE, GOOD])
def test_a_wrong_ball_is_not_trusted(evidence: Evidence, figures: dict[str, float], reason: str) -> None:
    found = judge(replace(evidence, **figures))
    assert found.verdict == "do not trust"
    assert reason in found.reason
    assert "capture/ball.jpg" in found.remedy


def test_a_single_ball_whose_surroundings_tell_nothing_is_trusted_in_part() -> None:
    """A plain background says neither yes nor no; several photographs explain one another."""
    found = judge(replace(SINGLE, agreement=None))
    assert (found.verdict, found.reason) == ("partly", "nothing beside the ball says whether it mirrors")
    assert judge(replace(GOOD, agreement=None)).verdict == "trust"


def test_what_is_unexplained_of_a_ball_stands_near_it() -> None:
    found = judge(replace(GOOD, unexplained=0.9))
    assert found.verdict != "trust"
    assert "low visibility" in found.remedy
