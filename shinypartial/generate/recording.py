"""From radiance to the picture of a phone: shake, focus, lens, vignette, exposure, noise, eight bits."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from shinypartial.core.camera import Camera
from shinypartial.core.color import to_display
from shinypartial.core.conventions import FILM_DIAGONAL_MM, INCH_MM
from shinypartial.dataset.perturb.sensor import add_noise, blur, undistorted_pixels, vignette_gain, warp
from shinypartial.dataset.write import encode_unit
from shinypartial.scene import FilmSpec, Phone, Photographs

#: Of a picture whose gain is 1; the ISO speed and the aperture are the same in all of them.
EXPOSURE_S = 1 / 60
SENSITIVITY, F_NUMBER = 100, 1.8
#: EXIF's number for a resolution in pixels an inch.
INCHES = 2


@dataclass(frozen=True)
class Moment:
    """What is particular about one frame."""

    gain: float
    """Its exposure over that of a steady camera."""
    focus_px: float
    """Blur by the focus: standard deviation."""
    shake_px: tuple[float, float]
    """How far the picture moves to the right and downward during the exposure."""
    seed: int
    """Of its noise."""


def moments(spec: FilmSpec) -> tuple[Moment, ...]:
    """Of every picture, those from one pose in the order of `shot_stops`.

    The focus rolls as |sin|; the exposure wanders as slowly as the hand; both are the same all through a bracket.
    Shakes are independent.
    """
    phone, count, shots = spec.phone, spec.scene.camera.train, spec.shot_stops
    random = np.random.default_rng(phone.seed)
    window = np.hanning(2 * int(spec.hand.smooth_frames) + 3)
    noise = random.normal(size=count + len(window) - 1)
    drift = phone.drift_stops * np.convolve(noise, window / np.linalg.norm(window), mode="valid")
    focus = phone.focus_px * np.abs(np.sin(np.pi * np.arange(count) / phone.focus_frames))
    shakes = phone.shake_px / np.sqrt(2) * random.normal(size=(count * len(shots), 2))
    stops = (drift[:, None] + np.array(shots)).ravel()
    return tuple(
        Moment(float(2.0**stops), float(px), (float(shake[0]), float(shake[1])), phone.seed + index)
        for index, (stops, px, shake) in enumerate(zip(stops, np.repeat(focus, len(shots)), shakes, strict=True))
    )


def recorded_picture(
    radiance: Float[np.ndarray, "H W 3"], camera: Camera, phone: Phone, moment: Moment
) -> UInt8[np.ndarray, "H W 3"]:
    """The frame that a phone makes of what a pinhole of the same size sees."""
    shaken = smeared(radiance, moment.shake_px)
    focused = blur(shaken, moment.focus_px) if moment.focus_px else shaken
    bent = warp(focused, undistorted_pixels(camera, phone.k1))
    gain = moment.gain * vignette_gain(camera.height, camera.width, phone.vignette_stops)
    random = np.random.default_rng(moment.seed)
    light = add_noise(bent * gain[..., None].astype(np.float32), phone.shot_noise, phone.read_noise, random)
    return to_display(light)


def exif_tags(camera: Camera, photographs: Photographs, moment: Moment) -> dict[str, Any]:
    """What a phone writes beside a photograph, by OpenImageIO's names.

    f₃₅ = f · d₃₅/d, a whole number, d the diagonals (CIPA DCG-001); the exposure is t = t₁ · gain.
    """
    diagonal = math.hypot(camera.width, camera.height)
    px_per_mm = camera.width / photographs.sensor_width_mm
    tags = {
        "Make": "Rendered",
        "Model": "Rendered",
        "Orientation": 1,
        "ExposureTime": EXPOSURE_S * moment.gain,
        "FNumber": F_NUMBER,
        "Exif:PhotographicSensitivity": SENSITIVITY,
        "Exif:FocalLength": camera.fx / px_per_mm,
        "Exif:FocalLengthIn35mmFilm": round(camera.fx * FILM_DIAGONAL_MM / diagonal),
    }
    if photographs.focal_plane:
        px_per_inch = px_per_mm * INCH_MM
        tags |= {f"Exif:FocalPlane{axis}Resolution": px_per_inch for axis in "XY"}
        tags["Exif:FocalPlaneResolutionUnit"] = INCHES
    return tags


def recorded_mask(alpha: Float[np.ndarray, "H W"], camera: Camera, phone: Phone) -> UInt8[np.ndarray, "H W"]:
    """Where the object is in the frame, as 8-bit code of the share of each pixel."""
    return encode_unit(warp(alpha[..., None], undistorted_pixels(camera, phone.k1))[..., 0])


def smeared(image: Float[np.ndarray, "H W C"], way_px: tuple[float, float]) -> Float[np.ndarray, "H W C"]:
    """The mean of the picture along a straight way (right, down) about where it is, at constant speed."""
    from scipy.ndimage import convolve

    x, y = way_px
    reach = int(np.ceil(max(abs(x), abs(y)) / 2))
    if reach == 0:
        return image
    kernel = np.zeros((2 * reach + 2,) * 2)
    steps = 8 * reach + 1
    for share in (np.arange(steps) + 0.5) / steps - 0.5:
        row, column = reach + share * y, reach + share * x
        i, j = int(np.floor(row)), int(np.floor(column))
        for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
            weight = (row - i if di else i + 1 - row) * (column - j if dj else j + 1 - column)
            kernel[i + di, j + dj] += weight / steps
    kernel = kernel[: 2 * reach + 1, : 2 * reach + 1]
    planes = [convolve(plane, kernel / kernel.sum(), mode="nearest") for plane in np.moveaxis(image, -1, 0)]
    return np.stack(planes, -1).astype(image.dtype)
