"""The command that makes a dataset: recipe → cameras → ground truth → rendered frames → checksums.

The only module that joins the Blender room to the dataset room. A run that is killed at any moment continues when it is
started again: files appear whole or not at all, and a frame that is there is not rendered twice.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shinypartial import __version__
from shinypartial.blender.runtime import check_blender
from shinypartial.blender.worker_pool import PoolClosed, WorkerPool, open_pool
from shinypartial.core.sphere import latlong_directions
from shinypartial.core.trajectory import plan_cameras
from shinypartial.dataset.camera_plot import CAMERA_PLOT, plot_cameras
from shinypartial.dataset.schema import (
    CHECKSUMS,
    ENVIRONMENT_INVERSE_DISTANCE,
    ENVIRONMENT_LATLONG,
    ENVIRONMENT_LATLONG_Y_UP,
    FORMAT_MINOR,
    MANIFEST,
    SPLITS,
    Frame,
    View,
)
from shinypartial.dataset.write import (
    claim_folder,
    complete_dataset,
    is_rendered,
    make_frames,
    write_environment,
    write_inverse_distance,
    write_transforms,
    write_view,
)
from shinypartial.io.files import folder_lock, read_json, remove_partial_files
from shinypartial.io.images import read_exr_rgb
from shinypartial.io.progress import Progress
from shinypartial.release.contact_sheet import write_contact_sheet
from shinypartial.release.statistics import dataset_statistics
from shinypartial.scene import FileWorld, SceneSpec, older_recipe

STUDIO_LIGHT_SOURCE = "Blender's studio lights, by Greg Zaal (Poly Haven, https://polyhaven.com)"


@dataclass(frozen=True)
class Generated:
    """What a run of `generate` did."""

    root: Path
    rendered: int
    kept: int


def generate(spec: SceneSpec, root: Path) -> Generated:
    """Make the dataset of a recipe in the folder `root`, or finish what an earlier run began there.

    Raises InputError when the folder holds something else or Blender can't run; OSError when it can't be written.
    """
    trajectory = plan_cameras(spec.camera, spec.render.resolution)
    frames = {split: make_frames(root, split, getattr(trajectory, split)) for split in SPLITS}
    every = [frame for split in SPLITS for frame in frames[split]]
    recipe = _as_begun(root, {**spec.recipe(), "hemisphere_axis": trajectory.hemisphere_axis.tolist()})
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
            _render_frames(spec, missing, len(every))
        write_contact_sheet(root, frames["train"], read_exr_rgb(root / ENVIRONMENT_LATLONG))
        statistics = dataset_statistics(frames["train"], frames["test"])
        complete_dataset(root, licenses(spec), {**statistics, "object_radius": spec.extent})
    return Generated(root, len(missing), len(every) - len(missing))


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
    manifest = read_json(root / MANIFEST, "the manifest") if (root / MANIFEST).exists() else None
    begun = manifest.get("recipe") if isinstance(manifest, dict) else None
    if not isinstance(begun, dict) or begun.get("split", recipe["split"]) != recipe["split"]:
        return recipe
    return begun if older_recipe(begun) == older_recipe(recipe) else recipe


def _is_complete(root: Path, frames: Sequence[Frame]) -> bool:
    """The checksum list is written last of all; a frame that was deleted since is made again."""
    return (root / CHECKSUMS).exists() and all(map(is_rendered, frames))


def _render_frames(spec: SceneSpec, frames: Sequence[Frame], total: int) -> None:
    """Render and write; while a thread writes its frame, another's is being rendered."""
    progress = Progress("Rendering", total, total - len(frames))
    with open_pool(spec) as pool, ThreadPoolExecutor(pool.plan.workers + 1) as writers:
        results = [writers.submit(_make_frame, pool, frame) for frame in frames]
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
    """One frame from camera to files; where it fails nothing else is begun."""
    try:
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
    except BaseException:
        pool.close()
        raise


def _write_ground_truth(spec: SceneSpec, root: Path) -> None:
    """The environment, whose last file stands for all, and how far its room is, unless an earlier run wrote them."""
    from shinypartial.blender.assemble import world_radiance

    if not (root / ENVIRONMENT_LATLONG_Y_UP).exists():
        write_environment(root, world_radiance(spec.world, spec.render.exposure))
    if spec.room and not (root / ENVIRONMENT_INVERSE_DISTANCE).exists():
        height = read_exr_rgb(root / ENVIRONMENT_LATLONG).shape[0]
        write_inverse_distance(root, spec.room.inverse_distance(latlong_directions(height)))


def licenses(spec: SceneSpec) -> list[dict[str, str]]:
    """A row an asset: what it is, its license and where it comes from."""
    world = spec.world
    if isinstance(world, FileWorld):
        light = {"asset": f"environment {Path(world.path).name}", "license": world.license, "source": world.source}
    else:
        light = {"asset": f"environment {world.name}", "license": "CC0-1.0", "source": STUDIO_LIGHT_SOURCE}
    return [{"asset": f"scene {spec.name}", "license": spec.license, "source": spec.provenance}, light]
