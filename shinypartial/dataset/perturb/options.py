"""What a copy does worse than its source. The defaults change nothing."""

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from shinypartial.io.records import Count, NonNegative, Positive, Share, check_record, write_record


@dataclass(frozen=True)
class CameraErrors:
    """What the transforms of the training views state wrongly; the pictures stay as they are."""

    rotation_deg: Annotated[float, Meta(ge=0, le=180)] = 0.0
    """Turn each camera by this angle about a random axis through its center."""
    rotation_sigma_deg: Annotated[float, Meta(ge=0, le=180)] = 0.0
    """Turn each camera by a Gaussian rotation vector: its standard deviation about each of the three axes."""
    position_sigma: NonNegative = 0.0
    """Move each camera by a Gaussian vector: its standard deviation along each axis, as a share of the distance to the
    point that the cameras look at."""
    focal_factor: Positive = 1.0
    """Multiply the focal length of all cameras by this."""
    principal_point_px: tuple[float, float] = (0.0, 0.0)
    """Move the principal point of all cameras to the right and downward, in pixels."""


@dataclass(frozen=True)
class MaskErrors:
    """Wrong masks of the training views. What a larger mask takes in is black unless the source has a background."""

    erode_px: NonNegative = 0.0
    """Move the silhouette inward by this many pixels."""
    dilate_px: NonNegative = 0.0
    """Move the silhouette outward by this many pixels, after the erosion."""
    offset_px: NonNegative = 0.0
    """Move the silhouette of each view by a distance drawn evenly up to this many pixels, inward or outward."""
    wobble_px: NonNegative = 0.0
    """Standard deviation in pixels by which the silhouette of each view then wanders in and out, over some 20 pixels,
    as silhouettes of segmenters and by hand do."""
    holes: Annotated[float, Meta(ge=0, le=0.9)] = 0.0
    """Share of the object's area that round holes take away."""
    stray: Share = 0.0
    """Area of round blobs outside the object, as a share of its area."""
    empty: Share = 0.0
    """Share of the views whose mask is empty, drawn by chance."""


@dataclass(frozen=True)
class SensorErrors:
    """A poorer lens, sensor and file for the training views, applied in the order of a camera."""

    blur_px: NonNegative = 0.0
    """Standard deviation of a Gaussian blur in pixels."""
    k1: float = 0.0
    """Radial distortion in r², in OpenCV's model: the pictures are warped."""
    record_distortion: bool = False
    """State k1 in the transforms; panoless and `shinypartial evaluate` refuse a folder that states them."""
    vignette_stops: NonNegative = 0.0
    """Light lost in the corners in stops; the loss grows with the square of the distance from the middle."""
    exposure_sigma_stops: NonNegative = 0.0
    """Standard deviation of the exposure of each view in stops."""
    white_balance_sigma_stops: NonNegative = 0.0
    """Standard deviation of the gain of each channel of each view in stops."""
    shot_noise: NonNegative = 0.0
    """Standard deviation of shot noise at radiance 1; its variance is proportional to radiance."""
    read_noise: NonNegative = 0.0
    """Standard deviation of read noise, the same at every radiance."""
    srgb8: bool = False
    """Store 8-bit sRGB clipped to [0, 1] in place of unbounded radiance."""
    jpeg_quality: Annotated[int, Meta(ge=1, le=100)] | None = None
    """Store JPEG of this quality, with the mask in a PNG beside it."""


@dataclass(frozen=True)
class ViewChoice:
    """Fewer training views, or less of the object in each."""

    keep: Count | None = None
    """Number of training views that remain, evenly along their order."""
    arc_deg: Annotated[float, Meta(gt=0, le=360)] | None = None
    """Keep the views within half of this angle in azimuth about the middle of the training cameras, seen from the
    point that they look at."""
    object_scale: Annotated[float, Meta(gt=0, le=1)] = 1.0
    """Shrink each picture by this factor about its middle, within a frame of the same size."""
    cut: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    """Crop all pictures equally on the left, so that on average this share of the object's bounding box is cut off."""


@dataclass(frozen=True)
class World:
    """Everything turned about the origin, ground truth and test views included: a fit should not change."""

    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector: its direction is the axis, its length the angle in degrees."""
    random_turn: bool = False
    """Turn further by a rotation drawn uniformly."""


@dataclass(frozen=True)
class Perturbation:
    """All that is made worse, and the seed of what is drawn by chance."""

    cameras: CameraErrors = CameraErrors()
    masks: MaskErrors = MaskErrors()
    sensor: SensorErrors = SensorErrors()
    views: ViewChoice = ViewChoice()
    world: World = World()
    seed: Annotated[int, Meta(ge=0, le=2**31 - 1)] = 0

    @property
    def changes_pictures(self) -> bool:
        """Whether pictures or masks of the training views are made again; else they are copied."""
        views = self.views
        lens = dataclasses.replace(self.sensor, record_distortion=False)
        return self.masks != MaskErrors() or lens != SensorErrors() or views.object_scale < 1 or views.cut > 0


def check_options(options: Perturbation) -> None:
    """Raise InputError, worded as on the command line, for values out of range."""
    check_record(
        options,
        "the options",
        place=lambda path: f"--{path.replace('_', '-')}",
        remedy="Correct that value.",
    )


def changed_options(options: Perturbation) -> dict[str, Any]:
    """The options that differ from their defaults, group by group."""
    given, defaults = write_record(options), write_record(Perturbation())
    groups = {
        group: {name: value for name, value in values.items() if value != defaults[group][name]}
        for group, values in given.items()
        if isinstance(values, dict)
    }
    return {group: values for group, values in groups.items() if values}
