"""Pictures in and out: written whole, read with clear errors. No other module reads them, or writes one that is read
again; pages and sheets for people are drawn and encoded with Pillow.

OpenImageIO reads and writes PNG, JPEG, TIFF and HDR; loading it takes a tenth of a second, so it is imported when
needed. EXR stays with OpenEXR, which reads and writes our files in less than half of OpenImageIO's processor time and
keeps each channel's own type.
"""

import errno
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, Num, UInt8

from shinypartial.core.errors import InputError
from shinypartial.io.files import atomic_write

Channels = Mapping[str, np.ndarray]

EXR = ".exr"
#: What a photograph may be besides, in the order in which they are looked for.
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".hdr")
#: Channels that `read_picture` returns: gray, RGB, RGBA; gray with alpha becomes the last.
CHANNEL_COUNTS = (1, 3, 4)
#: Of a picture that is read: a medium-format camera's has half as many. A small file may claim any number.
LARGEST_PIXELS = 200_000_000
#: PNG_FILTER_AVG: of single filters it leaves photographs smallest, and one takes less time than a choice in each row.
AVERAGE_FILTER = 0x40
#: Of maps that light scenes. Measured in Blender's own: −0.0022 (forest), beside radiance up to 1400.
LOWEST_RADIANCE = -1e-2
#: What brings stored pixels upright, by the EXIF orientation: whether rows and columns change places, then which axes
#: of the result run backward.
UPRIGHT = {
    1: (False, ()),
    2: (False, (1,)),
    3: (False, (0, 1)),
    4: (False, (0,)),
    5: (True, ()),
    6: (True, (1,)),
    7: (True, (0, 1)),
    8: (True, (0,)),
}


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
            # The temporary file was made, so permission is not what is missing, and OpenEXR doesn't state the errno.
            raise OSError(errno.ENOSPC, f"could not write the EXR ({error})", str(path)) from None
        _require_complete_write(temporary, path)


def _require_complete_write(temporary: Path, path: Path) -> None:
    """Both libraries buffer: a full disk can leave a short file without an error, so it is read back."""
    try:
        (read_exr if path.suffix == EXR else read_picture)(temporary)
    except InputError:
        raise OSError(errno.ENOSPC, "the written picture can't be read back", str(path)) from None


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
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = file.header()["dataWindow"]
        _require_few_pixels(path, int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except (InputError, MemoryError):
        raise
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


def require_latlong(
    values: Float[np.ndarray, "H W *C"],
    path: Path,
    what: str,
    remedy: str,
    *,
    lowest: float = -math.inf,
    highest: float = math.inf,
) -> None:
    """Raise InputError unless values of a file are a finite lat-long map between two bounds; `what` names them."""
    height, width = values.shape[:2]
    least, largest = float(values.min()), float(values.max())
    if width != 2 * height or not (math.isfinite(least + largest) and lowest <= least and largest <= highest):
        raise InputError(
            expected=f"a lat-long map of {what}, finite and twice as wide as high, in {path}",
            found=f"{width}×{height} with values from {least:.4g} to {largest:.4g}",
            remedy=remedy,
        )


def read_light(path: Path) -> Float[np.ndarray, "H W 3"]:
    """A lat-long map of radiance ≥ 0 that lights a scene.

    Lossy compression leaves values a hair below zero in Blender's own maps; they become zero.
    """
    radiance = read_exr_rgb(path)
    remedy = "Use another world, or export this one as a 2:1 map without NaN, infinity or negative values."
    require_latlong(radiance, path, "radiance ≥ 0", remedy, lowest=LOWEST_RADIANCE)
    return np.maximum(radiance, 0)


def write_png(path: Path, image: UInt8[np.ndarray, "H W *C"], *, quick: bool = False) -> None:
    """Write an 8-bit image: (H, W) gray, (H, W, 3) RGB or (H, W, 4) RGBA with straight alpha.

    A quick one takes a sixth of the time and is about 15 % larger.
    """
    speed = {"png:compressionLevel": 1, "png:filter": AVERAGE_FILTER} if quick else {}
    _write_picture(path, image, "png", {"oiio:UnassociatedAlpha": 1, **speed})


def write_jpeg(
    path: Path, image: UInt8[np.ndarray, "H W 3"], quality: int, exif: Mapping[str, Any] = MappingProxyType({})
) -> None:
    """Write an 8-bit RGB image as JPEG of a quality from 1 to 100, its chroma at half the resolution.

    `exif` are tags by the names that OpenImageIO gives them.
    """
    _write_picture(path, image, "jpeg", {"Compression": f"jpeg:{quality}", **exif})


def write_hdr(path: Path, radiance: Float[np.ndarray, "H W 3"]) -> None:
    """Write linear radiance ≥ 0 as Radiance RGBE, the first row on top; 8 bits a channel and an exponent a pixel."""
    _write_picture(path, radiance.astype(np.float32), "hdr", {}, numbers="float")


def _write_picture(
    path: Path, image: Num[np.ndarray, "H W *C"], kind: str, attributes: dict[str, Any], numbers: str = "uint8"
) -> None:
    import OpenImageIO as oiio

    pixels = np.ascontiguousarray(image if image.ndim == 3 else image[..., None])
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], numbers)
    for name, value in attributes.items():
        spec.attribute(name, value)
    with atomic_write(path) as temporary:
        file = oiio.ImageOutput.create(kind)
        assert file is not None
        if not (file.open(str(temporary), spec) and file.write_image(pixels) and file.close()):
            raise OSError(errno.ENOSPC, f"could not write the {kind.upper()} ({file.geterror()})", str(path))
        _require_complete_write(temporary, path)


@contextmanager
def _open_picture(path: Path) -> Iterator[tuple[Any, Any]]:
    """The file and its description; InputError for whatever goes wrong with it."""
    import OpenImageIO as oiio

    if not path.is_file():
        raise InputError(
            expected=f"an image at {path}", found="no such file", remedy="Check file_path in transforms_*.json."
        )
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)  # Else color is multiplied by alpha on the way in.
    file = oiio.ImageInput.open(str(path), hints)
    if file is None:
        raise _damaged(path, oiio.geterror())
    try:
        spec = file.spec()
        _require_few_pixels(path, spec.width, spec.height)
        yield file, spec
        error = file.geterror()
    finally:
        file.close()
    if error:
        raise _damaged(path, error)


def _require_few_pixels(path: Path, width: int, height: int) -> None:
    if width * height > LARGEST_PIXELS:
        raise InputError(
            expected=f"a picture of at most {LARGEST_PIXELS // 10**6} megapixels at {path}",
            found=f"{width}×{height}, {width * height / 1e6:.0f} megapixels",
            remedy="Make it smaller, with the camera's intrinsics, or leave it out.",
        )


def _damaged(path: Path, error: str) -> InputError:
    return InputError(
        expected=f"a complete image at {path}",
        found=error.strip().splitlines()[0] if error.strip() else "a file that can't be read",
        remedy="Restore the file, or export it again as PNG, JPEG, TIFF, HDR or EXR.",
    )


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture of any format, in pixels, without reading them."""
    with _open_picture(path) as (_, spec):
        return spec.width, spec.height


def picture_attributes(path: Path) -> dict[str, Any]:
    """What the file states beside its pixels, by OpenImageIO's names: `ExposureTime` (s), `Exif:FocalLength` (mm) …"""
    with _open_picture(path) as (_, spec):
        return {attribute.name: attribute.value for attribute in spec.extra_attribs}


def read_picture(path: Path) -> Num[np.ndarray, "H W C"]:
    """Read a picture with its numbers as stored: gray (C = 1), RGB (3) or RGBA (4).

    uint8 and uint16 are sRGB codes with straight alpha; float32 is linear and premultiplied by alpha, where it has any.
    A palette becomes RGB, or RGBA where it has transparency. Raises InputError for a file that is missing, damaged or
    of an unknown format, for pictures whose EXIF tag says that they lie on their side, for integers that were
    premultiplied, and for other types and numbers of channels.
    """
    pixels, orientation = _read_stored(path)
    if orientation != 1:
        raise InputError(
            expected=f"an upright picture at {path}",
            found=f"the EXIF orientation {orientation}, which some programs apply and others ignore",
            remedy="Turn the pixels (`mogrify -auto-orient`) or remove the tag: whichever the camera poses are for.",
        )
    return pixels


def read_upright(path: Path) -> Num[np.ndarray, "H W C"]:
    """The picture as `read_picture` has it, its pixels turned as its EXIF tag says."""
    pixels, orientation = _read_stored(path)
    transposed, backward = UPRIGHT.get(orientation, UPRIGHT[1])
    return np.flip(pixels.transpose(1, 0, 2) if transposed else pixels, backward)


def read_as_stored(path: Path) -> Num[np.ndarray, "H W C"]:
    """The picture as `read_picture` has it, whatever its EXIF tag says."""
    return _read_stored(path)[0]


def _read_stored(path: Path) -> tuple[Num[np.ndarray, "H W C"], int]:
    """Pixels as they are stored, and the EXIF orientation: 1 where they are upright."""
    if path.suffix.lower() == EXR:
        channels = read_exr(path)
        names = ("Y",) if "Y" in channels else ("R", "G", "B", "A") if "A" in channels else ("R", "G", "B")
        return stack_channels(channels, names, path), 1
    with _open_picture(path) as (file, spec):
        orientation = spec.get_int_attribute("Orientation", 1)
        straight = spec.get_int_attribute("oiio:UnassociatedAlpha", 0) == 1 or spec.alpha_channel < 0
        gray_alpha = spec.nchannels == 2 and spec.alpha_channel == 1
        pixels = file.read_image(spec.format)
        if pixels is None:
            raise _damaged(path, file.geterror())
    if gray_alpha:
        pixels = pixels[..., [0, 0, 0, 1]]
    floating = pixels.dtype.kind == "f"
    if not (floating or pixels.dtype in (np.uint8, np.uint16)) or pixels.shape[2] not in CHANNEL_COUNTS:
        raise InputError(
            expected=f"gray, RGB or RGBA of 8 or 16 bits, or of floating point, in {path}",
            found=f"{pixels.shape[2]} channels of type {pixels.dtype}",
            remedy="Export it again as one of these.",
        )
    if not straight and not floating:
        raise InputError(
            expected=f"straight (unassociated) alpha in {path}",
            found="color that was multiplied by alpha",
            remedy="Export it again with straight alpha, or as PNG.",
        )
    if floating and straight and pixels.shape[2] == 4:
        pixels = np.concatenate([pixels[..., :3] * pixels[..., 3:], pixels[..., 3:]], -1)
    return pixels.astype(np.float32) if floating else pixels, orientation


def unit_values(image: Num[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Codes of 8 or 16 bits as float32 in [0, 1]; floating-point numbers as they are."""
    if image.dtype.kind == "f":
        return image.astype(np.float32)
    return image.astype(np.float32) / np.iinfo(image.dtype).max


def to_bytes(image: Num[np.ndarray, "*S"]) -> UInt8[np.ndarray, "*S"]:
    """Codes of 16 bits, and floating-point numbers clipped to [0, 1], as the nearest of 8 bits; 8 bits as they are."""
    if image.dtype == np.uint16:
        return ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)  # 65535 = 257 · 255.
    return image if image.dtype == np.uint8 else np.rint(image.clip(0, 1) * 255).astype(np.uint8)


def read_png(path: Path) -> UInt8[np.ndarray, "H W C"]:
    """Read a picture as `read_picture` does, reduced to 8 bits."""
    return to_bytes(read_picture(path))
