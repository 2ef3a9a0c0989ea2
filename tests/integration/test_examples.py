"""Examples and benchmarks can be imported, and the tables of results are written from finished folders only."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from shinypartial.scene import scene_names

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = sorted(path for folder in ("docs/examples", "tests/benchmarks") for path in (ROOT / folder).glob("*.py"))


def load(path: Path) -> ModuleType:
    """A program as a module."""
    specification = importlib.util.spec_from_file_location(path.stem, path)
    assert specification
    assert specification.loader
    module = importlib.util.module_from_spec(specification)
    sys.modules[path.stem] = module
    specification.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_a_program_can_be_imported(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(path.parent)
    assert load(path).__doc__


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The program of `make results` in an empty folder with a README, which records its commands."""
    module = load(ROOT / "docs" / "examples" / "main_scenes.py")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "SCENES", ROOT / "blender_scenes")
    (tmp_path / "README.md").write_text("Head\n<!-- results:begin -->\nold\n<!-- results:end -->\nTail\n")
    (tmp_path / "docs" / "results").mkdir(parents=True)
    commands: list[list[str]] = []

    def record(command: list[object], check: bool) -> subprocess.CompletedProcess[bytes]:
        commands.append([str(word) for word in command[1:]])
        return subprocess.CompletedProcess([], 0)

    monkeypatch.setattr(module.subprocess, "run", record)
    module.commands = commands  # type: ignore[attr-defined]
    return module


def test_every_scene_has_a_split(results: ModuleType) -> None:
    assert set(results.splits()) == set(scene_names())


def test_nothing_finished_is_made_again(results: ModuleType, tmp_path: Path) -> None:
    results.make("vase", 40)
    first = [command[0] for command in results.commands]
    assert first == ["generate", "oracle", "fit", "evaluate"]
    for finished in ("datasets/vase-40/SHA256SUMS", "predictions/vase-40-default/prediction.json"):
        (tmp_path / finished).parent.mkdir(parents=True)
        (tmp_path / finished).write_text("{}")
    results.commands.clear()
    results.make("vase", 40)
    assert [command[0] for command in results.commands] == ["oracle", "evaluate"]


def test_the_table_stands_between_its_marks(results: ModuleType, tmp_path: Path) -> None:
    """Each scene at its largest resolution, development first; text around the marks stays."""

    def entry(scene: str, split: str, resolution: int, psnr: float) -> dict[str, object]:
        made = {
            "method": "panoless",
            "model": "revolution",
            "parameter_counts": {"revolution parameters": 1234, "environment parameters": 9},
            "environment_psnr_linear_observed_db": psnr,
            "normals_environment_mean_deg": 0.125,
            "normals_environment_median_deg": None,
            "seconds": 61.4,
        }
        return {"scene": scene, "split": split, "resolution": resolution, "methods": [made]}

    numbers = {
        "idol-400": entry("idol", "held-out", 400, 30.0),
        "mirror-400": entry("mirror", "development", 400, 38.0),
        "deformed-mirror-800": entry("deformed-mirror", "development", 800, 36.04),
        "deformed-mirror-400": entry("deformed-mirror", "development", 400, 35.0),
        "old-400": {"methods": []},
    }
    results.NUMBERS.write_text(json.dumps(numbers))
    results.main(["--collect"])
    lines = (tmp_path / "README.md").read_text().splitlines()
    assert lines[:2] == ["Head", "<!-- results:begin -->"]
    assert lines[-2:] == ["<!-- results:end -->", "Tail"]
    rows = [line for line in lines if line.startswith("| ")][1:]
    model = "surface of revolution, 1,234 parameters"
    assert rows == [
        f"| Mirror | development | {model} | 38.0 dB | – dB | 0.12° / –° | 61 | 13.31 dB, 4.64° / 4.62° |",
        f"| Deformed mirror | development | {model} | 36.0 dB | – dB | 0.12° / –° | 61 |  |",
        f"| Idol | held-out | {model} | 30.0 dB | – dB | 0.12° / –° | 61 |  |",
    ]
    assert results.main(["--collect"]) is None
    assert (tmp_path / "README.md").read_text().splitlines() == lines
