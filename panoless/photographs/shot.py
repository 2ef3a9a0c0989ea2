"""What a camera says of a photograph in its file: focal length and exposure; and its pixels as linear light.

EXIF states a focal length f of 35 mm film, whose diagonal is 43.27 mm, or millimeters of the lens and pixels a unit of
the sensor. The exposure is t · ISO/N², with the time t (s) and the aperture N: twice as much light doubles it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Num, UInt8

from panoless.photographs.lens import INSTALL
from shinypartial.core.color import LINEAR_OF_CODES, srgb_to_linear, to_display
from shinypartial.core.conventions import FILM_DIAGONAL_MM, INCH_MM
from shinypartial.core.errors import InputError
from shinypartial.io.images import EXR, picture_attributes, read_upright, unit_values

RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
CLIPPED = 0.985
"""Share of the largest code from which a pixel is clipped: JPEG moves codes by some levels."""
CENTIMETER_MM = 10.0


@dataclass(frozen=True)
class Focal:
    """A focal length, and how it is known."""

    over_diagonal: float
    """In diagonals of the picture: of 35 mm film, f/43.27 mm."""
    sigma: float
    """Standard deviation of its logarithm."""
    origin: str

    def pixels(self, width: int, height: int) -> float:
        """In pixels of an uncropped picture of that size."""
        return self.over_diagonal * math.hypot(width, height)

    @property
    def film_mm(self) -> float:
        """On 35 mm film."""
        return self.over_diagonal * FILM_DIAGONAL_MM


def given_focal(film_mm: float) -> Focal:
    """What a person states."""
    return Focal(film_mm / FILM_DIAGONAL_MM, 0.01, "as given")


def focal_of(exif: Mapping[str, Any], width: int, height: int) -> Focal:
    """What EXIF says; else that of a phone, or of any camera, with the spread that these have."""
    film = _number(exif, "Exif:FocalLengthIn35mmFilm")
    if film:
        return Focal(film / FILM_DIAGONAL_MM, 0.02, "EXIF, 35 mm equivalent")
    lens_mm = _number(exif, "Exif:FocalLength")
    density = _number(exif, "Exif:FocalPlaneXResolution")
    if lens_mm and density:
        unit = CENTIMETER_MM if exif.get("Exif:FocalPlaneResolutionUnit") == 3 else INCH_MM
        wide = max(_number(exif, "Exif:PixelXDimension") or width, _number(exif, "Exif:PixelYDimension") or height)
        pixels = lens_mm * density / unit * max(width, height) / wide
        return Focal(pixels / math.hypot(width, height), 0.02, "EXIF, lens and sensor")
    if lens_mm and lens_mm < 10:
        return Focal(27 / FILM_DIAGONAL_MM, 0.08, f"a phone's main camera ({lens_mm:g} mm, sensor not stated)")
    return Focal(32 / FILM_DIAGONAL_MM, 0.25, "a guess: EXIF states none")


def exposure_of(exif: Mapping[str, Any]) -> float | None:
    """t · ISO/N² of EXIF; None where it does not state the time."""
    time = _number(exif, "ExposureTime")
    iso = _number(exif, "Exif:PhotographicSensitivity") or _number(exif, "Exif:ISOSpeedRatings") or 100.0
    aperture = _number(exif, "FNumber") or 1.0
    return time * iso / aperture**2 if time else None


def _number(exif: Mapping[str, Any], name: str) -> float | None:
    value = exif.get(name)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) and value > 0 else None


@dataclass(frozen=True)
class Shot:
    """A photograph as it was read, upright."""

    name: str
    source: Path
    pixels: Num[np.ndarray, "H W 3"]
    """uint8 or uint16: sRGB codes; float32: linear light."""
    focal: Focal
    exposure: float | None
    clips_at: float
    """Linear light from which a pixel is clipped; infinite where nothing is."""

    @property
    def linear(self) -> bool:
        """Whether pixels are linear light already."""
        return self.pixels.dtype.kind == "f"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def radiance(self) -> Float[np.ndarray, "H W 3"]:
        """Linear light."""
        if self.linear:
            return np.asarray(self.pixels, np.float32)
        if self.pixels.dtype == np.uint8:
            return np.asarray(LINEAR_OF_CODES[self.pixels])
        return srgb_to_linear(unit_values(self.pixels))

    def codes(self) -> UInt8[np.ndarray, "H W 3"]:
        """8-bit sRGB; linear light so that its brightest hundredth ends at 1."""
        if self.pixels.dtype == np.uint8:
            return self.pixels
        if not self.linear:
            return np.asarray(self.pixels >> 8, np.uint8)
        return to_display(self.pixels / max(float(np.percentile(self.pixels[::4, ::4], 99)), 1e-9))

    def reduced(self, side: int) -> "Shot":
        """Averaged over blocks of `side` × `side` pixels, in linear light."""
        if side == 1:
            return self
        from panoless.photographs.frames import block_means

        width, height = (length // side for length in self.size)
        if self.pixels.dtype == np.uint8:
            return replace(self, pixels=block_means(self.pixels, side))
        blocks = self.radiance()[: height * side, : width * side].reshape(height, side, width, side, 3)
        return replace(self, pixels=blocks.mean((1, 3)).astype(np.float32))


def read_shot(path: Path) -> Shot:
    """Read a photograph of any format, RAW included; InputError for what can't be read."""
    raw = path.suffix.lower() in RAW_SUFFIXES
    pixels = _developed(path) if raw else read_upright(path)
    if pixels.shape[2] != 3:
        pixels = np.repeat(pixels[..., :1], 3, 2) if pixels.shape[2] == 1 else pixels[..., :3]
    exif = {} if path.suffix.lower() == EXR else _attributes(path)
    clips_at = math.inf if pixels.dtype.kind == "f" else float(srgb_to_linear(np.array([CLIPPED]))[0])
    if raw:
        pixels, clips_at = unit_values(pixels), CLIPPED
    height, width = pixels.shape[:2]
    focal = focal_of(exif, width, height)
    return Shot(path.stem, path, np.ascontiguousarray(pixels), focal, exposure_of(exif), clips_at)


def _attributes(path: Path) -> dict[str, Any]:
    try:
        return picture_attributes(path)
    except InputError:  # A RAW file that OpenImageIO does not open: rawpy knows no EXIF.
        return {}


def _developed(path: Path) -> Num[np.ndarray, "H W 3"]:
    """A RAW photograph as linear light in the primaries of sRGB, 16 bits, with the camera's white balance."""
    try:
        import rawpy
    except ImportError:
        raise InputError(expected="rawpy, for RAW photographs", found="no module rawpy", remedy=INSTALL) from None
    if not path.is_file():
        raise InputError(expected=f"a photograph at {path}", found="no such file", remedy="Check the path.")
    try:
        with rawpy.imread(str(path)) as file:
            developed: np.ndarray = file.postprocess(
                gamma=(1, 1), no_auto_bright=True, adjust_maximum_thr=0.0, output_bps=16, use_camera_wb=True
            )
    except rawpy.LibRawError as error:
        raise InputError(
            expected=f"a RAW photograph at {path}", found=str(error), remedy="Convert it to DNG, TIFF or EXR."
        ) from None
    return developed
