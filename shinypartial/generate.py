"""The command that makes a dataset: recipe → cameras → ground truth → rendered frames → checksums.

The only module that joins the Blender room to the dataset room. A run that is killed at any moment continues when it is
started again: files appear whole or not at all, and a frame that is there is not rendered twice.
"""

import contextlib
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shinypartial import __version__
from shinypartial.blender.runtime import check_blender
from shinypartial.dataset.schema import (
    CHECKSUMS,
    ENVIRONMENT_LATLONG_Y_UP,
    SPLITS,
    Frame,
    View,
)
from shinypartial.dataset.write import (
    claim_folder,
    complete_dataset,
    is_written,
    make_frames,
    write_environment,
    write_transforms,
    write_view,
)
from shinypartial.errors import InputError
from shinypartial.files import remove_partial_files
from shinypartial.progress import Progress
from shinypartial.scene import FileWorld, SceneSpec
from shinypartial.trajectory import arc

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
    trajectory = arc(spec.camera, spec.render.resolution)
    frames = {split: make_frames(root, split, getattr(trajectory, split)) for split in SPLITS}
    every = [frame for split in SPLITS for frame in frames[split]]
    recipe = {**spec.recipe(), "hemisphere_axis": trajectory.hemisphere_axis.tolist()}
    if not _is_complete(root, every):
        check_blender()
    claim_folder(root, recipe, _generator())
    with _only_writer(root):
        if _is_complete(root, every):
            return Generated(root, 0, len(every))
        (root / CHECKSUMS).unlink(missing_ok=True)
        remove_partial_files(root)
        for split in SPLITS:
            write_transforms(root, split, frames[split])
        _write_ground_truth(spec, root)
        missing = [frame for frame in every if not is_written(frame)]
        if missing:
            _render_frames(spec, missing, len(every))
        statistics = {split: len(frames[split]) for split in SPLITS}
        complete_dataset(root, licenses(spec), statistics)
    return Generated(root, len(missing), len(every) - len(missing))


def _generator() -> dict[str, Any]:
    """Versions of what makes the files; apart from the recipe, because a newer version may finish an older folder."""
    import importlib.metadata

    try:
        blender = importlib.metadata.version("bpy")
    except importlib.metadata.PackageNotFoundError:
        blender = "unknown"
    return {"shinypartial": __version__, "blender": blender}


def _is_complete(root: Path, frames: Sequence[Frame]) -> bool:
    """The checksum list is written last of all; a frame that was deleted since is made again."""
    return (root / CHECKSUMS).exists() and all(map(is_written, frames))


@contextlib.contextmanager
def _only_writer(root: Path) -> Iterator[None]:
    """Hold a lock on the folder, which the system releases however the process ends (no lock on Windows)."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    handle = os.open(root, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                expected=f"to be the only one that writes to {root}",
                found="another run that is writing there",
                remedy="Wait until it ends, or choose another --output.",
            ) from None
        yield
    finally:
        os.close(handle)


def _render_frames(spec: SceneSpec, frames: Sequence[Frame], total: int) -> None:
    """Render and write; one thread writes a frame while Blender renders the next."""
    from shinypartial.blender.render import open_renderer

    progress = Progress("Rendering", total, total - len(frames))
    with ThreadPoolExecutor(max_workers=1) as writer, open_renderer(spec) as renderer:
        pending: Future[None] | None = None
        for frame in frames:
            rendered = renderer.render(frame.camera)
            if pending:
                pending.result()
                progress.advance()
            view = View(rendered.radiance, rendered.alpha, rendered.normals_world, rendered.depth, True)
            pending = writer.submit(write_view, frame, view)
        if pending:
            pending.result()
            progress.advance()


def _write_ground_truth(spec: SceneSpec, root: Path) -> None:
    """The environment, unless an earlier run wrote it; its last file stands for all."""
    from shinypartial.blender.assemble import world_radiance

    if not (root / ENVIRONMENT_LATLONG_Y_UP).exists():
        write_environment(root, world_radiance(spec.world))


def licenses(spec: SceneSpec) -> list[dict[str, str]]:
    """A row an asset: what it is, its license and where it comes from."""
    world = spec.world
    if isinstance(world, FileWorld):
        light = {"asset": f"environment {Path(world.path).name}", "license": world.license, "source": world.source}
    else:
        light = {"asset": f"environment {world.name}", "license": "CC0-1.0", "source": STUDIO_LIGHT_SOURCE}
    return [{"asset": f"scene {spec.name}", "license": spec.license, "source": spec.provenance}, light]
