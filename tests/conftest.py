"""What every test shares: array shapes checked at each call, reproducible examples, few threads, a dataset to read."""

import os
from itertools import chain
from pathlib import Path

# Read when torch and OpenMP start: several test processes on few cores wait for each other's threads. Set, not only by
# default, because workers inherit the environment of the process that starts them.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"
else:
    os.environ.setdefault("OMP_NUM_THREADS", str(min(4, os.cpu_count() or 1)))
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

ROOT = Path(__file__).resolve().parent.parent
#: As PEP 484 has it, an int will do where a float is requested.
TYPE_CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
#: Numba and Triton compile these from their source, which a decorator in between would hide.
COMPILED = ("cpu", "gpu")


#: In CI the benchmark is not checked, which takes a fifth of the time of its tests.
UNCHECKED = ["shinypartial"] if os.environ.get("CI") else []


def checked_modules() -> list[str]:
    """The modules whose annotations are checked: all but the compiled kernels and `UNCHECKED`."""
    rooms = [*_children("panoless", leave_out=("kernels", "splats")), *_children("panoless.splats", ("kernels",))]
    kernels = (_children(each, leave_out=COMPILED) for each in ("panoless.kernels", "panoless.splats.kernels"))
    found = ["shinypartial", "tests.support", *rooms, *chain(*kernels)]
    return [name for name in found if name not in UNCHECKED]


def _children(package: str, leave_out: tuple[str, ...]) -> list[str]:
    folder = ROOT.joinpath(*package.split("."))
    names = {path.stem for path in folder.glob("*") if path.suffix == ".py" or (path / "__init__.py").exists()}
    return [f"{package}.{name}" for name in sorted(names) if not name.startswith(("__", *leave_out))]


# Installed while pytest collects, so before any test imports the packages.
install_import_hook(checked_modules(), TYPE_CHECKER)

settings.register_profile("local", deadline=None, max_examples=50)
settings.register_profile("ci", deadline=None, max_examples=10, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "local")

#: Folders and files whose few tests render or fit for long: with workers, who takes them last lets the others wait.
FIRST = ("tests/integration/", "tests/shinypartial/generate/test_dataset.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """They come first, else files keep their order."""
    items.sort(key=lambda item: not item.nodeid.startswith(FIRST))


@pytest.fixture(scope="session")
def sphere_dataset(tmp_path_factory: pytest.TempPathFactory):
    """A small dataset in the full format, made once; tests only read it."""
    from tests.support.synthetic_dataset import make_sphere_dataset

    return make_sphere_dataset(tmp_path_factory.mktemp("datasets") / "sphere")


@pytest.fixture
def damaged_dataset(tmp_path: Path, sphere_dataset) -> Path:
    """A copy of that dataset for a test to damage."""
    import shutil

    return Path(shutil.copytree(sphere_dataset.root, tmp_path / "damaged"))
