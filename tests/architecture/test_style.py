"""What a reader may rely on: documented names, short modules, file names that say something, checked shapes."""

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from panoless.capture.poses import StatedCameras
from panoless.problem.observations import dual
from tests.architecture.source import ROOT, source_files, source_texts, undocumented, unknown_in_docstrings
from tests.conftest import UNCHECKED, checked_modules

MAX_LINES = 450
EMPTY_NAMES = {"utils", "util", "helpers", "helper", "misc", "common", "stuff"}
#: In docstrings: a library that nothing imports, and a folder of Python's.
NAMES_OF_OTHERS = {"mlcroissant", "__pycache__"}


def test_public_names_have_a_docstring() -> None:
    found = {path: list(undocumented(source)) for path, source in source_texts().items()}
    assert {path: names for path, names in found.items() if names} == {}


def test_a_missing_docstring_would_be_seen() -> None:
    source = "class A:\n    '''Doc.'''\n    def b(self): ...\n    def _c(self): ...\ndef d(): ...\n"
    assert list(undocumented(source)) == ["the module", "A.b", "d"]


def test_docstrings_name_what_is_there() -> None:
    """A class describes no field that it lacks."""
    sources = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): source for path, source in source_texts().items()
    }
    unknown = {line.rpartition(": ")[2]: line for line in unknown_in_docstrings(sources)}
    assert unknown.keys() <= NAMES_OF_OTHERS, unknown


def test_a_field_that_is_gone_would_be_seen() -> None:
    source = "class Ab:\n    '''`b` and `c`.'''\n    b: int\ndef d():\n    '''`e` of `Ab.f`.'''\n"
    found = unknown_in_docstrings({"one": source, "two": "c, e = 1, 2"})
    assert list(found) == ["one: Ab: c", "one: d: f"]


def test_modules_are_short() -> None:
    lines = {path: len(source.splitlines()) for path, source in source_texts().items()}
    long = {path: count for path, count in lines.items() if count > MAX_LINES}
    assert long == {}, "Split them by topic."


def test_file_names_say_what_is_inside() -> None:
    assert [path for path in source_files() if path.stem in EMPTY_NAMES] == []


def test_shapes_can_be_checked() -> None:
    """Postponed annotations are strings, which a runtime check of shapes does not see."""
    postponed = "from __future__ import annotations"
    assert [path for path, source in source_texts().items() if "jaxtyping" in source and postponed in source] == []


def test_tests_check_shapes_of_functions() -> None:
    with pytest.raises(TypeCheckError):
        dual(np.zeros((5, 3, 2)))


def test_tests_check_shapes_of_dataclasses_against_each_other() -> None:
    with pytest.raises(TypeCheckError):
        StatedCameras(np.zeros((4, 3)), np.zeros((5, 3, 3)), ())


def test_tests_check_dtypes() -> None:
    with pytest.raises(TypeCheckError):
        dual(np.zeros((5, 2, 3), dtype=np.int64))


def test_all_but_the_compiled_kernels_are_checked() -> None:
    checked = *checked_modules(), *UNCHECKED

    def is_checked(path: Path) -> bool:
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        return any(module == name or module.startswith(name + ".") for name in checked)

    unchecked = {str(path.relative_to(ROOT / "panoless")) for path in source_files() if not is_checked(path)}
    kernels = "__init__.py", "kernels/__init__.py", "kernels/cpu", "kernels/gpu"
    allowed = (*kernels, *(f"splats/{each}" for each in kernels))
    assert all(name.startswith(allowed) for name in unchecked), unchecked
