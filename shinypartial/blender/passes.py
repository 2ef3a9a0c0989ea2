"""Passes that Blender writes to a file, read back as arrays."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from shinypartial.blender.materials import DEPTH_PASS
from shinypartial.core.errors import InputError

DEPTH_CHANNEL = f"{DEPTH_PASS}.X"
COLOR_CHANNELS = tuple(f"Combined.{name}" for name in "RGB")
ALPHA_CHANNEL = "Combined.A"
NORMAL_CHANNELS = tuple(f"Normal.{name}" for name in "XYZ")
PASSES = (*COLOR_CHANNELS, ALPHA_CHANNEL, *NORMAL_CHANNELS, DEPTH_CHANNEL)

Passes = dict[str, Float[np.ndarray, "H W"]]


def read_passes(path: Path, expected: tuple[str, ...]) -> Passes:
    """Every channel of every part, by the name that follows the view layer's."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            passes = {
                name.partition(".")[2]: channel.pixels.astype(np.float32, copy=False)
                for part in file.parts
                for name, channel in part.channels.items()
            }
    except Exception as error:
        raise _unreadable(path, str(error).strip()) from None
    missing = sorted(set(expected) - passes.keys())
    if missing:  # Where a part is cut off, OpenEXR warns and leaves it out.
        raise _unreadable(path, f"no {', '.join(missing)}")
    return passes


def stacked(passes: Passes, channels: tuple[str, ...]) -> Float[np.ndarray, "H W C"]:
    """Some channels as the last axis of one array."""
    return np.stack([passes[name] for name in channels], -1)


def _unreadable(path: Path, found: str) -> InputError:
    return InputError(
        expected=f"every pass that Blender writes to {path}",
        found=f"an incomplete file ({found})",
        remedy="Free some space there or set TMPDIR to another folder, then run the same command again.",
    )
