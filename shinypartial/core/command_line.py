"""Command lines for a person to paste into a shell."""

import shlex
from pathlib import Path


def command_line(*words: str | Path) -> str:
    """The words of a command as one line, quoted where a shell would split or change them."""
    return shlex.join(map(str, words))
