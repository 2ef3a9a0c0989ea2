"""Arrays become pictures: tone-mapped radiance, error and visibility maps in perceptually uniform colors, normals."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from shinypartial.core.color import to_display
from shinypartial.dataset.schema import View
from shinypartial.dataset.write import encode_normals
from shinypartial.evaluation.masks import solid_mask
from shinypartial.io.images import write_png
from shinypartial.metrics.angular import normal_errors_deg

#: Names of the pictures that an evaluation leaves.
ENVIRONMENT_TRUTH = "environment_truth.png"
ENVIRONMENT_PREDICTION = "environment_prediction.png"
ENVIRONMENT_EXPOSED = "environment_best_exposure.png"
ENVIRONMENT_ERROR_MAP = "environment_error.png"
VISIBILITY_MAP = "visibility.png"
OBSERVED_MAP = "observed.png"

#: Shown where there is nothing to compare.
NEUTRAL_GRAY = 96

Picture = UInt8[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class Scale:
    """How a scalar becomes a color: `low` and below take the first color, `high` and above the last.

    `bounded` says that no value lies above `high`.
    """

    title: str
    colormap: str
    low: float
    high: float
    unit: str = ""
    bounded: bool = False


@dataclass(frozen=True)
class ViewPictures:
    """Files of one test view; `kind` is `render` or `normals`."""

    folder: Path
    stem: str
    kind: str

    @property
    def truth(self) -> Path:
        """Ground truth."""
        return self.folder / f"{self.stem}_{self.kind}_truth.png"

    @property
    def prediction(self) -> Path:
        """What the method predicts."""
        return self.folder / f"{self.stem}_{self.kind}_prediction.png"

    @property
    def error(self) -> Path:
        """Their difference, in colors of a Scale."""
        return self.folder / f"{self.stem}_{self.kind}_error.png"


ENVIRONMENT_ERROR = Scale("absolute sRGB error", "magma", 0.0, 0.5)
RENDER_ERROR = Scale("absolute sRGB error", "magma", 0.0, 0.25)
NORMAL_ERROR = Scale("angular error", "magma", 0.0, 30.0, "°")
VISIBILITY = Scale("visibility", "viridis", 0.0, 1.0, bounded=True)


@lru_cache(maxsize=4)
def colormap_colors(name: str) -> UInt8[np.ndarray, "256 3"]:
    """The 256 colors of a matplotlib colormap."""
    import matplotlib

    return np.rint(matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255).astype(np.uint8)


def scalar_picture(
    values: Float[np.ndarray, "H W"], scale: Scale, mask: Bool[np.ndarray, "H W"] | None = None
) -> Picture:
    """Colors of scalars; gray outside the mask. NaN counts as the highest value, since it marks a hole."""
    share = (np.nan_to_num(values, nan=np.inf) - scale.low) / (scale.high - scale.low)
    picture = colormap_colors(scale.colormap)[np.rint(np.clip(share, 0, 1) * 255).astype(int)]
    return picture if mask is None else np.where(mask[..., None], picture, np.uint8(NEUTRAL_GRAY))


def radiance_picture(radiance: Float[np.ndarray, "H W 3"]) -> Picture:
    """8-bit sRGB of linear radiance clipped to [0, 1]; premultiplied radiance appears on black."""
    return to_display(radiance)


def normal_picture(normals_world: Float[np.ndarray, "H W 3"]) -> Picture:
    """World normals as (n + 1)/2; gray where there is none."""
    present = np.linalg.norm(normals_world, axis=-1, keepdims=True) > 0.5
    return np.where(present, encode_normals(normals_world), np.uint8(NEUTRAL_GRAY))


def observed_picture(observed: Bool[np.ndarray, "H W"], resolved: Bool[np.ndarray, "H W"]) -> Picture:
    """White where training views resolve a direction, gray where they see it more coarsely, black elsewhere."""
    level = np.where(resolved, 255, np.where(observed, 128, 0)).astype(np.uint8)
    return np.repeat(level[..., None], 3, -1)


def write_view_pictures(folder: Path, stem: str, prediction: View, truth: View) -> None:
    """Write render and normals (where both have them) of one test view: truth, prediction and error."""
    renders = [radiance_picture(view.radiance) for view in (truth, prediction)]
    error = np.abs(renders[0].astype(np.float32) - renders[1]).mean(-1) / 255
    trio = ViewPictures(folder, stem, "render")
    write_png(trio.truth, renders[0])
    write_png(trio.prediction, renders[1])
    write_png(trio.error, scalar_picture(error, RENDER_ERROR))
    if truth.normals_world is None or prediction.normals_world is None:
        return
    mask = solid_mask(truth)
    errors = np.zeros(mask.shape, np.float32)
    errors[mask] = normal_errors_deg(prediction.normals_world[mask], truth.normals_world[mask])
    trio = ViewPictures(folder, stem, "normals")
    write_png(trio.truth, normal_picture(truth.normals_world))
    write_png(trio.prediction, normal_picture(prediction.normals_world))
    write_png(trio.error, scalar_picture(errors, NORMAL_ERROR, mask))
