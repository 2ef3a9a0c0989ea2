"""An option is what a user would sweep; any other number is a constant beside its formula."""

import ast
from collections.abc import Iterator
from pathlib import Path

from tests.architecture.source import ROOT, source_files

MOST_FIELDS = 132
"""Of all options of both packages. It may fall, but not rise."""


def fields_of(source: str, *, everywhere: bool) -> Iterator[str]:
    """Class and name of each field of the dataclasses in a source text: of all, or of those with a name for options."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.ClassDef) or not (everywhere or node.name.endswith(("Options", "Config"))):
            continue
        if any("dataclass" in ast.unparse(each) for each in node.decorator_list):
            for item in node.body:
                if isinstance(item, ast.AnnAssign) and "ClassVar" not in ast.unparse(item.annotation):
                    yield f"{node.name}.{ast.unparse(item.target)}"


def has_options(path: Path) -> bool:
    """Whether a module has options by its name."""
    return path.stem in ("options", "config")


def test_options_are_few() -> None:
    found = {
        path: list(fields_of(path.read_text(encoding="utf-8"), everywhere=has_options(path))) for path in source_files()
    }
    counts = {str(path.relative_to(ROOT)): len(names) for path, names in found.items() if names}
    assert sum(counts.values()) <= MOST_FIELDS, f"{counts}: make a number that nobody sweeps a constant."


def test_a_field_would_be_counted() -> None:
    source = "@dataclass(frozen=True)\nclass A:\n    K: ClassVar[int] = 1\n    b: int = 2\nclass C:\n    d: int\n"
    assert list(fields_of(source, everywhere=True)) == ["A.b"]
    assert list(fields_of(source, everywhere=False)) == []
    assert list(fields_of(source.replace("A", "AConfig"), everywhere=False)) == ["AConfig.b"]
