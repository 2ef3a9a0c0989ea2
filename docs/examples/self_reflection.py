"""How well the tracer finds pixels that see the object itself, against the dataset's self-reflection mask.

    python docs/examples/self_reflection.py datasets/vase-400 runs/vase-400-default --output self-reflection.json

Traces, for every `--every`-th training view, the surface that ground-truth depth and normals give, the first surface of
a fit, and that of the runs that are named. A fit never reads the mask; this example does, to score the tracer. Results
of other datasets in the output are kept.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_dilation

from panoless.capture.rays import pixel_rays
from panoless.capture.views import TrainView, Views, load_views
from panoless.config import FitConfig
from panoless.geometry.revolution.model import SurfaceOfRevolution, trace_reflections
from panoless.geometry.surfels.model import Surfels
from panoless.geometry.surfels.placement import initial_surfels
from panoless.kernels.cpu.trace import Picture
from panoless.reconstruct.state import load_state
from panoless.trace import first_hits, fuse_pictures, fuse_surface, sees_itself, surface_points
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import Dataset, View
from shinypartial.io.files import read_json, write_json

MARGINS_PX = (0, 1, 2)
MARGIN = FitConfig().crop_margin_px


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--every", type=int, default=5)
    options = parser.parse_args()
    dataset = open_dataset(options.dataset)
    views = load_views(dataset, MARGIN)
    found = {"ground truth": _score(dataset, views, options.every, _from_truth(dataset, views))}
    config = FitConfig()
    surfels = initial_surfels(views, config.surfels, config.seed)
    found["first surface"] = _score(dataset, views, options.every, _from_surfels(views, surfels))
    for run in options.runs:
        state = load_state(run)
        if state is None:
            parser.error(f"no checkpoint in {run}")
        seen = _from_lathe(state.surface) if state.turned and state.surface else _from_surfels(views, state.surfels)
        found[f"fitted, {run.name}"] = _score(dataset, views, options.every, seen)
    everything = read_json(options.output, "scores of the tracer") if options.output.exists() else {}
    write_json(options.output, {**everything, dataset.name: found})
    print(json.dumps(found, indent=1))


Seen = Callable[[int, TrainView], np.ndarray]
"""Which pixels of the i-th view see the object, as a surface has it."""


def _from_surfels(views: Views, surfels: Surfels) -> Seen:
    surface = fuse_surface(views, surfels, curved=True)
    return lambda _, view: sees_itself(surface, view, surfels, curved=True).numpy()


def _from_lathe(surface: SurfaceOfRevolution) -> Seen:
    """A surface of revolution is traced itself."""

    def seen(_: int, view: TrainView) -> np.ndarray:
        escapes = trace_reflections(surface, *pixel_rays(view.camera, np.arange(view.mask.numel())))
        again = escapes.first.met & (escapes.bounces == 0)
        return np.asarray(again.reshape(view.mask.shape))

    return seen


def _from_truth(dataset: Dataset, views: Views) -> Seen:
    """The tracer's own error: depth and normals of the dataset in place of a fit's."""

    def truth(index: int, view: TrainView) -> tuple[np.ndarray, np.ndarray]:
        cropped = _cropped(read_view(dataset.train[index]), view)
        assert cropped.depth is not None
        assert cropped.normals_world is not None
        return cropped.depth / np.float32(views.object_frame.radius), cropped.normals_world

    def picture(index: int, view: TrainView) -> Picture:
        depth, normals_world = truth(index, view)
        pose, camera = view.camera.world_to_camera.numpy(), view.camera
        num_parameters = tuple(np.float32(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
        normals_camera = np.ascontiguousarray(normals_world @ pose[:3, :3].T)
        return Picture(np.ascontiguousarray(depth), normals_camera, np.ascontiguousarray(pose), num_parameters)

    surface = fuse_pictures([picture(index, view) for index, view in enumerate(views.train)][::2])

    def seen(index: int, view: TrainView) -> np.ndarray:
        depth, normals_world = (torch.from_numpy(each.copy()) for each in truth(index, view))
        rays = view.rays_camera.flatten(1)[:, view.solid]
        points = surface_points(view.camera, rays, depth.flatten()[view.solid])
        normals = normals_world.view(-1, 3)[view.solid]
        incoming = (view.camera_to_world_rotation @ rays).T
        directions = incoming - 2 * (incoming * normals).sum(1, keepdim=True) * normals
        result = np.zeros(view.mask.numel(), bool)
        result[view.solid.numpy()] = first_hits(surface, points, normals, directions).found.numpy()
        return result.reshape(view.mask.shape)

    return seen


def _score(dataset: Dataset, views: Views, every: int, seen: Seen) -> dict[str, object]:
    """Precision and recall over wholly covered pixels, for the pixels found and for those within a margin of them."""
    counts = {margin: np.zeros(3, int) for margin in MARGINS_PX}
    solid_pixels = 0
    for index in range(0, len(views.train), every):
        view = views.train[index]
        truth = _cropped(read_view(dataset.train[index]), view).self_reflection
        if truth is None:
            raise SystemExit(f"{dataset.name} has no self-reflection mask")
        solid = np.zeros(view.mask.numel(), bool)
        solid[view.solid.numpy()] = True
        solid, true = solid.reshape(view.mask.shape), truth > 0
        found = seen(index, view)
        solid_pixels += int(solid.sum())
        for margin in MARGINS_PX:
            marked = binary_dilation(found, np.ones((3, 3)), margin) if margin else found
            counts[margin] += [(marked & true & solid).sum(), (marked & solid).sum(), (true & solid).sum()]
    return {
        "share that sees itself": round(float(counts[0][2] / solid_pixels), 4),
        **{
            f"margin {margin} px": {
                "precision": round(float(both / max(marked, 1)), 3),
                "recall": round(float(both / max(true, 1)), 3),
                "share marked": round(float(marked / solid_pixels), 4),
            }
            for margin, (both, marked, true) in counts.items()
        },
    }


def _cropped(truth: View, view: TrainView) -> View:
    """A ground-truth view in the window of a training view."""
    rows, columns = np.nonzero(truth.alpha > 0)
    top, left = max(rows.min() - MARGIN, 0), max(columns.min() - MARGIN, 0)
    window = slice(top, top + view.camera.height), slice(left, left + view.camera.width)
    return replace(
        truth,
        depth=None if truth.depth is None else truth.depth[window],
        normals_world=None if truth.normals_world is None else truth.normals_world[window],
        self_reflection=None if truth.self_reflection is None else truth.self_reflection[window],
    )


if __name__ == "__main__":
    main()
