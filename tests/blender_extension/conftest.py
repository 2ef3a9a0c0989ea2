"""The extension in this process's Blender, and programs in the place of an installed panoless."""

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shinypartial.dataset.schema import Dataset
from shinypartial.io.images import read_exr, stack_channels
from tests.support.knowing_fit import write_known_prediction
from tests.support.synthetic_dataset import make_sphere_dataset

ROOT = Path(__file__).resolve().parents[2]
collect_ignore_glob = []
try:
    import bpy  # noqa: F401
except ImportError:
    collect_ignore_glob = ["test_*.py"]


def write_program(folder: Path, name: str, content: str) -> Path:
    """A command that runs a Python program."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(ROOT)!r})\n{content}", encoding="utf-8")
    path.chmod(0o755)
    return path


#: Of no known version, which is said before anything is loaded.
KNOWING = "if '--version' in sys.argv: sys.exit(2)\n"
KNOWING += "from tests.support.knowing_fit import main\nsys.exit(main(sys.argv[1:]))\n"
REAL = "from shinypartial.cli import main\nsys.exit(main())\n"


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder at the head of PATH with a `panoless` that knows the truth and the real `shinypartial`."""
    folder = tmp_path / "bin"
    write_program(folder, "panoless", KNOWING)
    write_program(folder, "shinypartial", REAL)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    return folder


@pytest.fixture(scope="session")
def ball_dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Photographs of a mirror ball that are traced without Blender."""
    return make_sphere_dataset(
        tmp_path_factory.mktemp("datasets") / "ball", resolution=64, train=3, test=1, environment_height=128
    )


@pytest.fixture(scope="session")
def known(tmp_path_factory: pytest.TempPathFactory, ball_dataset: Dataset) -> Path:
    """The truth of that dataset."""
    return write_known_prediction(tmp_path_factory.mktemp("predictions") / "known", ball_dataset)


@pytest.fixture
def prediction(tmp_path: Path, known: Path) -> Path:
    """A copy of it for a test to change."""
    return Path(shutil.copytree(known, tmp_path / "known"))


@pytest.fixture
def blender(tmp_path: Path) -> Iterator[Any]:
    """Blender with the extension, and an empty scene in a file of its own."""
    import bpy

    import blender_extension

    bpy.ops.wm.read_factory_settings(use_empty=True)
    blender_extension.register()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "file.blend"))
    yield bpy
    blender_extension.unregister()


@pytest.fixture
def picture(tmp_path: Path) -> Callable[..., np.ndarray]:
    """What the scene's camera sees: linear premultiplied RGBA, a pixel being its mean."""

    def render(bpy: Any, samples: int = 32) -> np.ndarray:
        scene, path = bpy.context.scene, tmp_path / "picture.exr"
        scene.cycles.samples, scene.cycles.use_denoising = samples, False
        scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 1.0
        settings = scene.render.image_settings
        settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
        scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
        return stack_channels(read_exr(path), ("R", "G", "B", "A"), path)

    return render
