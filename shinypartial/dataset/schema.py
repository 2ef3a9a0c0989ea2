"""Names and types of the dataset folder: the only place where its layout is spelled out."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from msgspec import Meta

from shinypartial.core.camera import Camera, Similarity
from shinypartial.io.images import EXR, PICTURE_SUFFIXES
from shinypartial.io.records import NonNegative, Share

FORMAT = "shinypartial-dataset"
FORMAT_VERSION = 1
#: What a minor version adds may be ignored: 1 adds self-reflection to every view, 2 the inverse distance of near
#: surroundings. A manifest without one means 0.
FORMAT_MINOR = 2
MANIFEST = "dataset.json"
CHECKSUMS = "SHA256SUMS"
LICENSES = "LICENSES.json"
SPLITS = ("train", "test")
COLOR_CHANNELS = ("R", "G", "B", "A")
NORMAL_CHANNELS = ("normal.X", "normal.Y", "normal.Z")
DEPTH_CHANNEL = "depth.Z"
SELF_REFLECTION_CHANNEL = "self_reflection.V"
CONTACT_SHEET = "contact_sheet.jpg"
ENVIRONMENT_LATLONG = Path("environment/latlong.exr")
ENVIRONMENT_LATLONG_Y_UP = Path("environment/latlong_yup.exr")
ENVIRONMENT_INVERSE_DISTANCE = Path("environment/inverse_distance.exr")
INVERSE_DISTANCE_CHANNEL = "Y"
ENVIRONMENT_CUBE = Path("environment/cube")
BACKGROUND = "background.exr"
NORMAL_ERROR = 1e-4
"""By which the length of a stated normal may differ from one."""


@dataclass(frozen=True)
class View:
    """One photograph with what is known about it.

    `radiance` is linear and premultiplied by alpha; `normals_world` are unit where the object is and zero elsewhere;
    `depth` is camera z-depth in scene units, zero where the object is not. `None`: the dataset doesn't hold it.
    `high_dynamic_range` determines whether radiance came from EXR, HDR or a TIFF of floating point (unbounded), or from
    sRGB codes (in [0, 1]).
    `self_reflection` is 1 where the mirror ray of the pixel's center meets the object again, or something else that
    stands near it, in place of the environment; 0 elsewhere, also where the object is not.
    """

    radiance: Float[np.ndarray, "H W 3"]
    alpha: Float[np.ndarray, "H W"]
    normals_world: Float[np.ndarray, "H W 3"] | None
    depth: Float[np.ndarray, "H W"] | None
    high_dynamic_range: bool
    self_reflection: Float[np.ndarray, "H W"] | None = None


def find_picture(stem: Path, suffix: str = "") -> Path:
    """The file of a photograph: the EXR where there is one, else `suffix` if that is given, else what lies there."""
    named = (suffix,) if suffix else (*PICTURE_SUFFIXES, *map(str.upper, PICTURE_SUFFIXES))
    candidates = [stem.with_name(stem.name + each) for each in (EXR, *named)]
    return next((path for path in candidates if path.exists()), candidates[1])


@dataclass(frozen=True)
class Frame:
    """A named camera of a split; `stem` is the image path without extension or suffix.

    `suffix` is the extension of the photograph where the transforms name it, `mask` the file that holds its mask where
    they name one. `pose_covariance` is that of the camera's turn (rad, world axes) and of its center's shift (scene
    units), where they state it.
    """

    name: str
    camera: Camera
    stem: Path
    suffix: str = ""
    mask: Path | None = None
    pose_covariance: Float[np.ndarray, "6 6"] | None = None

    @property
    def photograph(self) -> Path:
        """What the view is read from."""
        return find_picture(self.stem, self.suffix)

    @property
    def exr(self) -> Path:
        """Linear RGBA, normals and depth: the ground truth proper."""
        return self.stem.with_name(self.stem.name + ".exr")

    @property
    def png(self) -> Path:
        """RGBA, straight alpha, sRGB of linear light clipped to [0, 1]."""
        return self.stem.with_name(self.stem.name + ".png")

    @property
    def alpha_png(self) -> Path:
        """8-bit alpha."""
        return self.stem.with_name(self.stem.name + "_alpha.png")

    @property
    def normal_png(self) -> Path:
        """World normals as round((n + 1)/2 · 255)."""
        return self.stem.with_name(self.stem.name + "_normal.png")

    @property
    def self_png(self) -> Path:
        """8-bit self-reflection, 0 or 255."""
        return self.stem.with_name(self.stem.name + "_self.png")

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that each frame has, the EXR last, so that its presence means that the frame is complete.

        Frames of rendered datasets also have `self_png`.
        """
        return (self.png, self.alpha_png, self.normal_png, self.exr)


@dataclass(frozen=True)
class GroundPlane:
    """What the object stands on: points x of the world with n · x = offset."""

    normal: tuple[float, float, float]
    """n, of length 1, toward the cameras."""
    offset: float

    @property
    def is_plane(self) -> bool:
        """Whether the normal has length 1 and all is finite."""
        return math.isfinite(self.offset) and abs(math.hypot(*self.normal) - 1) <= NORMAL_ERROR

    def moved(self, by: Similarity) -> "GroundPlane":
        """In another world."""
        x, y, z = map(float, by.rotation @ np.array(self.normal))
        return GroundPlane((x, y, z), by.scale * self.offset + float(np.array((x, y, z)) @ by.shift))


@dataclass(frozen=True)
class Statement:
    """What a capture knows and how sure it is, as `transforms_train.json` states it."""

    focal_sigma: NonNegative | None = None
    """Standard deviation of the focal length, as a share of it; None: it is not stated."""
    mask_sigma_px: NonNegative = 0.0
    """That of the contours of masks, in pixels, beyond the error of right ones."""
    ground: GroundPlane | None = None
    """What the object stands on; None: it is not stated."""

    def moved(self, by: Similarity) -> "Statement":
        """In another world."""
        return self if self.ground is None else replace(self, ground=self.ground.moved(by))


@dataclass(frozen=True)
class BallEvidence:
    """What a capture of a mirror ball knows of itself, as `transforms_train.json` states it."""

    rim_px: NonNegative
    """Median distance of the rim's points from its cone."""
    rim_seen: Share
    """Share of the rim at which an edge was seen: median over views."""
    focal_sigma: NonNegative
    """Standard deviation of the focal length, as a share of it."""
    reflection_deg: NonNegative
    """Median angle between what views mirror and where it lies; 0 of a single view."""
    turn_deg: NonNegative
    """Standard deviation of a camera's turn: median over views; 0 of a single view."""
    agreement: Annotated[float, Meta(ge=-1, le=1)] | None = None
    """Correlation of what lies beside the ball with what it mirrors; None where too little does."""
    exposures_known: bool = False
    """Whether all photographs state theirs, so that they have been equalized."""
    background: bool = False
    """Whether `background.exr` has what was seen past the ball: linear light in lat-long, alpha 1 where any is."""


@dataclass(frozen=True)
class Dataset:
    """An opened dataset folder; `manifest` is empty for a plain NeRF-synthetic folder."""

    root: Path
    manifest: dict[str, Any]
    train: tuple[Frame, ...] = field(repr=False)
    test: tuple[Frame, ...] = field(repr=False)

    @property
    def name(self) -> str:
        """Folder name, used to name runs and predictions."""
        return self.root.resolve().name

    @property
    def recipe(self) -> dict[str, Any]:
        """What determines the content, by the manifest; empty where it states nothing."""
        return self._table("recipe")

    @property
    def statistics(self) -> dict[str, Any]:
        """What the manifest states of the content; empty where it states nothing."""
        return self._table("statistics")

    def _table(self, key: str) -> dict[str, Any]:
        stated = self.manifest.get(key)
        return stated if isinstance(stated, dict) else {}

    @property
    def scene_split(self) -> str:
        """`development` or `held-out`, as the recipe of the scene declares it; `unknown` where nothing does."""
        return str(self.recipe.get("split", "unknown"))

    @property
    def object_radius(self) -> float | None:
        """Distance from the origin that the object does not exceed; None where the manifest doesn't state it."""
        radius = self.statistics.get("object_radius")
        return float(radius) if isinstance(radius, int | float) and 0 < radius < math.inf else None

    @property
    def board_corner(self) -> tuple[float, float, float] | None:
        """Where the world of the scene's board has its origin; its axes are parallel. None where there is no board."""
        corner = self.statistics.get("board_corner")
        if not isinstance(corner, list) or len(corner) != 3:
            return None
        if not all(isinstance(each, int | float) and math.isfinite(each) for each in corner):
            return None
        return float(corner[0]), float(corner[1]), float(corner[2])

    def split(self, split: str) -> tuple[Frame, ...]:
        """Frames of `train` or `test`."""
        return self.train if split == "train" else self.test
