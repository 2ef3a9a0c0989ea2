"""The command line is the configuration: help, presets, usage errors."""

import json
import re
from dataclasses import fields, is_dataclass
from functools import reduce
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from panoless.api import announce_compilation
from panoless.cli import main
from panoless.config import FitConfig, with_overrides
from panoless.presets import PRESETS
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset
from shinypartial.io.records import write_record
from shinypartial.prediction.format import read_info

TUNED = (
    "first_surface",
    "sphere",
    "free_form",
    "surroundings",
    "material",
    "corrections",
)
TINY = ["--config.iterations", "4", "--config.surfels.count", "40"]
AS_TOLD = [
    "--set",
    "first_surface.hull_resolution=24",
    "corrections.poses=off",
    "corrections.masks=off",
    "corrections.exposure=off",
    "corrections.lens=off",
]
AS_TOLD += ["surroundings.mode=off", "material.reflectance=off", "material.roughness=off", "material.blur=off"]
"""Photographs of an object that the kind does not fit are not doubted, and explained by nothing else."""
MODELS = get_args(get_args(get_type_hints(FitConfig, include_extras=True)["model"])[0])


def option_names(config: object, prefix: str = "--config.") -> list[str]:
    names: list[str] = []
    for item in fields(config):  # type: ignore[arg-type]
        value, name = getattr(config, item.name), item.name.replace("_", "-")
        # The room of splatting has no part in the names of its options.
        inner = prefix if name == "splats" else f"{prefix}{name}."
        names += option_names(value, inner) if is_dataclass(value) else [prefix + name]
    return names


def help_text(arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    """Help in one column, without its boxes and line breaks."""
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*arguments, "--help-all"]) == 0
    return re.sub(r"[│╭╮╰╯─\s]+", " ", capsys.readouterr().out)


def test_help_of_a_fit_fits_two_screens(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    assert main(["fit", "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 100
    assert max(map(len, lines)) <= 100


def test_help_lists_every_option(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """But for the tuned numbers of the stages, each of which `--set` changes."""
    text = help_text(["fit"], capsys, monkeypatch)
    tuned = tuple(f"--config.{name.replace('_', '-')}." for name in TUNED)
    for name in option_names(FitConfig()):
        # The model is an option of the command itself.
        assert (name.replace("--config.model", "--model") in text) != name.startswith(tuned), name
    assert "Eq. 12" in text
    assert "--set" in text


@pytest.mark.parametrize("section", TUNED)
def test_every_tuned_number_can_be_set(section: str) -> None:
    """To its own value, which changes nothing, and by a wrong word, which is refused."""
    config = FitConfig()
    record = write_record(config)
    values = reduce(dict.__getitem__, section.split("."), {**record, **record["splats"]})
    overrides = [f"{section}.{name}={json.dumps(value)}" for name, value in values.items()]
    assert with_overrides(config, overrides) == config
    for override in (f"{section}.of_the_future=1", f"{overrides[0].partition('=')[0]}=word", section):
        with pytest.raises(InputError):
            with_overrides(config, [override])


def test_a_tuned_number_may_be_written_with_dashes() -> None:
    config = with_overrides(FitConfig(), ["sphere.operator-deg=3", "material.known_roughness=0.1"])
    assert config.sphere.operator_deg == 3
    assert config.material.known_roughness == 0.1


@pytest.mark.parametrize(("preset", "form"), [("fast", "{} {}"), ("paper", "{} {}"), ("paper", "{}={}")])
def test_a_preset_sets_the_defaults(
    preset: str, form: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = help_text(["fit", *form.format("--preset", preset).split()], capsys, monkeypatch)
    assert f"default: {PRESETS[preset].splats.iterations})" in text
    assert f"default: {preset})" in text


def test_other_commands_explain_themselves(capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    assert "newest below ./runs" in help_text(["export"], capsys, monkeypatch)
    text = help_text([], capsys, monkeypatch)
    assert "fit" in text
    assert "export" in text


BAD_USAGE = {
    "no command": [],
    "unknown command": ["paint"],
    "unknown preset": ["fit", "--preset", "magic"],
    "preset without a name": ["fit", "--preset"],
    "unknown option": ["fit", "--config.loss.lambda-magic", "1"],
    "not a number": ["fit", "--config.iterations", "many"],
    "not whole": ["fit", "--config.surfels.count", "1.5"],
    "not a choice": ["fit", "--config.environment.activation", "tanh"],
}


@pytest.mark.parametrize("arguments", BAD_USAGE.values(), ids=BAD_USAGE.keys())
def test_bad_usage_exits_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    assert out + err


def test_a_wrong_model_is_answered_with_the_right_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", "--model", "cube"]) == 2
    out, err = capsys.readouterr()
    for name in ("cube", "--model", *MODELS):
        assert name in out + err


@pytest.mark.parametrize(("preset", "model"), [("default", "auto"), ("paper", "surfels")])
def test_the_model_is_that_of_the_preset_unless_named(
    preset: str, model: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = help_text(["fit", "--preset", preset], capsys, monkeypatch)
    assert re.search(rf"--model \{{{','.join(MODELS)}\}}[^)]*\(default: {model}\)", text)
    text = help_text(["fit", "--preset", preset, "--model", "plane"], capsys, monkeypatch)
    assert f"--model {{{','.join(MODELS)}}}" in text


def test_a_model_that_is_asked_for_is_taken_and_saved(
    tmp_path: Path, many_views_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Even a plane for a sphere, which is a surface of revolution; the run says so, and so does the prediction."""
    monkeypatch.chdir(tmp_path)
    tables = {"plane": "plane.ply", "revolution": "revolution.ply", "surfels": "surfels.ply"}
    coarse = ["--config.environment.resolution", "16", "--config.environment.solve-resolution", "16", *AS_TOLD]
    for model in ("plane", "surfels"):
        assert main(["fit", str(many_views_dataset.root), *TINY, *coarse, "--model", model, "--output", model]) == 0
        assert f"Model: {model} (requested" in capsys.readouterr().err
        content = json.loads((tmp_path / model / "prediction.json").read_text())
        assert content["config"]["model"] == model
        assert content["model"].startswith(f"{model} (requested")
        for other, table in tables.items():
            assert (tmp_path / model / table).exists() == (model == other)


def test_options_reach_the_fit_and_are_saved(
    tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    options = [*TINY, "--preset", "paper", "--config.density.no-enabled", "--config.loss.robust-scale", "0.25"]
    options += ["--set", "surroundings.degree=1", "corrections.lens=off", "--set", "sphere.radius=9"]
    assert main(["fit", str(sphere_dataset.root), *options]) == 0
    folder = tmp_path / "predictions" / f"{sphere_dataset.name}-paper"
    saved = json.loads((folder / "prediction.json").read_text())["config"]
    assert saved == json.loads((tmp_path / "runs" / folder.name / "fit.json").read_text())["config"]
    assert saved["splats"]["iterations"] == 4
    assert saved["splats"]["loss"]["robust_scale"] == 0.25
    assert (saved["surroundings"]["degree"], saved["sphere"]["radius"]) == (1, 9)
    assert saved["splats"]["density"]["enabled"] is False
    assert saved["environment"]["activation"] == "sigmoid"
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("Next: shinypartial evaluate predictions") for line in lines)
    verdict = read_info(folder).verdict
    assert verdict is not None
    assert lines[-1] == f"Verdict: {verdict.sentence()}"


def test_the_newest_folder_is_taken_where_none_is_named(
    tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "datasets").mkdir()
    (tmp_path / "datasets" / "sphere").symlink_to(sphere_dataset.root)
    assert main(["fit", *TINY, "--model", "surfels", *AS_TOLD]) == 0
    assert "No dataset named" in capsys.readouterr().out
    assert main(["export", "--output", "again"]) == 0
    first = next((tmp_path / "predictions").iterdir())
    for name in ("environment.exr", "visibility.exr", "surfels.ply", "test/r_000.png"):
        assert (first / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


def test_the_run_folder_is_no_place_for_the_prediction(
    tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["fit", str(sphere_dataset.root), *TINY, "--output", "runs/mine"]) == 2
    assert "apart from the run folder" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_compilation_is_announced_once_and_only_when_it_happens(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from collections import defaultdict

    from numba import njit
    from numba.core import event

    monkeypatch.setattr(event, "_registered", defaultdict(list))
    announce_compilation.cache_clear()
    announce_compilation()
    assert capsys.readouterr().err == ""
    for value in (1, 1.0):
        assert njit(lambda x: x + 1)(value) == value + 1
    assert capsys.readouterr().err.count("Compiling kernels") == 1
