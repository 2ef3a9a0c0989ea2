"""The prediction folder: what every method writes, and all that the evaluator reads.

PREDICTION/prediction.json            method, configuration, dataset hash, seconds, hardware, size, model selection
PREDICTION/environment.exr            lat-long, linear radiance, world frame of the dataset
PREDICTION/visibility.exr             lat-long, channel Y in [0, 1]: how well each direction was observed
PREDICTION/inverse_distance.exr      optional: lat-long, channel Y, 1/D of every direction from the origin, 0 for far
PREDICTION/test/r_000.exr r_000.png   linear premultiplied RGBA, unit world normals, z-depth; and the picture
PREDICTION/environment.jpg            optional: the environment to look at, with what was not seen marked
PREDICTION/decomposition.jpg          optional: a photograph, and what was recovered, in one picture
PREDICTION/snapshots/000250           optional: earlier moments of the fit, each a prediction folder
"""

import math
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from shinypartial.core.errors import InputError
from shinypartial.dataset.read import read_inverse_distance_map
from shinypartial.dataset.schema import CHECKSUMS, Dataset, Frame, View
from shinypartial.dataset.write import write_inverse_distance_map, write_view
from shinypartial.io.files import newest_folder, read_json, sha256_of, write_json
from shinypartial.io.images import read_exr, read_exr_rgb, require_latlong, stack_channels, write_exr, write_exr_rgb
from shinypartial.io.records import NonNegative, Share, Text, read_record, write_record

FORMAT = "shinypartial-prediction"
FORMAT_VERSION = 1
DEFAULT_FOLDER = Path("predictions")
DESCRIPTION = "prediction.json"
#: Moments of a fit, each a prediction folder of its own, lie below the prediction in a folder of this name.
SNAPSHOTS = "snapshots"
#: The oracle baseline of a dataset lies beside the predictions made from it, under the dataset's name with this ending.
ORACLE_SUFFIX = "-oracle"
#: Folder of the test views.
TEST_VIEWS = "test"
ENVIRONMENT = "environment.exr"
VISIBILITY = "visibility.exr"
VISIBILITY_CHANNEL = "Y"
#: Slack for values that 16-bit storage rounds beyond [0, 1].
VISIBILITY_TOLERANCE = 1e-3
INVERSE_DISTANCE = "inverse_distance.exr"
#: For the eye, optional: the environment, and one picture of a photograph and of all that was recovered.
ENVIRONMENT_PICTURE, DECOMPOSITION = "environment.jpg", "decomposition.jpg"
#: What `shinypartial evaluate` and `report` add to the folder: scores, pictures and a page.
SCORES, EVALUATION, REPORT = "scores.json", "evaluation", "report.html"


@dataclass(frozen=True)
class NuisanceBlock:
    """Unknowns beside the model, such as poses, and whether the scene needs them.

    `score` is the mean square of the unknowns over their standard deviations, and needed where it exceeds the `bound`.
    `value` is the root mean square of the unknowns and `sigma` their standard deviation, both in the `unit`.
    """

    name: Text
    kept: bool
    score: NonNegative
    bound: NonNegative
    value: NonNegative
    sigma: NonNegative
    unit: str = ""


@dataclass(frozen=True)
class Candidate:
    """A kind of model that was considered, the evidence for it, and what became of it; None: not measured.

    `silhouette_px` is its distance from the silhouettes, `overlap` the intersection over union with the masks,
    `held_out_error` its error on views that were left out of the fit, `alternative_error` that of the freer kind
    that it was compared with. Where these were unknowns: `camera_turn_deg` is the median turn of the cameras,
    `mask_offset_px` the shift outward of the silhouettes of all masks, `mask_spread_px` the standard deviation of
    single masks' offsets, `exposure_stops` that of the views' exposures, `white_balance_stops` that of their channels
    from the mean of a view. `focal_factor` is the focal length over the stated one, `focal_uncertainty` its standard
    deviation; `k1` and `k1_uncertainty` are those of a radial distortion in OpenCV's model; `principal_point_px` is
    the principal point, right of and below the stated one. `blocks` lists what was unknown beside the model. `verdict`
    is a word such as "chosen" or "rejected", `reason` says why.
    """

    kind: Text
    silhouette_px: NonNegative | None
    overlap: Share | None
    held_out_error: NonNegative | None
    verdict: Text
    reason: str = ""
    alternative_error: NonNegative | None = None
    camera_turn_deg: NonNegative | None = None
    mask_offset_px: float | None = None
    exposure_stops: NonNegative | None = None
    white_balance_stops: NonNegative | None = None
    focal_factor: NonNegative | None = None
    focal_uncertainty: NonNegative | None = None
    k1: float | None = None
    k1_uncertainty: NonNegative | None = None
    principal_point_px: tuple[float, float] | None = None
    mask_spread_px: NonNegative | None = None
    blocks: tuple[NuisanceBlock, ...] = ()


@dataclass(frozen=True)
class ModelSelection:
    """The kind of model that a method chose, and all that it considered."""

    chosen: Text
    candidates: tuple[Candidate, ...]

    def sentence(self) -> str:
        """The choice in words, with the reason of every candidate that has one."""
        reasons = {one.kind: f" ({one.reason})" if one.reason else "" for one in self.candidates}
        others = [f"{one.kind}: {one.verdict}{reasons[one.kind]}" for one in self.candidates if one.kind != self.chosen]
        return "; ".join([f"{self.chosen} was chosen{reasons.get(self.chosen, '')}", *others]) + "."


Verdict = Literal["trust", "partly", "do not trust"]


@dataclass(frozen=True)
class Trust:
    """What a method says of its own result, from training views alone.

    `risk` orders fits from sure to hopeless and has no unit; the method's words change at values of its own. `evidence`
    holds the figures by name.
    """

    verdict: Verdict
    reason: Text
    """In a sentence, without its first capital and its full stop."""
    remedy: str = ""
    """What helps; empty where nothing has to."""
    risk: NonNegative | None = None
    evidence: dict[str, float] = field(default_factory=dict)

    def sentence(self) -> str:
        """Verdict, reason and remedy in words."""
        return f"{self.verdict}: {self.reason}." + (f" {self.remedy}" if self.remedy else "")


@dataclass(frozen=True)
class FoundFloor:
    """The disk that the object stands on, by its plane and by how far it reaches from the foot of the object's center.

    Lengths are in world units.
    """

    normal: tuple[float, float, float]
    """Unit, in world axes, on the object's side."""
    depth: NonNegative
    """Of the plane below the object's center."""
    reach: NonNegative


@dataclass(frozen=True)
class NearSurroundings:
    """How far away the method found what the object mirrors, where that is not infinitely far."""

    kind: Text
    """What they are taken for, such as "sphere"."""
    distance: NonNegative | None
    """From the object's center to the walls in world units, of the mean of 1/D, if it varies; None: infinitely far."""
    distance_radii: NonNegative | None
    """The same in radii of the object."""
    inverse_distances: list[float] = field(default_factory=list)
    """What the method describes 1/D by, in inverse radii of the object: of spheres that number alone."""
    floor: FoundFloor | None = None
    """Before the walls; None: there is none."""

    def sentence(self) -> str:
        """Both in words."""
        far = self.distance is None or self.distance_radii is None
        walls = "walls infinitely far" if far else f"walls at {self.distance:.3g} ({self.distance_radii:.3g} radii)"
        if self.floor is None:
            return walls
        return f"a floor {self.floor.depth:.3g} below the center, as far as {self.floor.reach:.3g}, and {walls}"


@dataclass(frozen=True)
class FoundCamera:
    """What a method found about a training view that its dataset says otherwise; None: it took that as stated.

    The camera is turned about its own center by the rotation vector `turn_deg` (world axes) and then moved by `shift`
    (world units). `turn_sigma_deg` and `shift_sigma` are standard deviations of their components. `gain` (linear red,
    green, blue) is its exposure over that of the mean view.
    """

    name: Text
    turn_deg: tuple[float, float, float] | None = None
    shift: tuple[float, float, float] | None = None
    turn_sigma_deg: tuple[NonNegative, NonNegative, NonNegative] | None = None
    shift_sigma: tuple[NonNegative, NonNegative, NonNegative] | None = None
    gain: tuple[NonNegative, NonNegative, NonNegative] | None = None

    @property
    def turn_length_deg(self) -> float:
        """The angle of the turn, 0 where there is none."""
        return math.hypot(*(self.turn_deg or (0.0,)))

    @property
    def shift_length(self) -> float:
        """By how much its center is moved (world units), 0 where it is not."""
        return math.hypot(*(self.shift or (0.0,)))


@dataclass(frozen=True)
class PredictionInfo:
    """Who made the prediction and at what cost; `curves` are per-iteration training series, for the report only.

    `seconds` are those of making the model; their sum is its time in leaderboards and charts. `hardware` names
    under `device` what the model was fitted on: "cpu", or the name of the GPU. `primitives` is the number of
    surfels, Gaussians, voxels or vertices, `model_bytes` the size of the files that a renderer needs, `iteration`
    the number of finished steps of a snapshot, `model_selection` how the kind of model was chosen; `model` says the
    same in free words; `cameras` what it found about each training view; `verdict` is what the method says of its
    result; `surroundings` how near it found them; `reflectance` what share of the light (linear red, green, blue)
    it found the object to mirror at normal incidence, where that is not all of it; `albedo` what share it found to
    be scattered evenly; `uneven` on which share of the seen surface its material differs from both; `roughness`
    how rough, in units of Blender's principled shader, where it is not smooth; `blur_px` by how much it found the
    pictures blurred (standard deviation of a Gaussian), where they are not sharp; `masks` is
    "dataset" where the method wrote none and its test views were cut out by the dataset's; `left_out` names the
    parts of a published method that its re-implementation lacks. Each is None where it is unknown or has no meaning.
    """

    method: str
    dataset: str
    dataset_hash: str
    config: dict[str, Any]
    seconds: dict[str, NonNegative]
    hardware: dict[str, Any]
    parameter_counts: dict[str, int]
    peak_memory_bytes: int
    curves: dict[str, list[float]] = field(default_factory=dict)
    model: str | None = None
    model_selection: ModelSelection | None = None
    cameras: tuple[FoundCamera, ...] | None = None
    verdict: Trust | None = None
    primitives: int | None = None
    model_bytes: int | None = None
    iteration: int | None = None
    surroundings: NearSurroundings | None = None
    reflectance: tuple[Share, Share, Share] | None = None
    albedo: tuple[Share, Share, Share] | None = None
    uneven: Share | None = None
    roughness: Share | None = None
    blur_px: NonNegative | None = None
    masks: Literal["dataset"] | None = None
    left_out: tuple[str, ...] | None = None

    @property
    def hardware_text(self) -> str:
        """The hardware in one line, the device first; seconds on different hardware don't compare."""
        ordered = {"device": self.hardware.get("device"), **self.hardware}
        stated = [f"{name} {value}" for name, value in ordered.items() if value not in ("", None)]
        return ", ".join(stated) or "not stated"


def dataset_hash(dataset: Dataset) -> str:
    """SHA-256 of the checksum list, or of the training cameras when the folder has none."""
    listing = dataset.root / CHECKSUMS
    return sha256_of(listing if listing.exists() else dataset.root / "transforms_train.json")


def newest_prediction(parent: Path = DEFAULT_FOLDER) -> Path:
    """The prediction below `parent` that was written last; oracle baselines are passed over."""
    remedy = "Make one: `panoless fit`, or name a folder."
    return newest_folder(parent, DESCRIPTION, "a prediction", remedy, unless_suffix=ORACLE_SUFFIX)


def prediction_folders(root: Path) -> list[Path]:
    """Every prediction at or below a folder, at any depth, without the snapshots of others."""
    return sorted(path.parent for path in root.rglob(DESCRIPTION) if not _is_snapshot(path.parent))


def snapshot_folders(prediction: Path) -> list[Path]:
    """The complete snapshots of a prediction, in the order of their names."""
    return sorted(path.parent for path in (prediction / SNAPSHOTS).glob(f"*/{DESCRIPTION}"))


def _is_snapshot(folder: Path) -> bool:
    parent = folder.resolve().parent
    return parent.name == SNAPSHOTS and (parent.parent / DESCRIPTION).exists()


def prediction_frame(root: Path, frame: Frame) -> Frame:
    """Where the prediction of a dataset's test frame lies."""
    return Frame(frame.name, frame.camera, root / TEST_VIEWS / frame.stem.name)


def acquire_prediction(root: Path) -> None:
    """Make sure that `root` can be written; InputError when it holds something that is no prediction."""
    begun = (root / DESCRIPTION).exists() or (root / TEST_VIEWS).is_dir()
    if root.exists() and (not root.is_dir() or (any(root.iterdir()) and not begun)):
        raise InputError(
            expected=f"a new, empty or earlier prediction folder at {root}",
            found="files that are not a prediction",
            remedy="Choose another --output.",
        )
    root.mkdir(parents=True, exist_ok=True)


def begin_prediction(root: Path) -> None:
    """Acquire `root` and take from it what says something of an earlier prediction there: prediction.json, scores,
    report.

    The folder of test views marks it as begun, so that a run after a kill is not refused.
    """
    acquire_prediction(root)
    (root / TEST_VIEWS).mkdir(exist_ok=True)
    for name in (DESCRIPTION, SCORES, REPORT):
        (root / name).unlink(missing_ok=True)
    shutil.rmtree(root / EVALUATION, ignore_errors=True)


def write_info(root: Path, info: PredictionInfo) -> None:
    """Write prediction.json; written last, it marks the folder as complete."""
    stated = {name: value for name, value in write_record(info).items() if value is not None}
    write_json(root / DESCRIPTION, {"format": FORMAT, "format_version": FORMAT_VERSION, **stated})


def write_environment_map(root: Path, radiance: Float[np.ndarray, "H W 3"]) -> None:
    """Write the predicted environment, a linear lat-long map in the dataset's world frame."""
    write_exr_rgb(root / ENVIRONMENT, radiance)


def write_visibility(root: Path, visibility: Float[np.ndarray, "H W"]) -> None:
    """Write visibility in [0, 1] as a lat-long map."""
    write_exr(root / VISIBILITY, {VISIBILITY_CHANNEL: visibility.astype(np.float32)})


def write_inverse_distance(root: Path, inverse_distance: Float[np.ndarray, "H W"]) -> None:
    """Write 1/D of every direction from the origin, in 1/scene units and 0 for infinitely far, as a lat-long map."""
    write_inverse_distance_map(root / INVERSE_DISTANCE, inverse_distance)


def write_test_view(root: Path, frame: Frame, view: View) -> None:
    """Write the prediction of one test view."""
    write_view(prediction_frame(root, frame), view)


def read_info(root: Path) -> PredictionInfo:
    """Read prediction.json; raises InputError when it is missing, of another version or incomplete."""
    description = read_json(root / DESCRIPTION, "a prediction")
    content = description if isinstance(description, dict) else {}
    if content.pop("format", None) != FORMAT or content.pop("format_version", None) != FORMAT_VERSION:
        raise InputError(
            expected=f"{DESCRIPTION} with format {FORMAT} version {FORMAT_VERSION}",
            found="another format",
            remedy="Export the prediction again with this version.",
        )
    info = read_record(
        PredictionInfo, content, str(root / DESCRIPTION), remedy="See docs/reference/prediction-format.md."
    )
    selection = info.model_selection
    if selection and selection.candidates and selection.chosen not in {one.kind for one in selection.candidates}:
        raise InputError(
            expected=f"`model_selection.chosen` of {root / DESCRIPTION} to be the kind of one of its candidates",
            found=repr(selection.chosen),
            remedy="See docs/reference/prediction-format.md.",
        )
    return info


def read_environment_map(root: Path) -> Float[np.ndarray, "H W 3"]:
    """Read the predicted environment; raises InputError unless it is a finite 2:1 map."""
    radiance = read_exr_rgb(root / ENVIRONMENT)
    require_latlong(radiance, root / ENVIRONMENT, "radiance", "Export the environment again.")
    return radiance


def read_visibility(root: Path) -> Float[np.ndarray, "H W"] | None:
    """Read visibility, or None when the method wrote none; raises InputError unless it is a 2:1 map in [0, 1]."""
    path = root / VISIBILITY
    if not path.exists():
        return None
    visibility = stack_channels(read_exr(path), (VISIBILITY_CHANNEL,), path)[..., 0]
    require_latlong(
        visibility,
        path,
        "visibility in [0, 1]",
        "Export the visibility again: see docs/reference/prediction-format.md.",
        lowest=-VISIBILITY_TOLERANCE,
        highest=1 + VISIBILITY_TOLERANCE,
    )
    return np.clip(visibility, 0, 1)


def read_inverse_distance(root: Path) -> Float[np.ndarray, "H W"] | None:
    """Read 1/D of every direction; None when the method wrote none, which means infinitely far."""
    path = root / INVERSE_DISTANCE
    return read_inverse_distance_map(path) if path.exists() else None
