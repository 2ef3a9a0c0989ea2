"""Configuration of a fit: frozen dataclasses whose docstrings are the help texts. Presets are data.

Durations are shares of `iterations`, so every schedule scales with the length of the fit. The range of a value stands
at its field; `check_config` applies it.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeVar

import tyro
from msgspec import Meta

from panoless.environment.options import (
    COARSEST,
    MaterialOptions,
    SurroundingsOptions,
    halves_whole,
)
from panoless.first_surface.options import FirstSurfaceOptions
from panoless.geometry.free_form.options import FreeFormOptions
from panoless.geometry.sphere.options import SphereOptions
from panoless.selection.options import CorrectionOptions
from panoless.splats.options import SplatConfig
from shinypartial.core.errors import InputError
from shinypartial.io.records import (
    Natural,
    NonNegative,
    Positive,
    Share,
    check_record,
    read_record,
    write_record,
)

Options = TypeVar("Options")
Tuned = Annotated[Options, tyro.conf.Suppress]
"""Options of a stage, which `--set` changes: too many for the help of a command."""
SPLIT_SUM = ("gaussian-shader", "ref-gaussian", "material-refgs")
"""The shadings that blur the map for rough parts."""
Model = Literal["auto", "sphere", "plane", "panes", "height_field", "revolution", "free_form", "surfels"]
#: Values of --model that an earlier version had, and today's.
RENAMED_MODELS = {"bent": "height_field"}


@dataclass(frozen=True)
class EnvironmentConfig:
    """The learnable cubemap."""

    resolution: Annotated[int, Meta(ge=2)] = 128
    """Texels along a face side during the optimization; 2ⁿ or 3 · 2ⁿ where a shading blurs the map for rough parts."""
    activation: Literal["clamp", "sigmoid"] = "clamp"
    """`sigmoid`: Eq. 7 of the paper, started at random logits; `clamp`: radiance itself, kept in [0, 1]."""
    range: Literal["ldr", "hdr"] = "ldr"
    """`ldr`: views are clipped to [0, 1], as photographs are; `hdr`: radiance above 1 is fitted, too (EXR, HDR)."""
    warmup: Share = 0.06
    """Share of the iterations in which only the environment learns, before the geometry moves."""
    solve: bool = True
    """Start and end with the closed-form robust least-squares map instead of what gradient descent left."""
    rays: Annotated[int, Meta(ge=8)] = 8_000_000
    """Most rays that the closed-form map is solved from; an eighth of them determines which surfels to trust."""
    fill: bool = True
    """Fill directions that no ray of the closed-form map met from what is known around them; else they stay gray."""
    trace: bool = True
    """Leave pixels out of the closed-form map whose mirrored ray meets a plane's frame, or a surface of revolution
    again; a bent plane always does, surfels can't show it."""
    solve_resolution: Natural = 0
    """Texels along a face side of the closed-form map that is exported. 0: 64, 128 or 256, which held-out views choose
    for surfels, held-out pixels for kinds whose pixels are areas, and the density of rays for others. Where the mirror
    may be rough, 2ⁿ or 3 · 2ⁿ."""

    def trial_resolution(self, most: int) -> int:
        """Texels along a face side of a map that only judges: no more than the exported map has, where that is set."""
        return min(most, self.solve_resolution or most)


@dataclass(frozen=True)
class FitConfig:
    """Everything that determines a fit, saved beside its result."""

    preset: str = "default"
    """Name of the preset that the values started from."""
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
    """Seed of the initial surfels and of the order of views."""
    model: Annotated[Model, tyro.conf.arg(prefix_name=False)] = "auto"
    """`auto`: the simplest that explains held-out views; `sphere`, `plane`, `panes` of it or a `height_field` over it,
    `revolution`, `free_form`: a closed smooth surface; `surfels`."""
    tint: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    """Known reflectance of the mirror in red, green and blue (linear): what it shows is tint · environment."""
    exposure: NonNegative = 0.0
    """Factor of all photographs by which a shape is chosen, fitted and judged; the map is solved from them as they are.
    0: that which gives a dark object a mean brightness of 0.35."""
    downscale: Natural = 1
    """Average the training images over blocks of this many pixels a side; 0: 2, but 1 for a small object."""
    crop_margin_px: Annotated[int, Meta(ge=-1)] = 12
    """Work on the mask's bounding box with this margin; −1 works on whole images."""
    splats: Annotated[SplatConfig, tyro.conf.arg(name="")] = field(default_factory=SplatConfig)
    environment: EnvironmentConfig = field(default_factory=EnvironmentConfig)
    first_surface: Tuned[FirstSurfaceOptions] = field(default_factory=FirstSurfaceOptions)
    sphere: Tuned[SphereOptions] = field(default_factory=SphereOptions)
    free_form: Tuned[FreeFormOptions] = field(default_factory=FreeFormOptions)
    surroundings: Tuned[SurroundingsOptions] = field(default_factory=SurroundingsOptions)
    material: Tuned[MaterialOptions] = field(default_factory=MaterialOptions)
    corrections: Tuned[CorrectionOptions] = field(default_factory=CorrectionOptions)


def renamed_arguments(arguments: list[str]) -> list[str]:
    """The command line with today's words for those of an earlier version, which a line on standard error names."""
    renamed: list[str] = []
    for argument in arguments:
        flag, equals, value = argument.partition("=")
        flag = "--model" if flag == "--config.model" else flag
        before = flag if equals else renamed[-1] if renamed else ""
        old = value if equals else argument
        if before == "--model" and old in RENAMED_MODELS:
            new = RENAMED_MODELS[old]
            print(
                f"warning: --model {old} is now --model {new}; the old name goes with the next version.",
                file=sys.stderr,
            )
            renamed.append(f"{flag}={new}" if equals else new)
        else:
            renamed.append(flag + equals + value)
    return renamed


def with_overrides(config: FitConfig, overrides: Sequence[str]) -> FitConfig:
    """The configuration with values set by `path=value`, such as `surroundings.degree=2`; values are JSON or words.

    Raises InputError for a path that is no option, and for a value out of its range.
    """
    if not overrides:
        return config
    content = write_record(config)
    for override in overrides:
        path, equals, text = override.partition("=")
        *sections, name = path.replace("-", "_").split(".")
        place = content["splats"] if [*sections, name][0] in content["splats"] else content
        for section in sections:
            place = place.get(section, {}) if isinstance(place, dict) else {}
        if not equals or not isinstance(place, dict) or name not in place:
            raise InputError(
                expected="--set OPTION=VALUE with an option of the configuration, such as surroundings.degree=2",
                found=override,
                remedy="The reference of options lists them all; any other number is a constant beside its formula.",
            )
        try:
            place[name] = json.loads(text)
        except (ValueError, RecursionError):
            place[name] = text
    return read_record(FitConfig, content, "the configuration", remedy="The reference of options says what it means.")


def config_from_dict(content: Any) -> FitConfig:
    """The configuration that `write_record` wrote; InputError when its options or their values are not today's."""
    if isinstance(content, dict) and content.get("model") in RENAMED_MODELS:
        content = content | {"model": RENAMED_MODELS[content["model"]]}
    remedy = "Use the version of panoless that made the run, or fit again."
    return read_record(FitConfig, content, "the configuration of this run", complete=True, remedy=remedy)


def check_config(config: FitConfig) -> None:
    """Raise InputError for a value outside the range of its field, and for options that exclude each other."""
    check_record(config, "the configuration", place=_option, remedy="See `panoless fit --help-all` for what it means.")
    linear = _works_in_unit_range(config)
    if config.splats.surfels.shading != "mirror" and config.environment.solve:
        raise InputError(
            expected="the map that the steps leave, where primitives are shaded as another method does",
            found=f"--config.surfels.shading {config.splats.surfels.shading} with a map that is solved for a mirror",
            remedy="Use that method's preset, or add --config.environment.no-solve.",
        )
    if config.environment.range == "hdr" and linear:
        raise InputError(
            expected="a mirror without diffuse color, the masked photometric term and the activation `clamp` for hdr",
            found=f"options of the preset {config.preset} that work in [0, 1]",
            remedy="Use --preset fast, default or best, or leave --config.environment.range out.",
        )
    if config.exposure not in (0, 1) and not can_be_exposed(config):
        raise InputError(
            expected="photographs as they are, where options work in [0, 1], without a solved map or in hdr",
            found=f"--config.exposure {config.exposure:g} with such options of the preset {config.preset}",
            remedy="Use --preset fast, default or best, or leave --config.exposure out.",
        )
    _check_blurred_maps(config)


def _check_blurred_maps(config: FitConfig) -> None:
    """InputError for maps that don't halve whole where a lobe may blur them: of rough mirrors and of the split sum."""
    environment, material = config.environment, config.material
    exact = environment.range == "ldr" and config.model != "surfels"
    soft = exact and "auto" in (material.roughness, material.blur)
    for option, resolution, blurred in (
        ("--config.environment.resolution", environment.resolution, config.splats.surfels.shading in SPLIT_SUM),
        ("--config.environment.solve-resolution", environment.solve_resolution, soft),
    ):
        if blurred and not halves_whole(resolution):
            raise InputError(
                expected=f"{option}: texels that are halved until they are {COARSEST} or fewer, where maps are blurred",
                found=str(resolution),
                remedy="Take 64, 96, 128 or another such number.",
            )


def can_be_exposed(config: FitConfig) -> bool:
    """Whether photographs may be brighter in a fit than they are: in a low dynamic range, with a map that is solved
    after it, and where nothing works in [0, 1].
    """
    environment = config.environment
    return environment.range == "ldr" and environment.solve and not _works_in_unit_range(config)


def _works_in_unit_range(config: FitConfig) -> bool:
    """Whether a diffuse color, a term of the loss, a sigmoid or another method's shading takes radiance as it is."""
    of_paper = config.splats.loss.photometric == "paper" or config.environment.activation == "sigmoid"
    return config.splats.albedo or of_paper or config.splats.surfels.shading != "mirror"


def _option(path: str) -> str:
    """The name on the command line of the field at `path`; numbers of a tuple and the room of splatting have none."""
    names = [name.replace("_", "-") for name in path.split(".") if not name.isdigit() and name != "splats"]
    return "--model" if names == ["model"] else "--config." + ".".join(names)
