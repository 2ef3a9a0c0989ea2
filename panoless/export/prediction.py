"""A finished fit → the prediction folder that the evaluator reads, pictures of it, and a PLY."""

import json
import math
import os
import platform
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from panoless import __version__
from panoless.capture.configured import configured_views
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import raster_camera
from panoless.config import FitConfig
from panoless.environment.surroundings import FAR, LEAST_DEPTH, Surroundings
from panoless.export.mesh_files import write_ply
from panoless.export.pictures import (
    around_object,
    decomposition_pictures,
    display_gain,
    environment_picture,
    write_decomposition,
)
from panoless.export.render import Decomposition, render
from panoless.geometry.registry import FAMILIES
from panoless.kernels.cubemap import sample_cubemap
from panoless.reconstruct.final_map import complete
from panoless.reconstruct.recorder import timed
from panoless.reconstruct.snapshots import read_snapshot, snapshot_folders
from panoless.reconstruct.state import FitState
from panoless.selection.candidates import Selection
from panoless.splats.mirror import SurfelMirror
from panoless.splats.shading.registry import LEFT_OUT
from shinypartial.core.camera import Camera
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions
from shinypartial.dataset.schema import Dataset, View
from shinypartial.io.files import remove_partial_files
from shinypartial.io.images import write_jpeg, write_png
from shinypartial.io.progress import Progress
from shinypartial.io.system import processor_name
from shinypartial.prediction.format import (
    DECOMPOSITION,
    ENVIRONMENT,
    ENVIRONMENT_PICTURE,
    INVERSE_DISTANCE,
    SNAPSHOTS,
    TEST_VIEWS,
    VISIBILITY,
    Candidate,
    FoundCamera,
    FoundFloor,
    ModelSelection,
    NearSurroundings,
    NuisanceBlock,
    PredictionInfo,
    begin_prediction,
    dataset_hash,
    prediction_frame,
    read_info,
    write_environment_map,
    write_info,
    write_inverse_distance,
    write_test_view,
    write_visibility,
)

PICTURES = "pictures"
SUPERSAMPLING = 2
FORMER_KINDS = ("sheet", "lathe")
"""Names of PLY files that an earlier version wrote."""
PRELIMINARY = "; preliminary, because the time limit ended the search"
EXPORT_THREADS = 2
JPEG_QUALITY = 92


def export_prediction(
    dataset: Dataset, state: FitState, config: FitConfig, folder: Path, *, snapshot: bool = False
) -> None:
    """Write environment, visibility, test views, pictures, PLY and, last, prediction.json.

    `snapshot` says that the state is not the end of its fit, and states its iteration. An earlier prediction.json is
    removed first, so that it never describes a mixture, and so are scores; all that another fit left is removed, too.
    """
    if state.environment is None or state.visibility is None:
        raise ValueError("only a finished fit can be exported")
    earlier = _description(folder, state, config, dataset)
    begin_prediction(folder)
    remove_partial_files(folder)
    if earlier is None:
        for left in (folder / SNAPSHOTS, folder / PICTURES, *(folder / TEST_VIEWS).iterdir()):
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)
        for name in (ENVIRONMENT_PICTURE, DECOMPOSITION):
            (folder / name).unlink(missing_ok=True)
    height = 2 * state.environment.shape[-1]
    around, viewpoint = state.geometry.surroundings, viewpoint_of(state.frame, state.geometry.surroundings)
    environment = cube_to_latlong(state.environment, height, around, viewpoint)
    write_environment_map(folder, environment)
    visibility = cube_to_latlong(state.visibility[:, None], height, around, viewpoint)[..., 0].clip(0, 1)
    write_visibility(folder, visibility)
    (folder / INVERSE_DISTANCE).unlink(missing_ok=True)
    if not around.is_far:
        directions = latlong_directions(height)
        write_inverse_distance(folder, around.inverse_distance_from(viewpoint, directions) / state.frame.radius)
    for kind in (*FAMILIES, SurfelMirror.kind, *FORMER_KINDS):
        (folder / f"{kind}.ply").unlink(missing_ok=True)
    mesh_file = f"{state.geometry.kind}.ply"
    write_ply(folder / mesh_file, state.geometry.mesh(state.frame))
    _write_test_views(dataset, state, config, folder)
    picture = environment_picture(environment, visibility)
    write_jpeg(folder / ENVIRONMENT_PICTURE, picture, JPEG_QUALITY)
    index = len(dataset.train) // 2
    camera, photograph = around_object(dataset.train[index])
    parts = _render(_found_camera(camera, state, index), state, state.shown_environment(), config)
    write_decomposition(folder / DECOMPOSITION, photograph * display_gain(environment), parts, picture, visibility)
    info = PredictionInfo(
        method=_method(config),
        dataset=str(dataset.root.resolve()),
        dataset_hash=dataset_hash(dataset),
        config=asdict(config),
        seconds=_stated_seconds(state),
        hardware={
            "processor": processor_name(),
            "device": state.device,
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "python": platform.python_version(),
            "torch": torch.__version__,
        },
        parameter_counts={
            f"{state.geometry.kind} parameters": state.geometry.num_parameters,
            "environment parameters": state.environment.numel(),
            **({} if state.geometry.poses is None else {"pose parameters": state.geometry.poses.stacked.size}),
        },
        peak_memory_bytes=state.peak_memory_bytes,
        curves=state.curves,
        primitives=state.geometry.num_primitives,
        model_bytes=sum((folder / name).stat().st_size for name in (mesh_file, ENVIRONMENT)),
        model=state.selection.sentence + (PRELIMINARY if state.is_preliminary else ""),
        model_selection=_model_selection(state.selection),
        cameras=_found_cameras(dataset, state),
        verdict=state.verdict,
        surroundings=_near_surroundings(around, state.frame),
        reflectance=None if state.reflectance is None else state.reflectance.tint,
        albedo=None if state.reflectance is None else state.reflectance.scattered_share,
        uneven=None if state.reflectance is None else state.reflectance.uneven_share,
        roughness=state.roughness,
        blur_px=state.blur_px,
        left_out=LEFT_OUT.get(config.splats.surfels.shading),
        iteration=state.iteration if snapshot else None,
    )
    write_info(folder, info)


def export_snapshots(dataset: Dataset, run: Path, config: FitConfig, prediction: Path) -> list[Path]:
    """Complete every snapshot of a run as the end of a fit is completed, and export it to PREDICTION/snapshots.

    Its `seconds` are those of the fit until the snapshot and those of solving its environment here. A snapshot that was
    exported already is kept. Returns the folders; raises InputError when the run has none.
    """
    found = snapshot_folders(run)
    if not found:
        raise InputError(
            expected=f"snapshots below {run}",
            found="none",
            remedy="Fit with `panoless fit --snapshots 6 --output NEW`.",
        )
    views, configured = None, config
    for source in found:
        state, target = read_snapshot(source), prediction / SNAPSHOTS / source.name
        if is_exported(target, state, config, dataset, snapshot=True):
            continue
        if views is None:
            loaded, configured = configured_views(dataset, config)
            views = state.selection.corrections.applied(loaded, configured)
        with timed(state.seconds, "solve environment"):
            complete(state, views, configured)
        export_prediction(dataset, state, config, target, snapshot=True)
    return [prediction / SNAPSHOTS / source.name for source in found]


def is_exported(folder: Path, state: FitState, config: FitConfig, dataset: Dataset, *, snapshot: bool = False) -> bool:
    """Whether the folder holds the whole prediction of this very state, by this version."""
    mesh = folder / f"{state.geometry.kind}.ply"
    views = (prediction_frame(folder, frame).exr for frame in dataset.test)
    named = (folder / name for name in (ENVIRONMENT, VISIBILITY, ENVIRONMENT_PICTURE, DECOMPOSITION))
    if not all(path.exists() for path in (*named, mesh, *views)):
        return False
    info, iteration = _description(folder, state, config, dataset), state.iteration if snapshot else None
    return info is not None and (info.method, info.iteration) == (_method(config), iteration)


def _description(folder: Path, state: FitState, config: FitConfig, dataset: Dataset) -> PredictionInfo | None:
    """What the folder says of a moment of this fit, None where it says nothing or is of another one; equal seconds to
    the millisecond distinguish fits.
    """
    try:
        info = read_info(folder)
    except InputError:  # There is none, or it can't be read.
        return None
    same_fit = info.config == json.loads(json.dumps(asdict(config))) and info.dataset_hash == dataset_hash(dataset)
    return info if same_fit and _stated_seconds(state).items() <= info.seconds.items() else None


def _method(config: FitConfig) -> str:
    return f"panoless {__version__} ({config.preset})"


def _stated_seconds(state: FitState) -> dict[str, float]:
    """Of each stage, to the millisecond."""
    return {name: round(value, 3) for name, value in state.seconds.items()}


def _write_test_views(dataset: Dataset, state: FitState, config: FitConfig, folder: Path) -> None:
    """Render and write the test views on two threads; the middle one is drawn in its parts."""
    progress = Progress("exporting test views", len(dataset.test))
    environment = state.shown_environment()

    def export(index: int) -> None:
        frame = dataset.test[index]
        parts = _render(frame.camera, state, environment, config)
        view = View(
            radiance=parts.radiance.permute(1, 2, 0).numpy(),
            alpha=parts.alpha.numpy(),
            normals_world=parts.normals_world.permute(1, 2, 0).numpy(),
            depth=parts.depth.numpy(),
            high_dynamic_range=True,
        )
        write_test_view(folder, frame, view)
        if index == len(dataset.test) // 2:
            for name, picture in decomposition_pictures(parts).items():
                write_png(folder / PICTURES / f"{name}.png", picture)

    with ThreadPoolExecutor(EXPORT_THREADS) as pool:
        for _ in pool.map(export, range(len(dataset.test))):
            progress.advance()


def _found_camera(camera: Camera, state: FitState, index: int) -> Camera:
    """That of a training view where the fit found it: turned about its center, then shifted."""
    if state.geometry.poses is None:
        return camera
    pose = camera.camera_to_world.copy()
    pose[:3, :3] = Rotation.from_rotvec(state.geometry.poses.turns[index]).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += state.frame.radius * state.geometry.poses.shifts[index]
    return replace(camera, camera_to_world=pose)


def _render(camera: Camera, state: FitState, environment: Float[Tensor, "6 3 L L"], config: FitConfig) -> Decomposition:
    distance = np.linalg.norm(camera.position_world - state.frame.center) / state.frame.radius
    seen = raster_camera(camera, state.frame, 0.1 * float(distance))
    return render(state.geometry, environment, seen, state.frame, config, state.reflectance)


def viewpoint_of(frame: ObjectFrame, surroundings: Surroundings = FAR) -> Float[np.ndarray, "3"]:
    """From where maps are exported, in the object frame: the world's origin if it lies within the object's ball and
    above its floor, as the prediction format has it, else the object's center. It matters in near surroundings only.
    """
    origin, floor = -frame.center / frame.radius, surroundings.floor
    above = floor is None or origin @ floor.up + floor.depth > LEAST_DEPTH
    return origin if np.linalg.norm(origin) < 1 and above else np.zeros(3)


def _near_surroundings(surroundings: Surroundings, frame: ObjectFrame) -> NearSurroundings | None:
    """What the prediction states of surroundings that are not far."""
    if surroundings.is_far:
        return None
    inverse, level = float(surroundings.coefficients[:1].sum()), surroundings.floor
    radii = 1 / inverse if inverse > 0 else None
    distance = None if radii is None else radii * frame.radius
    floor = None
    if level is not None:
        x, y, z = map(float, level.up)
        floor = FoundFloor((x, y, z), level.depth * frame.radius, level.reach * frame.radius)
    return NearSurroundings(surroundings.kind, distance, radii, surroundings.coefficients.tolist(), floor)


def cube_to_latlong(
    cube: Float[Tensor, "6 C L L"],
    height: int,
    surroundings: Surroundings = FAR,
    viewpoint: Float[np.ndarray, "3"] | None = None,
) -> Float[np.ndarray, "H 2*H C"]:
    """Area-averaged lat-long map of a cubemap: seamless lookups at 2×2 points a texel.

    In near surroundings it is what is seen from a viewpoint in the object frame, the center unless it is given.
    """
    fine = latlong_directions(height * SUPERSAMPLING).reshape(-1, 3)
    if viewpoint is not None:
        fine = surroundings.looked_up(np.broadcast_to(viewpoint, fine.shape), fine)
    values = sample_cubemap(cube, torch.from_numpy(fine).to(torch.float32)).numpy()
    blocks = values.reshape(height, SUPERSAMPLING, 2 * height, SUPERSAMPLING, -1)
    return blocks.mean((1, 3))


def _model_selection(selection: Selection) -> ModelSelection:
    """The table of candidates as the prediction's format has it; what is infinitely far has no number."""
    rows = (
        Candidate(
            kind=each.kind,
            silhouette_px=each.silhouette_px if each.silhouette_px not in (None, math.inf) else None,
            overlap=each.overlap,
            held_out_error=each.held_out_error,
            verdict=str(each.verdict),
            reason=each.reason,
            camera_turn_deg=each.camera_turn_deg,
            principal_point_px=each.principal_point_px,
            mask_offset_px=each.corrections.mask_offset_px or None,
            exposure_stops=each.corrections.exposure_stops,
            white_balance_stops=each.corrections.white_balance_stops,
            focal_factor=None if each.corrections.focal_uncertainty is None else each.corrections.focal_factor,
            focal_uncertainty=each.corrections.focal_uncertainty,
            k1=None if each.corrections.k1_uncertainty is None else each.corrections.k1,
            k1_uncertainty=each.corrections.k1_uncertainty,
            mask_spread_px=each.corrections.mask_spread_px,
            blocks=tuple(NuisanceBlock(**block) for block in each.blocks),
        )
        for each in selection.candidates
    )
    return ModelSelection(selection.chosen, tuple(rows))


def _found_cameras(dataset: Dataset, state: FitState) -> tuple[FoundCamera, ...] | None:
    """Poses and exposures of the training views, where they were unknowns."""
    poses, corrections = state.geometry.poses, state.selection.corrections
    sigmas = None if poses is None else poses.sigmas
    if poses is None and corrections.gains is None:
        return None
    to_world, none = np.repeat([180 / np.pi, state.frame.radius], 3), [None] * len(dataset.train)
    placed = none if poses is None else list(poses.stacked * to_world)
    spread = none if sigmas is None else list(sigmas * to_world)
    gains = none if (channels := corrections.channel_gains) is None else list(channels)
    return tuple(
        FoundCamera(frame.name, _three(pose, 0), _three(pose, 3), _three(sigma, 0), _three(sigma, 3), _three(gain, 0))
        for frame, pose, sigma, gain in zip(dataset.train, placed, spread, gains, strict=True)
    )


def _three(numbers: Float[np.ndarray, "N"] | None, first: int) -> tuple[float, float, float] | None:
    if numbers is None:
        return None
    x, y, z = numbers[first : first + 3].tolist()
    return x, y, z
