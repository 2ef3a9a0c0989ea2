"""What a film holds besides its scene: the hand that carries the phone, and what the phone makes of light."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from shinypartial.core.handheld import Hand
from shinypartial.core.trajectory import Seed, limits
from shinypartial.io.records import NonNegative, write_record
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
class FilmSpec:
    """Everything that determines a film; `scene.camera` holds the path that the hand follows, and what is tested.

    The film has `scene.camera.train` frames; `scene.camera.test` further views are taken by a steady pinhole.
    """

    scene: SceneSpec
    hand: Hand = Hand()
    phone: Phone = Phone()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels, both even, as video needs them."""
        width = self.scene.render.resolution
        across, upward = self.phone.aspect
        return width, 2 * round(width * upward / across / 2)

    def recipe(self) -> dict[str, Any]:
        """The specification as JSON holds it."""
        return {**write_record(self), "scene": self.scene.recipe()}
