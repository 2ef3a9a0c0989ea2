"""Pages, messages and docstrings avoid the worst habits of the style page: words that have a technical term instead."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HABITS = re.compile(
    r"(?<![.\w])(tells?|telling|told|asks?|asked|believes?|believed|anew|no say)\b(?!\()", re.IGNORECASE
)
LEFT_OUT = {ROOT / "docs" / "reference" / "style.md"}
"""It shows them, beside what to write."""


def lines() -> list[tuple[Path, int, str]]:
    """Of README, pages and packages."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    modules = (path for package in ("panoless", "shinypartial") for path in (ROOT / package).rglob("*.py"))
    return [
        (path, number, line)
        for path in sorted({*pages, *modules} - LEFT_OUT)
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
    ]


def test_no_line_has_a_word_for_which_the_field_has_a_term() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}" for path, number, line in lines() if HABITS.search(line)
    ]
    assert not found, "\n".join(found)
