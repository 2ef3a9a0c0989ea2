"""Violations of the format: which file, what is wrong with it and what to do."""

from dataclasses import dataclass

from shinypartial.core.errors import InputError

REMAKE = "Delete the file and run the `shinypartial generate` that made the folder again."


@dataclass(frozen=True)
class Violation:
    """A rule of the format that a folder violates; a warning violates none, but is worth a look."""

    file: str
    problem: str
    remedy: str
    warning: bool = False


def violation_of(file: str, error: InputError, remedy: str = REMAKE) -> Violation:
    """The violation that a failed reading of `file` is."""
    return Violation(file, f"expected {error.expected}, found {error.found}", remedy)
