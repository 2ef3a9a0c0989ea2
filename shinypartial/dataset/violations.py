"""Violations of the format: which file, what is wrong with it and what to do."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from shinypartial.core.errors import InputError

REMAKE = "Delete the file and run the `shinypartial generate` that made the folder again."


@dataclass(frozen=True)
class Violation:
    """A rule of the format that a folder violates; a warning violates none, but is worth a look."""

    file: str
    problem: str
    remedy: str
    warning: bool = False


def mask_violations(file: str, inside: Bool[np.ndarray, "H W"], if_empty: str, if_cut: str) -> Iterator[Violation]:
    """Of a mask without the object, and a warning of one at the border; with the remedy for each."""
    if not inside.any():
        yield Violation(file, "the mask is empty: the object is not in the picture", if_empty)
    elif inside[[0, -1]].any() or inside[:, [0, -1]].any():
        yield Violation(file, "the object touches the border of the picture", if_cut, warning=True)


def violation_of(file: str, error: InputError, remedy: str = REMAKE) -> Violation:
    """The violation that a failed reading of `file` is."""
    return Violation(file, f"expected {error.expected}, found {error.found}", remedy)
