"""From a recipe to a report with the commands that a user types, on a scene that Blender renders in seconds."""

import json
import math
from pathlib import Path

import pytest

from panoless.cli import main as panoless
from shinypartial.cli import main as shinypartial

pytest.importorskip("bpy", reason="the pipeline begins with Blender: pip install 'panoless[blender]'")


def numbers_in(content: object) -> list[float]:
    if isinstance(content, dict):
        return [number for value in content.values() for number in numbers_in(value)]
    if isinstance(content, list):
        return [number for value in content for number in numbers_in(value)]
    return [content] if isinstance(content, float) else []


def assert_complete(prediction: Path, model: str, largest_error_deg: float, least_overlap: float) -> None:
    """All files of a scored and reported prediction, finite scores, and normals and silhouettes as good as stated."""
    names = ("prediction.json", "environment.exr", "visibility.exr", model, "scores.json", "report.html")
    for name in names:
        assert (prediction / name).stat().st_size > 0, name
    assert len(list((prediction / "test").glob("*.exr"))) == 4
    scores = json.loads((prediction / "scores.json").read_text())
    assert all(map(math.isfinite, numbers_in(scores)))
    assert scores["normals"]["median_angular_error_deg"] < largest_error_deg
    assert scores["render"]["alpha_iou"] > least_overlap


@pytest.mark.slow
def test_generate_fit_evaluate_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every command finds the newest result of the one before it, with surfels and with a surface of revolution."""
    monkeypatch.chdir(tmp_path)
    sizes = ["--resolution", "48", "--samples", "4", "--train", "12", "--test", "4"]
    assert shinypartial(["generate", "--scene", "vase", *sizes]) == 0
    options = ["--config.iterations", "60", "--config.surfels.count", "400"]
    options += ["--config.environment.resolution", "24", "--config.environment.solve-resolution", "24"]
    options += [
        "--set",
        "first_surface.hull_resolution=40",
        "corrections.masks=off",
        "corrections.exposure=off",
        "corrections.lens=off",
    ]
    options += ["surroundings.mode=off", "material.reflectance=off", "material.roughness=off", "material.blur=off"]
    assert shinypartial(["validate"]) == 0
    for model in (["surfels"], ["revolution", "--output", "predictions/round"]):
        assert panoless(["fit", *options, "--model", *model]) == 0
        assert shinypartial(["evaluate"]) == 0
        assert shinypartial(["report"]) == 0
    assert "Traceback" not in capsys.readouterr().err
    free, turned = sorted((tmp_path / "predictions").iterdir(), key=lambda folder: folder.name == "round")
    # A second of fitting at 48 px: 9° and a silhouette of 0.95 were measured; a wrong axis gives 60° and 0.5.
    assert_complete(free, "surfels.ply", largest_error_deg=20, least_overlap=0.8)
    # 0.9° and 0.97.
    assert_complete(turned, "revolution.ply", largest_error_deg=3, least_overlap=0.9)
