"""A command that is printed can be pasted, whatever its paths are called."""

import re
import shlex
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from shinypartial.core.command_line import command_line
from tests.architecture.source import source_texts

#: Words of a command in a text with a place in braces; those in suites are run, and names of theirs have no spaces.
UNQUOTED = re.compile(r"\b(?:panoless|shinypartial) [a-z-]+ [^\"'`]*\{(?!\{)")


@given(st.lists(st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"])), min_size=1))
def test_a_shell_reads_back_the_words(words: list[str]) -> None:
    assert shlex.split(command_line(*words)) == words


def test_plain_words_stay_plain() -> None:
    assert command_line("panoless", "fit", Path("datasets/vase")) == "panoless fit datasets/vase"
    assert command_line("panoless", "fit", Path("chrome pot")) == "panoless fit 'chrome pot'"


def test_no_command_is_put_together_without_quotes() -> None:
    texts = [source for path, source in source_texts().items() if "suites" not in path.parts]
    found = [line.strip() for source in texts for line in source.splitlines() if UNQUOTED.search(line)]
    assert not [line for line in found if "bundled_names" not in line and "--dataset {DATA}" not in line]


def test_an_unquoted_command_would_be_seen() -> None:
    assert UNQUOTED.search('print(f"Next: panoless fit {self.output}")')
