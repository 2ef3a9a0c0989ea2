"""The source tree as the architecture tests see it."""

import ast
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("shinypartial", "panoless")
#: Methods of torch.autograd.Function, whose meaning torch documents.
TORCH_INTERFACE = ("forward", "backward")


def source_files(root: Path = ROOT) -> list[Path]:
    """Every Python file of both packages."""
    return sorted(path for package in PACKAGES for path in (root / package).rglob("*.py"))


def source_texts() -> dict[Path, str]:
    """The content of every Python file of both packages."""
    return {path: path.read_text(encoding="utf-8") for path in source_files()}


#: Of a source text, of which several tests read the same.
parsed = cache(ast.parse)


@cache
def imported_names(source: str) -> frozenset[str]:
    """Top-level names of all modules that a source text imports, wherever and however it does."""
    names: set[str] = set()
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.split(".")[0])
        elif isinstance(node, ast.Call) and _called(node) in ("import_module", "__import__"):
            names |= {str(a.value).split(".")[0] for a in node.args if isinstance(a, ast.Constant)}
    return frozenset(names)


def _called(node: ast.Call) -> str:
    """The last part of the name of what is called."""
    return str(getattr(node.func, "attr", getattr(node.func, "id", "")))


def undocumented(source: str) -> Iterator[str]:
    """Public modules, classes, functions and methods without a docstring.

    Names with an underscore are private, also what lies within them; functions inside functions are details.
    """
    tree = parsed(source)
    if not ast.get_docstring(tree):
        yield "the module"
    yield from _undocumented_below(tree, "")


def _undocumented_below(parent: ast.Module | ast.ClassDef, prefix: str) -> Iterator[str]:
    for node in parent.body:
        if not isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) or node.name.startswith("_"):
            continue
        if not ast.get_docstring(node) and node.name not in TORCH_INTERFACE:
            yield prefix + node.name
        if isinstance(node, ast.ClassDef):
            yield from _undocumented_below(node, f"{prefix}{node.name}.")


def code_names(tree: ast.Module) -> set[str]:
    """Every name in the code of a module, modules that it imports, and words that are whole strings; not docstrings."""
    names: set[str] = set()
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name) | ast.keyword(arg=str(name)):
                names.add(name)
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                names.add(name)
            case ast.ImportFrom() | ast.Import():
                imported = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
                names.update(part for each in imported for part in each.split("."))
            case ast.Constant(value=str(text)) if text.isidentifier():
                names.add(text)
    return names


def names_in_docstrings(tree: ast.Module) -> Iterator[tuple[str, str, bool]]:
    """Where a docstring stands, a name like `this` or `This.one` in it, and whether it is that of a class."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            for name in re.findall(r"`(?:[A-Z][a-z]\w*\.)?([a-z_]\w*)`", ast.get_docstring(node) or ""):
                yield getattr(node, "name", "the module"), name, isinstance(node, ast.ClassDef)


def unknown_in_docstrings(sources: Mapping[str, str]) -> Iterator[str]:
    """Names in docstrings that no code knows: for a class the code of its module, for others that of any module."""
    trees = {module: parsed(source) for module, source in sources.items()}
    own = {module: code_names(tree) for module, tree in trees.items()}
    everywhere = set().union(*own.values(), *(module.split(".") for module in sources))
    for module, tree in trees.items():
        for place, name, of_class in names_in_docstrings(tree):
            if name not in (own[module] if of_class else everywhere):
                yield f"{module}: {place}: {name}"
