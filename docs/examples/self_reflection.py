"""Which pixels a fitted geometry finds to see the object itself, against the dataset's self-reflection mask.

    python docs/examples/self_reflection.py datasets/vase-400 runs/vase-400-default --output self-reflection.json

Those are the pixels through which a geometry observes the surroundings only if its mirrored rays are not traced against
itself. Surfels and height fields don't do that. A fit never reads the mask; this example does, for every `--every`-th
training view. Results of other datasets in the output are kept.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import binary_dilation

from panoless.capture.views import TrainView, load_views
from panoless.config import FitConfig
from panoless.reconstruct.state import load_state
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import Dataset, Frame
from shinypartial.io.files import read_json, write_json

MARGINS_PX = (0, 1, 2)
CROP_MARGIN_PX = FitConfig().crop_margin_px


def main() -> None:
    """Score the runs that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--every", type=int, default=5)
    options = parser.parse_args()
    dataset = open_dataset(options.dataset)
    found = {}
    for run in options.runs:
        state = load_state(run)
        if state is None:
            parser.error(f"no checkpoint in {run}")
        if not hasattr(state.geometry, "occlusion_test"):
            parser.error(f"the {state.geometry.kind} of {run} is not traced against itself")
        found[run.name] = score(dataset, state.geometry, options.every)
    everything = read_json(options.output, "earlier scores") if options.output.exists() else {}
    write_json(options.output, {**everything, dataset.name: found})
    print(json.dumps(found, indent=1))


def window_of(frame: Frame, view: TrainView) -> tuple[slice, slice]:
    """Rows and columns of a picture that its cropped view shows: cropping moves the principal point by whole pixels."""
    camera = view.camera
    left, top = round(frame.camera.cx - camera.cx), round(frame.camera.cy - camera.cy)
    return slice(top, top + camera.height), slice(left, left + camera.width)


def observed_pixels(geometry: Any, view: TrainView) -> np.ndarray:
    """Whether a geometry observes the surroundings through each pixel (flat)."""
    observed = np.zeros(view.mask.numel(), bool)
    numbers = torch.arange(len(observed), dtype=torch.float64).view(1, *view.mask.shape).expand(3, -1, -1)
    numbered = geometry.observe(replace(view, radiance=numbers), view.solid).radiance[:, 0]
    observed[numbered.long().numpy()] = True
    return observed


def score(dataset: Dataset, geometry: Any, every: int) -> dict[str, object]:
    """Precision and recall over wholly covered pixels, for the pixels found and for those within a margin of them."""
    counts = {margin: np.zeros(3, int) for margin in MARGINS_PX}
    solid_pixels = 0
    for frame, view in list(zip(dataset.train, load_views(dataset, CROP_MARGIN_PX).train, strict=True))[::every]:
        truth = read_view(frame)
        if truth.self_reflection is None:
            raise SystemExit(f"{dataset.name} has no self-reflection mask")
        true = truth.self_reflection[window_of(frame, view)] > 0
        solid = np.zeros(view.mask.numel(), bool)
        solid[view.solid.numpy()] = True
        observed = [observed_pixels(each, view) for each in (geometry, replace(geometry, occlusion_test=False))]
        found, solid = (each.reshape(view.mask.shape) for each in (observed[1] & ~observed[0], solid))
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


if __name__ == "__main__":
    main()
