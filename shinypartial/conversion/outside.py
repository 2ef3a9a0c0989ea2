"""What another method's code left in its own layout, as a prediction folder that can be scored."""

import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from shinypartial.conversion.layouts import LAYOUTS, Grid, Layout, LayoutName
from shinypartial.core.color import srgb_to_linear
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import interpolate_wrapped, latlong_directions
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import Dataset, Frame, View
from shinypartial.dataset.write import exr_channels
from shinypartial.io.files import PARTIAL_PREFIX
from shinypartial.io.images import read_picture, unit_values, write_exr
from shinypartial.prediction.format import (
    PredictionInfo,
    dataset_hash,
    prediction_frame,
    write_environment_map,
    write_info,
    write_visibility,
)

Background = Literal["white", "black"]

#: Lengths of 2v − 1 between which a pixel v holds a normal. Blends of unit vectors are no longer than 1; gray, the code
#: of none, is 0; black and white, backgrounds that are no normals, are √3.
NORMAL_LENGTHS = (0.5, 1.5)


@dataclass(frozen=True)
class Cost:
    """What the folders lack; None: not stated."""

    seconds: float | None = None
    device: str | None = None


@dataclass(frozen=True)
class Imported:
    """What was written, and what was left out with the reason of each."""

    info: PredictionInfo
    test_views: int
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class _Result:
    """A method's output folder at one iteration."""

    root: Path
    layout: Layout
    iteration: int

    def path(self, pattern: str, view: int = 0) -> Path:
        return self.root / pattern.format(iteration=self.iteration, view=view)

    @property
    def arguments(self) -> str:
        """What the method was run with, as these programs write it: `Namespace(name=value, …)`."""
        path = self.root / "cfg_args"
        return path.read_text() if path.is_file() else ""

    def flag(self, name: str) -> bool | None:
        """A flag of these; None where it isn't stated."""
        found = re.search(rf"\b{name}=(True|False)\b", self.arguments)
        return None if found is None else found[1] == "True"


def import_result(
    layout: LayoutName,
    folder: Path,
    dataset: Path,
    output: Path,
    *,
    iteration: int | None = None,
    background: Background | None = None,
    cost: Cost = Cost(),
) -> Imported:
    """Write the prediction folder `output` of what the layout's method left in `folder` for the dataset's test views.

    `iteration` is the last one that was saved when not given; `background` is that of the renders, else what `cfg_args`
    states. Whatever is missing is left out and named. Raises InputError when neither a map nor the test views
    are there.
    """
    data = open_dataset(dataset)
    result = _Result(folder, LAYOUTS[layout], _last_iteration(folder) if iteration is None else iteration)
    left_out: list[str] = []
    with _whole_folder(output) as partial:
        has_map = _import_maps(result, partial, left_out)
        views = _import_views(result, data, partial, background, left_out)
        if not has_map and not views:
            raise InputError(
                expected=f"results of {result.layout.method} at iteration {result.iteration} in {folder}",
                found="; ".join(left_out),
                remedy="See docs/how-to/compare-methods.md for the commands that write them.",
            )
        info = _describe(result, data, layout, views, cost)
        write_info(partial, info)
    return Imported(info, views, tuple(left_out))


def _describe(result: _Result, data: Dataset, layout: LayoutName, views: int, cost: Cost) -> PredictionInfo:
    files = [path for path in map(result.path, result.layout.model) if path.is_file()]
    clouds = [path for path in files if path.suffix == ".ply"]
    return PredictionInfo(
        method=result.layout.method,
        dataset=str(data.root),
        dataset_hash=dataset_hash(data),
        config={"imported": layout, "iteration": result.iteration},
        seconds={} if cost.seconds is None else {"fit": cost.seconds},
        hardware={} if cost.device is None else {"device": cost.device},
        parameter_counts={},
        peak_memory_bytes=0,
        primitives=sum(map(_vertices, clouds)) if clouds else None,
        model_bytes=sum(path.stat().st_size for path in files) if len(files) == len(result.layout.model) else None,
        masks="dataset" if views and result.layout.masks is None else None,
    )


@contextmanager
def _whole_folder(output: Path) -> Iterator[Path]:
    """A folder that takes the place of `output` when nothing went wrong, and else leaves nothing."""
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(
            expected=f"a new or empty folder at {output}", found="files", remedy="Choose another --output."
        )
    output.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=PARTIAL_PREFIX, dir=output.parent))
    try:
        yield partial
        partial.chmod(0o755)
        partial.replace(output)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _last_iteration(folder: Path) -> int:
    names = [path.name.removeprefix("iteration_") for path in (folder / "point_cloud").glob("iteration_*")]
    saved = [int(name) for name in names if name.isdecimal()]
    if not saved:
        raise InputError(
            expected=f"point_cloud/iteration_N in {folder}",
            found="none",
            remedy="Name the output folder of the method; or state the iteration with --iteration.",
        )
    return max(saved)


def _vertices(path: Path) -> int:
    """Number of vertices that the header of a PLY states."""
    with path.open("rb") as file:
        for line in file:
            if line.startswith(b"element vertex "):
                return int(line.split()[2])
    raise InputError(expected=f"a PLY with vertices at {path}", found="another file", remedy="Save the model again.")


def _import_maps(result: _Result, output: Path, left_out: list[str]) -> bool:
    """Light and visibility as far as they are there; return whether the light is."""
    layout = result.layout
    if layout.visibility is None or layout.visibility_grid is None:
        left_out.append(f"visibility: {layout.method} writes none")
    elif not (path := result.path(layout.visibility)).is_file():
        left_out.append(f"visibility: no {path}")
    else:
        write_visibility(output, to_world(_colors(path), layout.visibility_grid)[..., 0])
    path = result.path(layout.environment)
    if not path.is_file():
        left_out.append(f"environment: no {path}")
        return False
    linear = layout.linear_argument is not None and result.flag(layout.linear_argument)
    codes = _colors(path)
    write_environment_map(output, to_world(codes if linear else srgb_to_linear(codes), layout.environment_grid))
    return True


def _colors(path: Path) -> Float[np.ndarray, "H W 3"]:
    """RGB as stored: codes in [0, 1], or the numbers of an HDR."""
    values = unit_values(read_picture(path))
    return np.broadcast_to(values, (*values.shape[:2], 3)) if values.shape[2] == 1 else values[..., :3]


def to_world(picture: Float[np.ndarray, "H W C"], grid: Grid) -> Float[np.ndarray, "H 2*H C"]:
    """A lat-long picture of any grid as the dataset's map of its height: texel centers looked up bilinearly.

    The inverse of the formulas of `Grid`, x = (W(φ + π)/2π − l)(W − 1)/(W − l − r), y = (Hθ/π − t)(H − 1)/(H − t − b);
    x has the period W − 1 where the last column repeats the first, else W.
    """
    height, width = picture.shape[:2]
    axes = np.array([grid.forward, grid.right, grid.up])
    forward, right, up = np.moveaxis(latlong_directions(height) @ axes.T, -1, 0)
    polar, azimuth = np.arctan2(np.hypot(forward, right), up), np.arctan2(right, forward)
    (top, bottom), (left, right_inset) = grid.rows, grid.columns
    x = (width * (azimuth + np.pi) / (2 * np.pi) - left) * (width - 1) / (width - left - right_inset)
    y = (height * polar / np.pi - top) * (height - 1) / (height - top - bottom)
    return interpolate_wrapped(picture[:, : width - (left + right_inset == 0)], x, y).astype(np.float32)


def _import_views(
    result: _Result, data: Dataset, output: Path, background: Background | None, left_out: list[str]
) -> int:
    """Write all test views or none; return their number."""
    layout = result.layout
    numbers = _numbers_of_views(result, data)
    missing = [
        frame.stem.name
        for frame in data.test
        if frame.name not in numbers or not result.path(layout.renders, numbers[frame.name]).is_file()
    ]
    if missing or not data.test:
        named = ", ".join(missing[:5]) + (", …" if len(missing) > 5 else "")
        left_out.append(
            f"test views: {len(missing)} of {len(data.test)} have no picture by {layout.renders} ({named}), and scores "
            "are of all or none"
        )
        return 0
    has_normals = all(result.path(layout.normals, number).is_file() for number in numbers.values())
    if not has_normals:
        left_out.append(f"normals: not every test view has a picture by {layout.normals}")
    if layout.masks is None:
        left_out.append(f"masks: {layout.method} writes none, so the dataset's cut out its test views")
    behind = 0.0 if layout.masks is not None else _background(result, background)
    for frame in data.test:
        view = _read_outside(result, frame, numbers[frame.name], behind, has_normals)
        write_exr(prediction_frame(output, frame).exr, exr_channels(view))
    return len(data.test)


def _numbers_of_views(result: _Result, data: Dataset) -> dict[str, int]:
    """The number under which the method wrote each test view, by the view's name.

    Where it wrote the photographs along, they decide: a number is the view whose picture is the same to the bit.
    """
    pattern = result.layout.photographs
    if pattern is None:
        return {frame.name: number for number, frame in enumerate(data.test)}
    pictures = {read_picture(frame.png).tobytes(): frame.name for frame in data.test if frame.png.is_file()}
    numbers = {}
    for number in range(len(data.test)):
        path = result.path(pattern, number)
        name = pictures.get(read_picture(path).tobytes()) if path.is_file() else None
        if name is not None:
            numbers[name] = number
    return numbers


def _background(result: _Result, stated: Background | None) -> float:
    white = result.flag("white_background") if stated is None else stated == "white"
    if white is None:
        raise InputError(
            expected=f"white_background=True or False in {result.root / 'cfg_args'}, for the background of the renders",
            found="neither",
            remedy="State it: --background white or --background black.",
        )
    return float(white)


def _read_outside(result: _Result, frame: Frame, number: int, behind: float, has_normals: bool) -> View:
    """One test view. With α the mask and b the background, straight codes are (v − (1 − α) b)/α, clipped to [0, 1]:
    these programs blend sRGB codes. Normals are 2v − 1, v first divided by a mask of the method's own.
    """
    layout = result.layout
    if layout.masks is None:
        alpha = read_view(frame).alpha
    else:
        alpha = _picture_of(frame, result.path(layout.masks, number))[..., 0]
    cover = np.maximum(alpha, 1 / 510)[..., None]  # Half a code: no division by zero.
    codes = _picture_of(frame, result.path(layout.renders, number))
    straight = np.clip((codes - (1 - alpha[..., None]) * behind) / cover, 0, 1)
    radiance = (srgb_to_linear(straight) * alpha[..., None]).astype(np.float32)
    normals = None
    if has_normals:
        stored = _picture_of(frame, result.path(layout.normals, number))
        normals = _unit_normals(stored if layout.masks is None else stored / cover, alpha)
    return View(radiance, alpha, normals, None, high_dynamic_range=False)


def _unit_normals(stored: Float[np.ndarray, "H W 3"], alpha: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W 3"]:
    vectors = 2 * stored - 1
    length = np.linalg.norm(vectors, axis=-1)
    shortest, longest = NORMAL_LENGTHS
    known = (length > shortest) & (length < longest) & (alpha > 0)
    return np.where(known[..., None], vectors / np.maximum(length, shortest)[..., None], 0).astype(np.float32)


def _picture_of(frame: Frame, path: Path) -> Float[np.ndarray, "H W 3"]:
    colors = _colors(path)
    if colors.shape[:2] != (frame.camera.height, frame.camera.width):
        raise InputError(
            expected=f"{frame.camera.width}×{frame.camera.height} pixels in {path}, as {frame.name} has them",
            found=f"{colors.shape[1]}×{colors.shape[0]}",
            remedy="Run the method at the dataset's resolution (-r 1).",
        )
    return colors
