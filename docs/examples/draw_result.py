"""Draw what a fit is about in one picture: a photograph, the environment it reflects, what was recovered, how sure.

Usage: python docs/examples/draw_result.py PREDICTION DATASET OUTPUT.jpg
"""

import sys
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from shinypartial.dataset.read import open_dataset, read_environment, read_view
from shinypartial.evaluation.pictures import Scale, normal_picture, radiance_picture, scalar_picture
from shinypartial.io.files import atomic_write
from shinypartial.prediction.format import prediction_frame, read_environment_map, read_visibility

ROW = 250
GAP = 10
CAPTION = 20
VISIBILITY = Scale("visibility", "viridis", 0.0, 1.0)


def fitted(picture: UInt8[np.ndarray, "H W 3"]) -> Image.Image:
    """The picture at the height of a row."""
    image = Image.fromarray(picture)
    return image.resize((round(image.width * ROW / image.height), ROW), Image.Resampling.LANCZOS)


def main(prediction: Path, dataset_root: Path, output: Path) -> None:
    """Compose two rows: photograph and environment above, recovered normals, environment and visibility below."""
    dataset = open_dataset(dataset_root)
    frame = dataset.test[len(dataset.test) // 2]
    truth = read_view(frame)
    predicted = read_view(prediction_frame(prediction, frame))
    visibility = read_visibility(prediction)
    if visibility is None:
        raise SystemExit(f"{prediction} holds no visibility map.")
    rows = [
        [
            ("one of the photographs", radiance_picture(truth.radiance + (1 - truth.alpha)[..., None])),
            ("the environment (ground truth)", radiance_picture(read_environment(dataset))),
        ],
        [
            ("recovered normals", normal_picture(predicted.normals_world)),
            ("recovered environment", radiance_picture(read_environment_map(prediction))),
        ],
        [
            ("error of the normals, 0 to 10 degrees", _normal_error(truth.normals_world, predicted.normals_world)),
            (
                "how well each direction was observed",
                scalar_picture(visibility, Scale("visibility", "viridis", 0.0, 1.0)),
            ),
        ],
    ]
    pictures = [[(caption, fitted(picture)) for caption, picture in row] for row in rows]
    width = max(sum(image.width + GAP for _, image in row) for row in pictures) + GAP
    canvas = Image.new("RGB", (width, GAP + len(rows) * (ROW + CAPTION + GAP)), "white")
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(14)
    for index, row in enumerate(pictures):
        x, y = GAP, GAP + index * (ROW + CAPTION + GAP)
        for caption, image in row:
            canvas.paste(image, (x, y))
            draw.text((x, y + ROW + 2), caption, fill="black", font=font)
            x += image.width + GAP
    with atomic_write(output) as temporary:
        canvas.save(temporary, format="JPEG", quality=88)


def _normal_error(truth: np.ndarray | None, predicted: np.ndarray | None) -> np.ndarray:
    from shinypartial.metrics.angular import angular_error_deg

    if truth is None or predicted is None:
        raise SystemExit("Both dataset and prediction need normals for this picture.")
    mask = np.linalg.norm(truth, axis=-1) > 0
    return scalar_picture(angular_error_deg(predicted, truth), Scale("angular error", "inferno", 0.0, 10.0, "°"), mask)


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:4]))
