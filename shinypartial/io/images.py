"""Image files at the door: EXR with named channels and 8-bit PNG, written whole, read with clear errors."""

import errno
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from shinypartial.core.errors import InputError
from shinypartial.io.files import atomic_write

Channels = Mapping[str, np.ndarray]


def write_exr(path: Path, channels: Channels, *, y_up_environment: bool = False) -> None:
    """Write 2-D float16 or float32 arrays as named channels of one scan-line EXR (ZIP-compressed).

    `y_up_environment` sets the `envmap` attribute, which declares a lat-long map with +Y up and its center along +Z.
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if y_up_environment:
        header["envmap"] = OpenEXR.ENVMAP_LATLONG
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    with atomic_write(path) as temporary:
        try:
            OpenEXR.File(header, planes).write(str(temporary))
        except Exception as error:
            # The temporary file was made, so permission is not what is missing, and OpenEXR doesn't tell the errno.
            raise OSError(errno.ENOSPC, f"could not write the EXR ({error})", str(path)) from None
        _require_complete_write(temporary, path)


def _require_complete_write(temporary: Path, path: Path) -> None:
    """OpenEXR buffers: a full disk can leave a short file without an error, so its last line is read back."""
    try:
        read_exr(temporary)
    except InputError:
        raise OSError(errno.ENOSPC, "the written EXR can't be read back", str(path)) from None


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """Read every channel of a single-part EXR by name."""
    import OpenEXR

    if not path.is_file():
        raise InputError(
            expected=f"an EXR image at {path}",
            found="no such file",
            remedy="Check the path, or make it again.",
        )
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:
        raise InputError(
            expected=f"a complete EXR image at {path}",
            found=f"a truncated or damaged file ({str(error).strip() or type(error).__name__})",
            remedy="Delete the file and run the command that made it again.",
        ) from None


def has_envmap_tag(path: Path) -> bool:
    """Whether an EXR declares itself an environment map, which by that standard has +Y up."""
    import OpenEXR

    with OpenEXR.File(str(path), header_only=True) as file:
        return "envmap" in file.header()


def stack_channels(channels: Channels, names: tuple[str, ...], path: Path) -> Float[np.ndarray, "H W C"]:
    """Float32 array of the named channels; InputError when one is missing."""
    missing = [name for name in names if name not in channels]
    if missing:
        raise InputError(
            expected=f"channels {', '.join(names)} in {path}",
            found=f"{', '.join(sorted(channels))}",
            remedy="Export the image again with these channel names.",
        )
    return np.stack([channels[name] for name in names], -1).astype(np.float32)


def write_exr_rgb(path: Path, radiance: Float[np.ndarray, "H W 3"], *, y_up_environment: bool = False) -> None:
    """Write linear radiance as half-float RGB, clipped to the largest half (65504)."""
    half = np.clip(radiance, -65504.0, 65504.0).astype(np.float16)
    write_exr(path, {name: half[..., i] for i, name in enumerate("RGB")}, y_up_environment=y_up_environment)


def read_exr_rgb(path: Path) -> Float[np.ndarray, "H W 3"]:
    """Read linear radiance."""
    return stack_channels(read_exr(path), ("R", "G", "B"), path)


def write_png(path: Path, image: UInt8[np.ndarray, "H W *C"]) -> None:
    """Write an 8-bit image: (H, W) gray, (H, W, 3) RGB or (H, W, 4) RGBA with straight alpha."""
    from PIL import Image

    with atomic_write(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG")


def read_png(path: Path) -> UInt8[np.ndarray, "H W C"]:
    """Read an 8-bit image with its channels as stored.

    Gray becomes one channel, 16 bits are reduced to 8, a palette becomes RGB, or RGBA where it has transparency.
    """
    from PIL import Image

    if not path.is_file():
        raise InputError(
            expected=f"an image at {path}",
            found="no such file",
            remedy="Check file_path in transforms_*.json.",
        )
    try:
        with Image.open(path) as stored:
            stored.load()
            convert = stored.mode in ("P", "PA", "LA", "CMYK", "1") or "transparency" in stored.info
            array = np.asarray(stored.convert("RGBA" if stored.has_transparency_data else "RGB") if convert else stored)
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(
            expected=f"a complete image at {path}", found=f"{error}", remedy="Restore or re-export the file."
        ) from None
    if array.dtype != np.uint8:
        array = (array.astype(np.float64) / 257.0).round().astype(np.uint8)
    return array[..., None] if array.ndim == 2 else array
