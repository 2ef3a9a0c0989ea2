"""How much of a map's error is that of the normals: the same solver with ground-truth normals in their place.

    python docs/examples/map_bound.py predictions/sculpture-160 runs/sculpture-160 --output map-bound.json

For predictions of a kind in closed form. The views are those of the fit, the pixels those whose mirror ray leaves the
object, and their areas span the differences of mirrored directions between neighboring pixels. The environment of a
copy of the prediction is replaced, and the copy is scored. Results of other predictions in the output are kept.
"""

import argparse
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from self_reflection import window_of

from panoless.capture.configured import configured_views
from panoless.capture.views import TrainView, Views, at_most_pixels
from panoless.config import FitConfig
from panoless.environment.footprints import Footprints, PixelFootprints
from panoless.environment.rays import Rays
from panoless.export.prediction import cube_to_latlong
from panoless.geometry.exact import ExactGeometry
from panoless.geometry.free_form.kind import WIDEST_FOOTPRINT_RAD
from panoless.kernels.constants import SUB_PIXELS
from panoless.reconstruct.state import read_description
from shinypartial.core.camera import ray_directions_world, reflect
from shinypartial.dataset.read import open_dataset, read_view, require_normals
from shinypartial.dataset.schema import Dataset, Frame
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.evaluation.masks import environment_mask
from shinypartial.io.files import read_json, write_json
from shinypartial.prediction.format import write_environment_map


@dataclass(frozen=True)
class TrueMirror(ExactGeometry):
    """The pixels of the views with the directions that ground-truth normals mirror them to."""

    kind: ClassVar[str] = "truth"
    known: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]
    """By the identity of each view's mask: mirrored directions (…, 3) of its pixels, their changes by a pixel to the
    right and down (…, 2, 3), and which of them see the environment.
    """

    def observe(self, view: TrainView, pixels: torch.Tensor) -> Rays:
        """Those of the pixels that see the environment."""
        directions, _, clear = self.known[id(view.mask)]
        chosen = pixels[torch.from_numpy(clear[pixels.numpy()])]
        return Rays(torch.from_numpy(directions[chosen.numpy()]).float(), view.radiance_at(chosen))

    def footprints(self, views: Views, max_pixels: int) -> Footprints | None:
        """Four directions over each pixel that has neighbors on all sides and turns little, as in a free form's fit."""
        found = []
        for view, pixels in at_most_pixels(views, max_pixels):
            directions, steps, clear = (each[pixels.numpy()] for each in self.known[id(view.mask)])
            kept = clear & (np.linalg.norm(steps, axis=2).max(1) < WIDEST_FOOTPRINT_RAD)
            right, down = np.array(SUB_PIXELS[4]).T[..., None]
            over = directions[kept, None] + right * steps[kept, None, 0] + down * steps[kept, None, 1]
            chosen = pixels[torch.from_numpy(kept)]
            found.append(PixelFootprints(torch.from_numpy(over).float(), view.radiance_at(chosen)))
        return Footprints.of(found)


def true_mirror(dataset: Dataset, views: Views) -> TrueMirror:
    """Of the training views."""
    pairs = zip(dataset.train, views.train, strict=True)
    return TrueMirror({id(view.mask): seen(frame, view) for frame, view in pairs})


def seen(frame: Frame, view: TrainView) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `TrueMirror` knows of a view, which is cropped."""
    truth, window = read_view(frame), window_of(frame, view)
    clear, normals = environment_mask(truth), require_normals(frame, truth)
    directions = reflect(ray_directions_world(frame.camera), normals.astype(np.float64))
    directions = np.where(clear[..., None], directions, np.nan)
    steps = np.stack([np.gradient(directions, axis=axis) for axis in (1, 0)], 2)
    inner = clear & np.isfinite(steps).all((2, 3))
    steps[~inner] = np.inf
    return directions[window].reshape(-1, 3), steps[window].reshape(-1, 2, 3), clear[window].ravel()


def solved(dataset: Dataset, config: FitConfig) -> np.ndarray:
    """The map (H, 2H, 3) that a fit's solver makes of ground-truth normals and photographs as they were taken."""
    views, config = configured_views(dataset, replace(config, exposure=1.0))
    environment, _ = true_mirror(dataset, views).solve_map(views, config)
    return cube_to_latlong(environment, 2 * environment.shape[-1])


def main() -> None:
    """Score the prediction that is named, and its bound."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("prediction", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    run = read_description(options.run)
    dataset = open_dataset(run.dataset)
    bound = options.prediction.with_name(f"{options.prediction.name}-bound")
    shutil.copytree(options.prediction, bound, dirs_exist_ok=True)
    with torch.no_grad():
        write_environment_map(bound, solved(dataset, run.config))
    found: dict[str, Any] = {}
    for name, folder in (("prediction", options.prediction), ("ground-truth normals", bound)):
        environment = evaluate(folder, run.dataset).environment
        assert environment is not None, "a rendered dataset has its environment"
        scores = environment.as_predicted
        regions = {"full": scores.full, "observed": scores.observed, "resolved": scores.resolved}
        found[name] = {each: round(region.psnr_linear, 2) for each, region in regions.items() if region is not None}
    everything = read_json(options.output, "earlier scores") if options.output.exists() else {}
    write_json(options.output, {**everything, options.prediction.name: found})
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
