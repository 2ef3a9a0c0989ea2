"""What a fit accepts or refuses is decided in few places, which the reference lists."""

from docs.hooks import decision_table, decisions

MOST_DECISIONS = 10
"""Calls of functions that accept or refuse. It may fall, but not rise."""


def test_decisions_are_few() -> None:
    found = list(decisions())
    assert len(found) <= MOST_DECISIONS, f"{found}: a new decision replaces two."


def test_the_table_has_a_row_for_each() -> None:
    rows = "\n".join(decision_table()).splitlines()[2:]
    assert len(rows) == len(list(decisions())) > 0
    assert any("problem.evidence" in row and "`decided`" in row for row in rows)
