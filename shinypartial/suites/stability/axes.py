"""Axes of the suite as data: what gets worse, in which steps, and the options that this becomes."""

import math
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Axis:
    """One way in which data get worse, from `clean` through `levels`."""

    name: str
    title: str
    unit: str
    clean: float
    levels: tuple[float, ...]
    options: str
    """Of `shinypartial perturb`, or of `generate` where `rendered`; {level} is the level, {factor} 1 + level / 100, and
    {0}, {1}, … are its products with `sizes`."""
    sizes: tuple[float, ...] = ()
    around: str = ""
    """Options of `shinypartial generate` for what is perturbed; none: that of the clean dataset."""
    rendered: bool = False
    own_truth: bool = False
    """Whether the copy is scored on itself, because its ground truth differs from that of the clean dataset."""
    kind: Literal["core", "further", "anchor"] = "core"

    def arguments(self, level: float) -> list[str]:
        """The options at a level, as words."""
        sizes = (f"{level * each:g}" for each in self.sizes)
        return self.options.format(*sizes, level=f"{level:g}", factor=f"{1 + level / 100:g}").split()

    def position(self, level: float | None) -> float:
        """Where a level lies for interpolation, growing as data get worse; None is the clean dataset."""
        value = self.clean if level is None else level
        if math.isinf(self.clean):
            return 1 / value
        return abs(value - self.clean)

    def text(self, position: float) -> str:
        """A position as a level with its unit."""
        if math.isinf(self.clean):
            return f"{1 / position:.3g}{self.unit}"
        return f"{self.clean + math.copysign(position, self.levels[-1] - self.clean):.3g}{self.unit}"


CAPTURE = (
    "--cameras.rotation-deg {0} --cameras.focal-factor {factor} --masks.offset-px {level} --masks.wobble-px {1} "
    "--sensor.k1 {2} --sensor.exposure-sigma-stops {3} --sensor.white-balance-sigma-stops {4} --sensor.shot-noise {5} "
    "--sensor.read-noise {6} --sensor.jpeg-quality 90"
)
"""Everything that a capture by hand gets wrong, at once: at level 1, cameras turned by 0.3°, a focal length 1 % too
long, masks off by up to 1 px, …"""
SIZES = (0.3, 0.3, 0.02, 0.1, 0.05, 0.01, 0.005)
"""…that wander by 0.3 px, k₁ of 0.02, exposures by 0.1 stops, gains of channels by 0.05 stops, and noise."""
AXES = (
    Axis("capture", "Realistic capture, all errors at once", "", 0, (0.5, 1, 2), CAPTURE, SIZES),
    Axis(
        "capture-room",
        "Realistic capture in a room 8 radii away",
        "",
        0,
        (0.5, 1, 2),
        CAPTURE,
        SIZES,
        "--surroundings-radii 8 --surroundings-room box",
        kind="further",
    ),
    Axis("rotation", "Camera rotation", "°", 0, (0.1, 0.25, 0.5, 1, 2), "--cameras.rotation-deg {level}"),
    Axis("masks-eroded", "Masks eroded", " px", 0, (1, 2, 4), "--masks.erode-px {level}"),
    Axis("masks-dilated", "Masks dilated", " px", 0, (1, 2, 4), "--masks.dilate-px {level}"),
    Axis("focal", "Focal length too long", " %", 0, (0.5, 1, 2, 4), "--cameras.focal-factor {factor}"),
    Axis("views", "Training views", " views", 50, (25, 10, 5, 3), "--views.keep {level}"),
    Axis("arc", "Arc of views", "°", 150, (120, 90, 60, 30, 15), "--views.arc-deg {level}"),
    Axis(
        "room",
        "Distance of the room, in object radii",
        " radii",
        math.inf,
        (20, 10, 5, 2),
        "--surroundings-radii {level}",
        rendered=True,
    ),
    Axis("roughness", "Roughness", "", 0, (0.05, 0.1, 0.2, 0.3), "--roughness {level}", rendered=True),
    Axis("exposure", "Exposure drift, σ", " stops", 0, (0.05, 0.15, 0.3), "--sensor.exposure-sigma-stops {level}"),
    Axis("masks-offset", "Masks off by view", " px", 0, (0.5, 1, 2), "--masks.offset-px {level}", kind="further"),
    Axis("masks-wobbling", "Masks that wander, σ", " px", 0, (0.5, 1, 2), "--masks.wobble-px {level}", kind="further"),
    Axis("noise", "Shot noise at radiance 1", "", 0, (0.01, 0.03, 0.1), "--sensor.shot-noise {level}", kind="further"),
    Axis(
        "white-balance",
        "White balance, σ",
        " stops",
        0,
        (0.05, 0.15, 0.3),
        "--sensor.white-balance-sigma-stops {level}",
        kind="further",
    ),
    Axis("jpeg", "JPEG quality", "", 100, (90, 70, 40), "--sensor.jpeg-quality {level}", kind="further"),
    Axis("blur", "Blur, σ", " px", 0, (0.5, 1, 2), "--sensor.blur-px {level}", kind="further"),
    Axis(
        "position",
        "Camera position, σ as a share of the distance",
        "",
        0,
        (0.002, 0.005, 0.01, 0.02),
        "--cameras.position-sigma {level}",
        kind="further",
    ),
    Axis("distortion", "Distortion k₁", "", 0, (0.03, 0.1, 0.2), "--sensor.k1 {level}", kind="further"),
    Axis("size", "Size of the object", "", 1, (0.75, 0.5, 0.25), "--views.object-scale {level}", kind="further"),
    Axis("cut", "Share of the object cut off", "", 0, (0.1, 0.2, 0.4), "--views.cut {level}", kind="further"),
    Axis("turned", "World turned", "", 0, (1,), "--world.random-turn", own_truth=True, kind="further"),
    Axis("matte", "Matte object", "", 0, (1,), "--roughness {level} --metallic 0", rendered=True, kind="anchor"),
)
#: Cells of every plan that a verdict has to refuse: a matte object, and cameras that are far off but taken as stated.
ANCHORS = (("rotation", 2.0), ("matte", 1.0))
BY_NAME = {axis.name: axis for axis in AXES}
