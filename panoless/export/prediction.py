"""A finished fit → the prediction folder that the evaluator reads, pictures of the decomposition, and a PLY."""

import json
import os
import platform
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless import __version__
from panoless.capture.encoding import encoding_of
from panoless.capture.rays import raster_camera
from panoless.capture.views import load_views
from panoless.config import FitConfig
from panoless.export.mesh_files import (
    HEIGHT_FIELD_PLY_NAME,
    PLANE_PLY_NAME,
    PLY_NAME,
    REVOLUTION_PLY_NAME,
    write_height_field_ply,
    write_plane_ply,
    write_ply,
    write_revolution_ply,
)
from panoless.export.pictures import crop_to_object, decomposition_pictures
from panoless.export.render import render
from panoless.geometry.height_field.model import HeightField
from panoless.geometry.plane.model import Plane
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.surfels.model import Surfels
from panoless.kernels.cubemap import sample_cubemap
from panoless.reconstruct.fit import clear_views, complete, object_frame_of
from panoless.reconstruct.snapshots import read_snapshot, snapshot_folders
from panoless.reconstruct.state import FitState
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions
from shinypartial.dataset.schema import Dataset, View
from shinypartial.io.files import remove_partial_files
from shinypartial.io.images import write_png
from shinypartial.io.picture_sheet import write_picture_sheet
from shinypartial.io.progress import Progress
from shinypartial.prediction.format import (
    DECOMPOSITION,
    DESCRIPTION,
    ENVIRONMENT,
    SNAPSHOTS,
    PredictionInfo,
    acquire_prediction,
    dataset_hash,
    read_info,
    write_environment_map,
    write_info,
    write_test_view,
    write_visibility,
)

PICTURES = "pictures"
SUPERSAMPLING = 2


def export_prediction(
    dataset: Dataset, state: FitState, config: FitConfig, folder: Path, *, snapshot: bool = False
) -> None:
    """Write environment, visibility, test views, pictures, PLY and, last, prediction.json.

    `snapshot` says that the state is not the end of its fit, and states its iteration. An earlier prediction.json is
    removed first, so that it never describes a mixture; `test` marks the folder as begun.
    """
    if state.final_environment is None or state.visibility is None:
        raise ValueError("only a finished fit can be exported")
    (folder / "test").mkdir(parents=True, exist_ok=True)
    (folder / DESCRIPTION).unlink(missing_ok=True)
    remove_partial_files(folder)
    environment = state.final_environment
    height = 2 * environment.shape[-1]
    write_environment_map(folder, cube_to_latlong(environment, height))
    write_visibility(folder, cube_to_latlong(state.visibility[:, None], height)[..., 0].clip(0, 1))
    geometry = state.geometry
    for name in (PLY_NAME, PLANE_PLY_NAME, HEIGHT_FIELD_PLY_NAME, REVOLUTION_PLY_NAME):
        (folder / name).unlink(missing_ok=True)
    if isinstance(geometry, Surfels):
        write_ply(folder / PLY_NAME, geometry, object_frame_of(state))
    elif isinstance(geometry, SurfaceOfRevolution):
        write_revolution_ply(folder / REVOLUTION_PLY_NAME, geometry, object_frame_of(state))
    elif isinstance(geometry, HeightField):
        write_height_field_ply(folder / HEIGHT_FIELD_PLY_NAME, geometry, object_frame_of(state))
    else:
        write_plane_ply(folder / PLANE_PLY_NAME, geometry, object_frame_of(state))
    _write_test_views(dataset, state, config, folder)
    info = PredictionInfo(
        method=f"panoless {__version__} ({config.preset})",
        dataset=str(dataset.root.resolve()),
        dataset_hash=dataset_hash(dataset),
        config=asdict(config),
        seconds={name: round(value, 3) for name, value in state.seconds.items()},
        hardware={
            "processor": _processor_name(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "python": platform.python_version(),
            "torch": torch.__version__,
        },
        parameter_counts=_parameter_counts(state, config),
        peak_memory_bytes=state.peak_memory_bytes,
        curves=state.curves,
        primitives=state.surfels.count if isinstance(geometry, Surfels) else 1,
        model_bytes=sum((folder / name).stat().st_size for name in (_ply_name(state), ENVIRONMENT)),
        model=state.rung or None,
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
    views = None
    for source in found:
        state, target = read_snapshot(source), prediction / SNAPSHOTS / source.name
        if _is_exported(target, state, config, dataset):
            continue
        if views is None:
            loaded = load_views(dataset, config.crop_margin_px, config.downscale, encoding_of(config))
            views = clear_views(loaded, state, config)
        complete(state, views, config)
        acquire_prediction(target)
        export_prediction(dataset, state, config, target, snapshot=True)
    return [prediction / SNAPSHOTS / source.name for source in found]


def _is_exported(folder: Path, state: FitState, config: FitConfig, dataset: Dataset) -> bool:
    """Whether the folder describes this very snapshot; equal seconds to the millisecond tell fits apart."""
    if not (folder / DESCRIPTION).exists():
        return False
    info = read_info(folder)
    same_fit = info.config == json.loads(json.dumps(asdict(config))) and info.dataset_hash == dataset_hash(dataset)
    stages = {name: round(value, 3) for name, value in state.seconds.items()}
    return same_fit and info.iteration == state.iteration and stages.items() <= info.seconds.items()


def _write_test_views(dataset: Dataset, state: FitState, config: FitConfig, folder: Path) -> None:
    object_frame = object_frame_of(state)
    environment = state.final_environment
    assert environment is not None
    progress = Progress("exporting test views", len(dataset.test))
    for index, frame in enumerate(dataset.test):
        distance = np.linalg.norm(frame.camera.position_world - object_frame.center) / object_frame.radius
        camera = raster_camera(frame.camera, object_frame, 0.1 * float(distance))
        parts = render(state.geometry, environment, camera, object_frame, config)
        view = View(
            radiance=parts.radiance.permute(1, 2, 0).numpy(),
            alpha=parts.alpha.numpy(),
            normals_world=parts.normals_world.permute(1, 2, 0).numpy(),
            depth=parts.depth.numpy(),
            high_dynamic_range=True,
        )
        write_test_view(folder, frame, view)
        if index == len(dataset.test) // 2:
            pictures = decomposition_pictures(parts)
            for name, picture in pictures.items():
                write_png(folder / PICTURES / f"{name}.png", picture)
            write_picture_sheet(folder / DECOMPOSITION, crop_to_object(pictures, parts.alpha))
        progress.advance()


def cube_to_latlong(cube: Float[Tensor, "6 C L L"], height: int) -> Float[np.ndarray, "H 2*H C"]:
    """Area-averaged lat-long map of a cubemap: seamless lookups at 2×2 points a texel."""
    fine = latlong_directions(height * SUPERSAMPLING).reshape(-1, 3)
    values = sample_cubemap(cube, torch.from_numpy(fine).to(torch.float32)).numpy()
    blocks = values.reshape(height, SUPERSAMPLING, 2 * height, SUPERSAMPLING, -1)
    return blocks.mean((1, 3))


def _ply_name(state: FitState) -> str:
    names = {
        SurfaceOfRevolution: REVOLUTION_PLY_NAME,
        HeightField: HEIGHT_FIELD_PLY_NAME,
        Plane: PLANE_PLY_NAME,
        Surfels: PLY_NAME,
    }
    return names[type(state.geometry)]


def _parameter_counts(state: FitState, config: FitConfig) -> dict[str, int]:
    """Numbers that the fit may choose, by what they belong to."""
    assert state.final_environment is not None
    geometry, environment = state.geometry, {"environment parameters": state.final_environment.numel()}
    if not isinstance(geometry, Surfels):
        kinds = {Plane: "plane", HeightField: "bent plane", SurfaceOfRevolution: "revolution"}
        return {f"{kinds[type(geometry)]} parameters": geometry.num_parameters, **environment}
    per_surfel = 3 + 4 + 2 + 1
    per_surfel += 3 * config.albedo + 3 * config.surfels.curved + config.loss.roughness_weighted
    return {"surfel parameters": per_surfel * geometry.count, **environment}


def _processor_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
