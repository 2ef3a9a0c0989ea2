"""What a film or a few photographs hold besides their scene: the hand with the phone, and what this makes of light."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from shinypartial.core.handheld import Hand
from shinypartial.core.trajectory import Seed, limits
from shinypartial.io.records import NonEmpty, NonNegative, write_record
from shinypartial.scene.spec import SceneSpec

Compression = Literal["HIGH", "MEDIUM", "LOW"]
PixelLength = Annotated[float, limits(0.0, 50.0)]


@dataclass(frozen=True)
class Phone:
    """Lens, sensor and file of the phone, in the order of light; lengths in pixels are for `Render.resolution`."""

    aspect: tuple[Annotated[int, limits(1, 64)], Annotated[int, limits(1, 64)]] = (4, 3)
    """Width to height."""
    k1: Annotated[float, limits(0.0, 1.0)] = 0.06
    """Radial distortion in r², in OpenCV's model; a phone's is above zero, so that a pinhole of the same size sees
    all of its picture."""
    focus_px: PixelLength = 0.5
    """Blur where the focus, which rolls to and fro, is at its worst: standard deviation."""
    focus_frames: Annotated[float, limits(1.0, 1e4)] = 20.0
    """Frames that the focus takes for once to and fro."""
    shake_px: PixelLength = 0.5
    """Root mean square of the way that the picture moves during an exposure."""
    vignette_stops: NonNegative = 0.2
    """Light lost in the corners."""
    drift_stops: NonNegative = 0.05
    """Standard deviation of the exposure, which drifts as slowly as the hand."""
    shot_noise: NonNegative = 0.01
    """Standard deviation of shot noise at radiance 1."""
    read_noise: NonNegative = 0.002
    """Standard deviation of read noise."""
    quality: Compression = "HIGH"
    """Of the video: Blender's names for constant rate factors 17, 23 and 26 of H.264."""
    frames_per_second: Annotated[int, limits(1, 240)] = 10
    """Of the video, which shows a slow walk in few frames."""
    seed: Seed = 0
    """Seed of noise, shake and drift."""


@dataclass(frozen=True)
class Photographs:
    """Still pictures in place of a video, with the EXIF tags that a phone writes beside them."""

    bracket_stops: NonEmpty[Annotated[float, limits(-12.0, 12.0)]] = (0.0,)
    """Every pose is photographed once at each of these exposures."""
    bracket_sway: Annotated[float, limits(0.0, 0.2)] = 0.0
    """Root mean square along each axis of how far the camera moves between the shots of a bracket, as a share of the
    distance from the target."""
    sensor_width_mm: Annotated[float, limits(1.0, 100.0)] = 7.0
    """The focal length in millimeters is that before a sensor of this width."""
    focal_plane: bool = False
    """Whether the tags state the sensor's pixels per inch; most phones state the focal length in 35 mm film alone."""


@dataclass(frozen=True)
class FilmSpec:
    """Everything that determines a film; `scene.camera` holds the path that the hand follows, and what is tested.

    The film has `scene.camera.train` frames, or photographs are taken from as many poses; `scene.camera.test` further
    views are taken by a steady pinhole.
    """

    scene: SceneSpec
    hand: Hand = Hand()
    phone: Phone = Phone()
    photographs: Photographs | None = None
    """None: a video."""

    @property
    def shot_stops(self) -> tuple[float, ...]:
        """Exposures of the pictures from one pose."""
        return self.photographs.bracket_stops if self.photographs else (0.0,)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels, both even, as video needs them."""
        width = self.scene.render.resolution
        across, upward = self.phone.aspect
        return width, 2 * round(width * upward / across / 2)

    def recipe(self) -> dict[str, Any]:
        """The specification as JSON holds it."""
        return {**write_record(self), "scene": self.scene.recipe()}
