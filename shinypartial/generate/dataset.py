"""The command that makes a dataset: recipe → cameras → ground truth → rendered frames → checksums.

A run that is killed at any moment continues when it is
started again: files appear whole or not at all, and a frame that is there is not rendered twice.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial import __version__
from shinypartial.blender.runtime import check_blender
from shinypartial.blender.worker_pool import PoolClosed, WorkerPool, open_pool
from shinypartial.core.sphere import latlong_directions
from shinypartial.core.trajectory import Trajectory, plan_cameras
from shinypartial.dataset.camera_plot import CAMERA_PLOT, plot_cameras
from shinypartial.dataset.schema import (
    CHECKSUMS,
    ENVIRONMENT_INVERSE_DISTANCE,
    ENVIRONMENT_LATLONG,
    FORMAT_MINOR,
    SPLITS,
    Frame,
    View,
)
from shinypartial.dataset.write import (
    begun_recipe,
    claim_folder,
    complete_dataset,
    environment_files,
    is_complete,
    is_rendered,
    make_frames,
    write_environment,
    write_inverse_distance,
    write_transforms,
    write_view,
)
from shinypartial.io.files import folder_lock, remove_partial_files
from shinypartial.io.images import read_exr_rgb
from shinypartial.io.progress import Progress
from shinypartial.release.contact_sheet import write_contact_sheet
from shinypartial.release.statistics import dataset_statistics
from shinypartial.scene import FileWorld, SceneSpec, older_recipe

FRAME_NAME = "r_{:03d}".format
#: Directions along each side of a texel of the map for what a near sheet shows there.
GROUND_SAMPLES = 4
STUDIO_LIGHT_SOURCE = "Blender's studio lights, by Greg Zaal (Poly Haven, https://polyhaven.com)"


@dataclass(frozen=True)
class Generated:
    """What a run of `generate` did."""

    root: Path
    rendered: int
    kept: int


@dataclass(frozen=True)
class Shots:
    """Cameras of another origin than the recipe's path, how the training views are named, and what the recipe adds."""

    trajectory: Trajectory
    train_name: Callable[[int], str]
    """Of a training view's number."""
    recipe: dict[str, Any]


def generate(spec: SceneSpec, root: Path, shots: Shots | None = None) -> Generated:
    """Make the dataset of a recipe in the folder `root`, or finish what an earlier run began there.

    Cameras are those of the recipe's path unless `shots` are given.

    Raises InputError when the folder holds something else or Blender can't run; OSError when it can't be written.
    """
    shots = shots or Shots(plan_cameras(spec.camera, spec.render.resolution), FRAME_NAME, {})
    trajectory = shots.trajectory
    names = {"train": shots.train_name, "test": FRAME_NAME}
    frames = {split: make_frames(root, split, getattr(trajectory, split), names[split]) for split in SPLITS}
    every = [frame for split in SPLITS for frame in frames[split]]
    axis = trajectory.hemisphere_axis
    begun = {**spec.recipe(), **shots.recipe, "hemisphere_axis": None if axis is None else axis.tolist()}
    recipe = _as_begun(root, begun)
    if not _is_complete(root, every):
        check_blender()
    with folder_lock(root):
        claim_folder(root, recipe, _generator(), FORMAT_MINOR)
        if _is_complete(root, every):
            return Generated(root, 0, len(every))
        (root / CHECKSUMS).unlink(missing_ok=True)
        remove_partial_files(root)
        for split in SPLITS:
            write_transforms(root, split, frames[split])
        _write_ground_truth(spec, root)
        if not (root / CAMERA_PLOT).exists():
            plot_cameras(root / CAMERA_PLOT, trajectory)
        missing = [frame for frame in every if not is_rendered(frame)]
        if missing:
            render_frames(spec, missing, len(every), _make_frame)
        write_contact_sheet(root, frames["train"], read_exr_rgb(root / ENVIRONMENT_LATLONG))
        statistics = dataset_statistics(frames["train"], frames["test"])
        complete_dataset(root, licenses(spec), {**statistics, **_places(spec)})
    return Generated(root, len(missing), len(every) - len(missing))


def _places(spec: SceneSpec) -> dict[str, Any]:
    """What scores need to know of the scene: how far the object reaches, and where the world of its board begins."""
    corner = spec.ground.board_corner if spec.ground else None
    return {"object_radius": spec.extent} | ({"board_corner": list(corner)} if corner else {})


def _generator() -> dict[str, Any]:
    """Versions of what makes the files; apart from the recipe, because a newer version may finish an older folder."""
    import importlib.metadata

    try:
        blender = importlib.metadata.version("bpy")
    except importlib.metadata.PackageNotFoundError:
        blender = "unknown"
    return {"shinypartial": __version__, "blender": blender}


def _as_begun(root: Path, recipe: dict[str, Any]) -> dict[str, Any]:
    """The recipe in the words of the version that began the folder, where they mean the same scene."""
    begun = begun_recipe(root)
    if not isinstance(begun, dict) or begun.get("split", recipe["split"]) != recipe["split"]:
        return recipe
    return begun if older_recipe(begun) == older_recipe(recipe) else recipe


def _is_complete(root: Path, frames: Sequence[Frame]) -> bool:
    """Whether nothing is left to make; a file that was deleted since is made again."""
    return is_complete(root) and _has_environment(root) and all(map(is_rendered, frames))


def _has_environment(root: Path) -> bool:
    return all(path.exists() for path in environment_files(root))


def render_frames(
    spec: SceneSpec,
    frames: Sequence[Frame],
    total: int,
    make: Callable[[WorkerPool, Frame], None],
    title: str = "Rendering",
) -> None:
    """Render and write; while a thread writes its frame, another's is being rendered."""
    progress = Progress(title, total, total - len(frames))
    with open_pool(spec) as pool, ThreadPoolExecutor(pool.plan.workers + 1) as writers:
        results = [writers.submit(_closing, make, pool, frame) for frame in frames]
        try:
            for done in as_completed(results):
                done.result()
                progress.advance()
        except BaseException as error:
            pool.close()
            writers.shutdown(cancel_futures=True)
            if not isinstance(error, PoolClosed):
                raise
            failures = [each.exception() for each in results if not each.cancelled()]
            raise next((each for each in failures if each and not isinstance(each, PoolClosed)), error) from None


def _make_frame(pool: WorkerPool, frame: Frame) -> None:
    """One frame from camera to files."""
    rendered = pool.render(frame.camera, frame.name)
    view = View(
        rendered.radiance,
        rendered.alpha,
        rendered.normals_world,
        rendered.depth,
        high_dynamic_range=True,
        self_reflection=rendered.self_reflection,
    )
    write_view(frame, view)


def _closing(make: Callable[[WorkerPool, Frame], None], pool: WorkerPool, frame: Frame) -> None:
    """Make a frame; where that fails nothing else is begun."""
    try:
        make(pool, frame)
    except BaseException:
        pool.close()
        raise


def _write_ground_truth(spec: SceneSpec, root: Path) -> None:
    """The environment and how far its room is, unless an earlier run wrote them."""
    from shinypartial.blender.assemble import world_radiance

    if not _has_environment(root):
        write_environment(root, _environment(spec, world_radiance(spec.world, spec.render.exposure)))
    if (spec.room or spec.ground) and not (root / ENVIRONMENT_INVERSE_DISTANCE).exists():
        height = read_exr_rgb(root / ENVIRONMENT_LATLONG).shape[0]
        directions = latlong_directions(height)
        inverse_distance = spec.inverse_distance(directions.reshape(-1, 3))
        write_inverse_distance(root, inverse_distance.reshape(directions.shape[:2]))


def _environment(spec: SceneSpec, world: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """What arrives at the origin: the world, and the ground before it, which is averaged over each texel."""
    if spec.ground is None:
        return world
    height = world.shape[0]
    fine = latlong_directions(GROUND_SAMPLES * height).reshape(-1, 3)
    meets, points = spec.ground.seen_from_origin(fine)
    light = np.zeros((len(fine), 3), np.float32)
    light[meets] = spec.ground.radiance_at(points[:, :2]) * np.float32(2.0**spec.render.exposure)
    blocks = height, GROUND_SAMPLES, 2 * height, GROUND_SAMPLES
    share = meets.reshape(blocks).mean((1, 3))[..., None].astype(np.float32)
    return (1 - share) * world + light.reshape(*blocks, 3).mean((1, 3))


def licenses(spec: SceneSpec) -> list[dict[str, str]]:
    """A row an asset: what it is, its license and where it comes from."""
    world = spec.world
    if isinstance(world, FileWorld):
        light = {"asset": f"environment {Path(world.path).name}", "license": world.license, "source": world.source}
    else:
        light = {"asset": f"environment {world.name}", "license": "CC0-1.0", "source": STUDIO_LIGHT_SOURCE}
    return [{"asset": f"scene {spec.name}", "license": spec.license, "source": spec.provenance}, light]
