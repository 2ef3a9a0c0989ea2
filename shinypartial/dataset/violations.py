"""A broken promise of the format: which file, what is wrong with it and what to do."""

from dataclasses import dataclass

from shinypartial.core.errors import InputError

REMAKE = "Delete the file and run the `shinypartial generate` that made the folder again."


@dataclass(frozen=True)
class Violation:
    """A promise of the format that a folder breaks; a warning is lawful but worth a look."""

    file: str
    problem: str
    remedy: str
    warning: bool = False


def violation_of(file: str, error: InputError, remedy: str = REMAKE) -> Violation:
    """The break that a failed reading of `file` amounts to."""
    return Violation(file, f"expected {error.expected}, found {error.found}", remedy)
