"""Who may import whom: the contracts of pyproject.toml hold, imports are free, and both checks can fail."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.architecture.source import PACKAGES, ROOT, imported_names, source_texts

HEAVY = ("bpy", "torch", "numba", "matplotlib", "scipy", "skimage", "OpenEXR", "PIL", "cv2", "pycolmap")
FREE_MODULES = ("shinypartial", "shinypartial.cli", "panoless", "panoless.cli")
IMPORT_LIMIT_S = 0.3


def check_contracts(root: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter on the packages below `root` with the contracts of its pyproject.toml."""
    program = "import sys; from importlinter.cli import lint_imports_command; lint_imports_command()"
    return subprocess.run(
        [sys.executable, "-c", program, "--no-cache"],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_contracts_are_kept() -> None:
    result = check_contracts(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.fixture
def copied_tree(tmp_path: Path) -> Path:
    """A copy of both packages and their contracts."""
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


FORBIDDEN = {
    "the benchmark imports the method": ("shinypartial/evaluation/evaluate.py", "import panoless.config"),
    "a fit sees its scores": ("panoless/reconstruct/fit.py", "import shinypartial.metrics"),
    "a fit sees its scores through another module": (
        "panoless/splats/losses.py",
        "import shinypartial.evaluation.scores",
    ),
    "bpy outside its room": ("shinypartial/dataset/read.py", "import bpy"),
    "torch in the core": ("shinypartial/core/sphere.py", "import torch"),
    "Blender writes the dataset": ("shinypartial/blender/render.py", "import shinypartial.dataset.write"),
    "metrics read files": ("shinypartial/metrics/image.py", "import shinypartial.io.images"),
    "kernels import a room": ("panoless/kernels/constants.py", "import panoless.splats.model"),
    "kernels import the benchmark": ("panoless/kernels/constants.py", "import shinypartial.core.sphere"),
    "a kind imports splatting": ("panoless/geometry/plane/kind.py", "import panoless.splats.model"),
    "kernels of splatting import a room": ("panoless/splats/kernels/constants.py", "import panoless.capture.views"),
    "the core looks up": ("shinypartial/core/conventions.py", "import shinypartial.io.files"),
}


def test_forbidden_imports_are_reported(copied_tree: Path) -> None:
    """Each by itself, though all are in one tree."""
    for place, statement in FORBIDDEN.values():
        path = copied_tree / place
        path.write_text(f"{path.read_text()}\n\ndef _later() -> None:\n    {statement}\n")
    result = check_contracts(copied_tree)
    assert result.returncode == 1, result.stdout + result.stderr
    for name, (place, statement) in FORBIDDEN.items():
        importer = place.removesuffix(".py").replace("/", ".")
        assert f"{importer} -> {statement.removeprefix('import ')} (l." in result.stdout, name


def test_a_module_without_a_place_is_reported(copied_tree: Path) -> None:
    (copied_tree / "shinypartial" / "newcomer.py").write_text('"""New."""\n')
    result = check_contracts(copied_tree)
    assert result.returncode == 1
    assert "newcomer" in result.stdout


def loaded_after(statement: str) -> set[str]:
    """Which heavy packages a fresh interpreter has loaded after a statement."""
    program = f"import sys\n{statement}\nprint(*({HEAVY!r} & sys.modules.keys()))"
    program = program.replace(repr(HEAVY), repr(set(HEAVY)))
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(result.stdout.split())


@pytest.mark.parametrize("module", FREE_MODULES)
def test_importing_loads_nothing_heavy(module: str) -> None:
    assert loaded_after(f"import {module}") == set()


def test_a_heavy_import_would_be_seen() -> None:
    assert "PIL" in loaded_after("import shinypartial, PIL.Image")


def test_importing_the_benchmark_is_fast() -> None:
    program = "import time; t = time.perf_counter(); import shinypartial; print(time.perf_counter() - t)"
    command = [sys.executable, "-c", program]
    times = [float(subprocess.check_output(command, cwd=ROOT)) for _ in range(3)]
    assert min(times) < IMPORT_LIMIT_S


def test_importing_prints_nothing_and_changes_the_environment_by_one_documented_variable() -> None:
    """`panoless` gives OpenBLAS one thread, which has to be said before numpy is loaded."""
    said = "import os; os.environ.setdefault('OPENBLAS_NUM_THREADS', '1'); before = dict(os.environ)"
    program = said + "\n{}\nassert dict(os.environ) == before"
    imports = "\n".join(f"import {module}" for module in FREE_MODULES)
    command = [sys.executable, "-W", "error", "-c", program.format(imports)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def test_only_the_blender_room_names_bpy() -> None:
    room = ROOT / "shinypartial" / "blender"
    naming = [path for path, source in source_texts().items() if "bpy" in imported_names(source)]
    assert [path for path in naming if not path.is_relative_to(room)] == []


def test_an_import_inside_a_function_would_be_seen() -> None:
    assert imported_names("def f():\n    from bpy.types import Object\n    import torch.nn") == {"bpy", "torch"}
    assert "bpy" in imported_names("import importlib\nbpy = importlib.import_module('bpy')")
