"""An object in the recovered light, beside the same in its own and in the true one."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from shinypartial.conversion.light import Confidence, light_of
from shinypartial.core.color import linear_to_srgb
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset, read_environment
from shinypartial.dataset.write import display_rgba
from shinypartial.io.images import write_exr_rgb, write_png
from shinypartial.io.records import check_record
from shinypartial.metrics import image
from shinypartial.prediction.format import read_info

SUFFIXES = (".blend", ".glb", ".gltf")


@dataclass(frozen=True)
class Relit:
    """What was written, and how near the recovered light comes to the true one where that is known."""

    pictures: dict[str, Path]
    psnr_srgb: float | None
    """Over pixels that lie wholly on the object, of sRGB colors clipped to [0, 1]; None also where there are none."""


def relight(
    prediction: Path,
    output: Path,
    *,
    source: Path | None = None,
    dataset: Path | None = None,
    confidence: Confidence = "keep",
    resolution: int = 512,
    samples: int = 64,
    threads: int | None = None,
) -> Relit:
    """Render an object in the light of a prediction: recovered.png; before.png in the light of its own file, for a
    .blend; truth.png in that of a dataset. Pictures have straight alpha.

    Raises InputError for files that can't be read, for pictures without a pixel or a sample, and when Blender can't be
    loaded.
    """
    from shinypartial.blender.relight import PictureOptions, render_in_lights

    if source is not None and (source.suffix not in SUFFIXES or not source.exists()):
        raise InputError(
            expected=f"--object FILE, a {', '.join(SUFFIXES)} that exists",
            found=str(source),
            remedy="Export the object from your program as .glb.",
        )
    options = PictureOptions(resolution, samples, threads=threads)
    check_record(options, "the options", place=lambda name: f"--{name}", remedy="Choose at least 1.")
    read_info(prediction)
    with tempfile.TemporaryDirectory() as scratch:
        lights: dict[str, Path | None] = {"before": None} if source and source.suffix == ".blend" else {}
        lights["recovered"] = Path(scratch) / "recovered.exr"
        write_exr_rgb(Path(scratch) / "recovered.exr", np.maximum(light_of(prediction, confidence), 0))
        if dataset is not None:
            lights["truth"] = Path(scratch) / "truth.exr"
            write_exr_rgb(Path(scratch) / "truth.exr", np.maximum(read_environment(open_dataset(dataset)), 0))
        found = render_in_lights(source, lights, options)
    pictures = {name: output / f"{name}.png" for name in found}
    for name, picture in found.items():
        write_png(pictures[name], display_rgba(picture[..., :3], picture[..., 3].clip(0, 1)))
    return Relit(pictures, psnr(found["recovered"], found["truth"]) if dataset is not None else None)


def psnr(picture: Float[np.ndarray, "H W 4"], truth: Float[np.ndarray, "H W 4"]) -> float | None:
    """Of sRGB colors in [0, 1], over pixels wholly on the object (dB); None where there are none."""
    solid = (picture[..., 3] > SOLID_ALPHA) & (truth[..., 3] > SOLID_ALPHA)
    if not solid.any():
        return None
    one, other = (linear_to_srgb(each[solid][None, :, :3].clip(0, 1)) for each in (picture, truth))
    return image.psnr(one, other, data_range=1.0)
