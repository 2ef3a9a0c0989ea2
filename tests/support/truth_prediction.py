"""The ground truth written as a prediction: the folder that must score perfectly, and a base for damaged ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from shinypartial.core.sphere import latlong_directions
from shinypartial.dataset.read import read_environment, read_view
from shinypartial.dataset.schema import ENVIRONMENT_LATLONG, Dataset
from shinypartial.prediction.format import (
    PredictionInfo,
    dataset_hash,
    prediction_frame,
    write_environment_map,
    write_info,
    write_test_view,
    write_visibility,
)

CURVES = {"iteration": [0.0, 10.0, 20.0, 30.0], "loss": [1.0, 0.3, 0.1, 0.01], "psnr_train": [10.0, 15.0, 20.0, 22.0]}


def write_truth_prediction(root: Path, dataset: Dataset) -> Path:
    """Write what `dataset` knows about its test views and environment as a prediction; return `root`."""
    for frame in dataset.test:
        view = read_view(frame)
        if view.normals_world is None:
            target = prediction_frame(root, frame).png
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(frame.png.read_bytes())
        else:
            depth = np.zeros_like(view.alpha) if view.depth is None else view.depth
            write_test_view(root, frame, replace(view, depth=depth))
    if (dataset.root / ENVIRONMENT_LATLONG).exists():
        radiance = read_environment(dataset)
        write_environment_map(root, radiance)
        write_visibility(root, np.clip(latlong_directions(radiance.shape[0])[..., 0] / 2 + 0.5, 0, 1))
    info = PredictionInfo(
        method="truth",
        dataset=str(dataset.root),
        dataset_hash=dataset_hash(dataset),
        config={"seed": 0, "nested": {"rate": 0.5, "name": "<adam>"}},
        seconds={"read": 1.5, "fit": 62.0},
        hardware={"device": "cpu"},
        parameter_counts={"surfels": 14000},
        peak_memory_bytes=2**28,
        curves=CURVES,
    )
    write_info(root, info)
    return root
