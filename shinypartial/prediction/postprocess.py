"""Directions that a prediction hardly saw, smoothed: one use of the visibility map, for any method that writes one."""

import shutil
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from shinypartial.core.errors import InputError
from shinypartial.core.sphere import blur_latlong, latlong_directions, latlong_solid_angles, sample_latlong
from shinypartial.io.files import folder_lock, link_or_copy
from shinypartial.prediction.format import (
    DESCRIPTION,
    ENVIRONMENT,
    EVALUATION,
    REPORT,
    SCORES,
    SNAPSHOTS,
    TEST_VIEWS,
    VISIBILITY,
    PredictionInfo,
    begin_prediction,
    read_environment_map,
    read_info,
    read_visibility,
    write_environment_map,
    write_info,
)

#: What is written again, or says nothing about the changed map; everything else is taken over as it is.
NOT_TAKEN_OVER = (DESCRIPTION, ENVIRONMENT, SCORES, REPORT)
FOLDERS_NOT_TAKEN_OVER = (SNAPSHOTS, EVALUATION)
LEVELS = 256


@dataclass(frozen=True)
class BlurOptions:
    """Standard deviations of the two Gaussians on the sphere, in degrees."""

    blur_deg: float = 2.0
    """Of the blur of what is hardly seen."""
    feather_deg: float = 2.0
    """Of the transition from the map to its blur, which lies wholly on the side that is hardly seen."""


@dataclass(frozen=True)
class Blurred:
    """A map smoothed where visibility is low, the threshold that said where, and the share of the sphere below it."""

    radiance: Float[np.ndarray, "H W 3"]
    threshold: float
    share: float


def otsu_threshold(visibility: Float[np.ndarray, "H W"]) -> float:
    """Otsu's threshold (1979) of a lat-long map, each texel counted by its solid angle, in 256 levels.

    Raises InputError when all values are one, which leaves nothing to distinguish.
    """
    from skimage.filters import threshold_otsu

    if float(visibility.min()) == float(visibility.max()):
        raise InputError(
            expected="a visibility map that distinguishes directions",
            found=f"the value {float(visibility.min()):.3g} everywhere",
            remedy="Nothing is to be done for such a prediction: all of it was seen equally well.",
        )
    weight, edges = np.histogram(visibility, LEVELS, weights=latlong_solid_angles(len(visibility)))
    return float(threshold_otsu(hist=(weight, (edges[:-1] + edges[1:]) / 2)))


def blur_hardly_seen(
    radiance: Float[np.ndarray, "H W 3"], visibility: Float[np.ndarray, "_H _W"], options: BlurOptions
) -> Blurred:
    """Blend the map E with its blur G∗E by a = m · max(0, 2 (F∗m) − 1), where m is 1 below Otsu's threshold, else 0.

    F is the Gaussian of the transition. At a straight border F∗m = ½, so a rises from 0 there to 1 inside: directions
    at or above the threshold keep their radiance to the bit. Visibility may have another size than the map.
    """
    height = len(radiance)
    seen = visibility
    if len(visibility) != height:
        seen = sample_latlong(visibility[..., None], latlong_directions(height))[..., 0]
    threshold = otsu_threshold(visibility)
    hardly = (seen < threshold)[..., None].astype(np.float32)
    feathered = hardly * np.maximum(0, 2 * blur_latlong(hardly, np.radians(options.feather_deg)) - 1)
    smooth = blur_latlong(radiance, np.radians(options.blur_deg))
    mixed = np.where(feathered > 0, radiance + feathered * (smooth - radiance), radiance)
    share = float((hardly[..., 0] * latlong_solid_angles(height)).sum() / (4 * np.pi))
    return Blurred(mixed.astype(np.float32), threshold, share)


def postprocess(prediction: Path, output: Path, options: BlurOptions = BlurOptions()) -> Blurred:
    """Write a prediction folder like `prediction`, but for its environment, which is blurred where it was hardly seen.

    Everything else is taken over, by hard links where the file system has them: renders, normals and visibility are
    those of the source. prediction.json says what it was made from. Raises InputError when the source lacks a map.
    """
    start, info = time.monotonic(), read_info(prediction)
    _check(prediction, output, options)
    radiance, visibility = read_environment_map(prediction), read_visibility(prediction)
    if visibility is None:
        raise InputError(
            expected=f"{VISIBILITY} in {prediction}",
            found="none",
            remedy="Only a method that says how well it saw each direction can be post-processed.",
        )
    blurred = blur_hardly_seen(radiance, visibility, options)
    with folder_lock(output):
        begin_prediction(output)
        for path in sorted(prediction.rglob("*")):
            place = path.relative_to(prediction)
            if path.is_file() and str(place) not in NOT_TAKEN_OVER and place.parts[0] not in FOLDERS_NOT_TAKEN_OVER:
                link_or_copy(path, output / place)
        write_environment_map(output, blurred.radiance)
        if not (prediction / TEST_VIEWS).is_dir():
            shutil.rmtree(output / TEST_VIEWS)  # Where that folder is, an evaluation requires every test view.
        write_info(output, _describe(info, prediction, blurred, options, time.monotonic() - start))
    return blurred


def _describe(
    info: PredictionInfo, source: Path, blurred: Blurred, options: BlurOptions, seconds: float
) -> PredictionInfo:
    """What differs from one seed to the next stands in `model`, so that charts still see one configuration."""
    made = f"blurred where visibility is below {blurred.threshold:.3f}, from {source.resolve()}"
    return replace(
        info,
        method=f"{info.method}, hardly seen directions blurred",
        model=f"{info.model}; {made}" if info.model else made,
        config={**info.config, "postprocess": asdict(options)},
        seconds={**info.seconds, "postprocess": round(seconds, 3)},
    )


def _check(prediction: Path, output: Path, options: BlurOptions) -> None:
    for name, value in asdict(options).items():
        if not 0 < value <= 90:
            raise InputError(
                expected=f"--{name.replace('_', '-')} above 0 and at most 90 degrees",
                found=str(value),
                remedy="Choose a few degrees.",
            )
    if output.resolve() == prediction.resolve():
        raise InputError(
            expected="another folder than the prediction itself",
            found=f"{output} for both",
            remedy="Choose another --output.",
        )
