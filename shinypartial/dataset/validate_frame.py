"""Rules of one frame: files of the right kind, physical values, and companions that agree with the EXR."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from shinypartial.core.camera import ray_directions_world
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import (
    COLOR_CHANNELS,
    DEPTH_CHANNEL,
    NORMAL_CHANNELS,
    SELF_REFLECTION_CHANNEL,
    Frame,
    View,
)
from shinypartial.dataset.violations import REMAKE, Violation, mask_violations, violation_of
from shinypartial.dataset.write import display_rgba, encode_normals, encode_unit
from shinypartial.io.images import read_exr, read_png, stack_channels

#: Float32 rounding of a renormalized vector is 1e-7; a normal read from 8 bits would be off by 1e-2.
UNIT_TOLERANCE = 1e-4
#: A mean normal at the silhouette may turn a little away from the ray through the pixel center.
FACING_TOLERANCE = 0.1
#: Both sides round to 8 bits, one of them from half precision.
LEVEL_TOLERANCE = 1
#: Below this alpha, half precision is too coarse to recover straight color to one level.
COMPARED_ALPHA = 1 / 64


def check_frame(root: Path, frame: Frame, self_reflection: bool = False) -> Iterator[Violation]:
    """Every violation in a frame's files; without `self_reflection` it may have that or not."""
    expected = (*frame.files, frame.self_png) if self_reflection else frame.files
    missing = [path for path in expected if not path.is_file()]
    yield from (Violation(_name(root, path), "the file is missing", REMAKE) for path in missing)
    if frame.exr in missing:
        return
    try:
        channels = read_exr(frame.exr)
        view, problems = _read_view(frame, channels, self_reflection or SELF_REFLECTION_CHANNEL in channels)
    except InputError as error:
        yield violation_of(_name(root, frame.exr), error)
        return
    yield from (Violation(_name(root, frame.exr), problem, REMAKE) for problem in problems)
    if view is None:
        return
    yield from _check_values(_name(root, frame.exr), frame, view)
    yield from _check_companions(root, frame, view, missing)


def _name(root: Path, path: Path) -> str:
    return path.relative_to(root).as_posix()


def _read_view(frame: Frame, channels: dict[str, np.ndarray], self_reflection: bool) -> tuple[View | None, list[str]]:
    """The view and what is wrong with its types; no view when size or channels make the rest meaningless."""
    expected = {
        **dict.fromkeys(COLOR_CHANNELS, "float16"),
        **dict.fromkeys((*NORMAL_CHANNELS, DEPTH_CHANNEL), "float32"),
        **({SELF_REFLECTION_CHANNEL: "float16"} if self_reflection else {}),
    }
    if channels.keys() != expected.keys():
        return None, [f"expected the channels {', '.join(sorted(expected))}, found {', '.join(sorted(channels))}"]
    size = (frame.camera.height, frame.camera.width)
    shape = channels["A"].shape
    if shape != size:
        return None, [f"expected {size[1]}×{size[0]} pixels as the transforms say, found {shape[1]}×{shape[0]}"]
    types = {name: str(channels[name].dtype) for name in expected}
    problems = [f"expected channel {n} as {t}, found {types[n]}" for n, t in expected.items() if types[n] != t]
    rgba = stack_channels(channels, COLOR_CHANNELS, frame.exr)
    normals = stack_channels(channels, NORMAL_CHANNELS, frame.exr)
    mask = channels[SELF_REFLECTION_CHANNEL].astype(np.float32) if self_reflection else None
    view = View(rgba[..., :3], rgba[..., 3], normals, channels[DEPTH_CHANNEL].astype(np.float32), True, mask)
    infinite = [
        f"{int((~np.isfinite(channels[name])).sum())} values of channel {name} are NaN or infinite"
        for name in expected
        if not np.isfinite(channels[name]).all()
    ]
    return (None if infinite else view), problems + infinite


def _check_values(file: str, frame: Frame, view: View) -> Iterator[Violation]:
    assert view.normals_world is not None
    assert view.depth is not None
    inside = view.alpha > 0
    lengths = np.linalg.norm(view.normals_world, axis=-1)
    facing = np.sum(view.normals_world * ray_directions_world(frame.camera), -1)
    counts: dict[str, Bool[np.ndarray, "H W"]] = {
        "alpha outside [0, 1]": (view.alpha < 0) | (view.alpha > 1),
        "radiance below zero": (view.radiance < 0).any(-1),
        "radiance where alpha is zero": ~inside & (view.radiance != 0).any(-1),
        "normals that are not unit vectors where alpha > 0": inside & (np.abs(lengths - 1) > UNIT_TOLERANCE),
        "normals that are not zero where alpha is zero": ~inside & (lengths != 0),
        "normals that face away from the camera": inside & (facing > FACING_TOLERANCE),
        "depths that are not positive where alpha > 0": inside & ~(view.depth > 0),
        "depths that are not zero where alpha is zero": ~inside & (view.depth != 0),
    }
    if view.self_reflection is not None:
        binary = (view.self_reflection == 0) | (view.self_reflection == 1)
        counts["self-reflection that is neither 0 nor 1"] = ~binary
        counts["self-reflection where alpha is zero"] = ~inside & (view.self_reflection != 0)
    for what, wrong in counts.items():
        if wrong.any():
            yield Violation(file, f"{int(wrong.sum())} pixels have {what}", REMAKE)
    yield from mask_violations(
        file, inside, "Correct the camera path or the mask.", "Move the camera back, or accept it."
    )


def _check_companions(root: Path, frame: Frame, view: View, missing: list[Path]) -> Iterator[Violation]:
    assert view.normals_world is not None
    compared = view.alpha >= COMPARED_ALPHA
    expected: dict[Path, np.ndarray] = {
        frame.png: display_rgba(view.radiance, view.alpha),
        frame.alpha_png: encode_unit(view.alpha)[..., None],
        frame.normal_png: encode_normals(view.normals_world),
    }
    if view.self_reflection is not None:
        expected[frame.self_png] = encode_unit(view.self_reflection)[..., None]
    for path, picture in expected.items():
        if path not in missing:
            yield from _compare_picture(_name(root, path), path, picture, compared)


def _compare_picture(
    name: str, path: Path, expected: UInt8[np.ndarray, "H W C"], compared: Bool[np.ndarray, "H W"]
) -> Iterator[Violation]:
    try:
        found = read_png(path)
    except InputError as error:
        yield violation_of(name, error)
        return
    if found.shape != expected.shape:
        yield Violation(name, f"expected an image of shape {expected.shape}, found {found.shape}", REMAKE)
        return
    difference: Float[np.ndarray, "H W C"] = np.abs(found.astype(np.float64) - expected)
    difference[~compared, :3] = 0 if found.shape[2] == 4 else difference[~compared, :3]
    wrong = int((difference.max(-1) > LEVEL_TOLERANCE).sum())
    if wrong:
        yield Violation(name, f"{wrong} pixels differ from the EXR by up to {difference.max():g} of 255 levels", REMAKE)
