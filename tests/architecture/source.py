"""The source tree as the architecture tests see it."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("shinypartial", "panoless")
#: Methods of torch.autograd.Function, whose meaning torch documents.
TORCH_INTERFACE = ("forward", "backward")


def source_files(root: Path = ROOT) -> list[Path]:
    """Every Python file of both packages."""
    return sorted(path for package in PACKAGES for path in (root / package).rglob("*.py"))


def imported_names(source: str) -> set[str]:
    """Top-level names of all modules that a source text imports, wherever and however it does."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.split(".")[0])
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            names |= {str(a.value).split(".")[0] for a in node.args if isinstance(a, ast.Constant)}
    return names


def undocumented(source: str) -> Iterator[str]:
    """Public modules, classes, functions and methods without a docstring.

    Names with an underscore are private, also what lies within them; functions inside functions are details.
    """
    tree = ast.parse(source)
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
