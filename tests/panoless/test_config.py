"""Configurations survive their file, and every option is read by some code."""

import ast
import json
from collections.abc import Iterator
from dataclasses import asdict, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import pytest
from msgspec import Meta

import panoless
from panoless.cli import main
from panoless.config import FitConfig, check_config, config_from_dict, renamed_arguments, with_overrides
from panoless.photographs.options import CaptureOptions
from panoless.presets import PRESETS
from panoless.splats.descent import Rates
from panoless.splats.model import ShadedSurfels
from panoless.splats.options import SplatConfig
from shinypartial.core.errors import InputError
from shinypartial.io.records import write_record

ROOT = Path(panoless.__file__).parent
SECTIONS = {
    item.name: item.default_factory
    for item in (*fields(FitConfig), *fields(SplatConfig))
    if is_dataclass(item.default_factory)  # type: ignore[arg-type]
}


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_survives_json(preset: str) -> None:
    config = PRESETS[preset]
    assert config.preset == preset
    assert config_from_dict(json.loads(json.dumps(asdict(config)))) == config


def test_presets_differ_beyond_their_name() -> None:
    contents = [json.dumps({**asdict(config), "preset": ""}, sort_keys=True) for config in PRESETS.values()]
    assert len(set(contents)) == len(contents)


@pytest.mark.parametrize("damage", ["missing", "unknown"])
def test_a_configuration_of_another_version_is_named(damage: str) -> None:
    content = asdict(PRESETS["default"])
    if damage == "missing":
        del content["splats"]["loss"]["robust_scale"]
    else:
        content["splats"]["loss"]["lambda_of_the_future"] = 1.0
    with pytest.raises(InputError, match=r"robust_scale|lambda_of_the_future"):
        config_from_dict(content)


def test_a_number_that_is_a_constant_now_is_named() -> None:
    """In the configuration of an earlier run, and after `--set`."""
    earlier = write_record(PRESETS["default"]) | {"first_surface": {"contact_px": 3.9}}
    with pytest.raises(InputError, match=r"first_surface.*version of panoless"):
        config_from_dict(earlier)
    with pytest.raises(InputError, match=r"plane\.min_views.*constant"):
        with_overrides(PRESETS["default"], ["plane.min_views=4"])


@cache
def reads() -> set[tuple[str, str]]:
    """(owner, name) of every attribute that any module but config.py reads: `config.splats.loss.x` gives (loss, x)."""
    found = set()
    for path in ROOT.rglob("*.py"):
        if path.name == "config.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                owner = node.value
                name = owner.attr if isinstance(owner, ast.Attribute) else getattr(owner, "id", "")
                found.add((name, node.attr))
    return found


@pytest.mark.parametrize("section", ["", *SECTIONS])
def test_every_option_is_read(section: str) -> None:
    kind = SECTIONS[section] if section else FitConfig
    owners = {"config", "splats", section, "options"} if section else {"config"}
    seen = {name for owner, name in reads() if owner in owners}
    assert {item.name for item in fields(kind)} - seen == set()  # type: ignore[arg-type]


@pytest.mark.parametrize("preset", PRESETS)
def test_every_parameter_has_a_rate(preset: str) -> None:
    rates = Rates.of(PRESETS[preset], unit=1.0)
    assert set(rates.by_name) == {item.name for item in fields(ShadedSurfels)} | {"environment"}


def with_value(config: Any, name: str, value: Any) -> Any:
    section, _, leaf = name.rpartition(".")
    if isinstance(config, FitConfig) and hasattr(config.splats, section or leaf):
        return replace(config, splats=with_value(config.splats, name, value))
    if not section:
        return replace(config, **{leaf: value})
    return replace(config, **{section: replace(getattr(config, section), **{leaf: value})})


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_in_range(preset: str) -> None:
    check_config(PRESETS[preset])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("iterations", 0),
        ("surfels.count", 0),
        ("first_surface.hull_votes", 1.01),
        ("environment.resolution", 1),
        ("environment.warmup", -0.1),
        ("loss.silhouette_until", 1.5),
        ("loss.lambda_silhouette", -1.0),
        ("loss.lambda_normal_consistency", float("nan")),
        ("exposure", float("inf")),
        ("crop_margin_px", -2),
        ("loss.robust_scale", -0.1),
        ("environment.rays", 7),
        ("seed", -1),
        ("seed", 2**63),
    ],
)
def test_a_value_out_of_range_is_named_as_the_command_line_names_it(name: str, value: float) -> None:
    with pytest.raises(InputError, match="--config." + name.replace("_", "-")):
        check_config(with_value(PRESETS["default"], name, value))


def test_a_map_of_mirrors_is_not_solved_for_other_shading() -> None:
    with pytest.raises(InputError, match=r"no-solve"):
        check_config(with_value(PRESETS["default"], "surfels.shading", "3dgs-dr"))


def numbers_without_a_range(hint: Any, path: str) -> Iterator[str]:
    """Paths of the plain numbers in an annotation: neither bounded nor said to be any finite number."""
    if isinstance(hint, type) and is_dataclass(hint):
        for name, each in get_type_hints(hint, include_extras=True).items():
            yield from numbers_without_a_range(each, f"{path}.{name}")
    elif hint in (int, float):
        yield path
    elif not any(isinstance(each, Meta) and each.min_length is None for each in getattr(hint, "__metadata__", ())):
        for each in () if get_origin(hint) is Literal else get_args(hint):
            yield from numbers_without_a_range(each, path)


@pytest.mark.parametrize("options", [FitConfig, CaptureOptions])
def test_every_number_has_a_range_at_its_field(options: type) -> None:
    assert list(numbers_without_a_range(options, options.__name__)) == []


@pytest.mark.parametrize(
    "override",
    ["surroundings.degree=3", "material.known_roughness=0.6", "sphere.radius=-1", "sphere.operator_deg=-1"],
)
def test_a_tuned_number_out_of_range_is_refused(override: str) -> None:
    with pytest.raises(InputError, match=override.partition("=")[0]):
        with_overrides(PRESETS["default"], [override])


@pytest.mark.parametrize(
    ("preset", "name"),
    [
        ("default", "environment.solve_resolution"),
        ("gaussian-shader", "environment.resolution"),
        ("material-refgs", "environment.resolution"),
        ("ref-gaussian", "environment.resolution"),
    ],
)
def test_maps_that_are_blurred_halve_whole(preset: str, name: str) -> None:
    """100 texels halve to 25, and 5 to no whole number; 96 halve to 3. What is not blurred has any size."""
    check_config(with_value(PRESETS[preset], name, 96))
    for texels in (5, 100):
        with pytest.raises(InputError, match=name.rpartition(".")[2].replace("_", "[_-]")):
            check_config(with_value(PRESETS[preset], name, texels))
    check_config(with_value(PRESETS["paper"], name, 100))


@pytest.mark.parametrize(
    ("name", "value"), [("loss.lambda_silhouette", 1000.0), ("crop_margin_px", -1), ("seed", 2**63 - 1)]
)
def test_unusual_values_are_allowed(name: str, value: float) -> None:
    check_config(with_value(PRESETS["default"], name, value))


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("surfels.count", 0, "--config.surfels.count: a whole number of at least 1"),
        ("tint", (1.0, 0.0, 1.0), "--config.tint: a number above 0"),
    ],
)
def test_a_refusal_says_what_is_allowed(name: str, value: Any, expected: str) -> None:
    with pytest.raises(InputError) as raised:
        check_config(with_value(PRESETS["default"], name, value))
    assert raised.value.expected == expected


def test_a_stored_value_out_of_range_is_refused() -> None:
    content = write_record(PRESETS["default"])
    content["splats"]["surfels"]["count"] = 0
    with pytest.raises(InputError, match=r"`splats\.surfels\.count`.*at least 1"):
        config_from_dict(content)
    with pytest.raises(
        InputError,
        match=r"`model`.*one of auto, sphere, plane, panes, height_field, revolution, free_form, surfels; found 'ball'",
    ):
        config_from_dict(write_record(PRESETS["default"]) | {"model": "ball"})


@pytest.mark.parametrize(
    "arguments", [["--model", "bent"], ["--model=bent"], ["--config.model", "bent"], ["--config.model=bent"]]
)
def test_the_former_name_of_a_model_works_with_a_warning(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    renamed = renamed_arguments(["fit", "bent", *arguments, "--output", "bent"])
    assert " ".join(renamed).replace("=", " ") == "fit bent --model height_field --output bent"
    assert "--model bent is now --model height_field" in capsys.readouterr().err


def test_other_arguments_pass_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["fit", "--output=a=b", "--model", "plane", "--preset=", "--config.tint", "1", "0.5", "1"]
    assert renamed_arguments(arguments) == arguments
    assert capsys.readouterr().err == ""


def test_a_run_of_the_former_name_can_be_read() -> None:
    content = write_record(replace(PRESETS["default"], model="height_field")) | {"model": "bent"}
    assert config_from_dict(content).model == "height_field"


def test_the_command_line_is_derived_from_the_same_fields(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", "--help-all"]) == 0
    text = capsys.readouterr().out
    for name in (
        "--model {auto,sphere,plane,panes,height_field,revolution,free_form,surfels}",
        "--config.surfels.count",
        "--config.tint",
    ):
        assert name in text
