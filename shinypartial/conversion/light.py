"""The light of a prediction: what to make of directions that were not seen, cube maps, spherical harmonics."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse.linalg import splu

from shinypartial.core.conventions import Y_UP_TO_WORLD
from shinypartial.core.errors import InputError
from shinypartial.core.harmonics import project_latlong
from shinypartial.core.sphere import (
    blur_latlong,
    cube_directions,
    latlong_directions,
    latlong_laplacian,
    sample_latlong,
)
from shinypartial.prediction.format import VISIBILITY, read_environment_map, read_visibility

Confidence = Literal["keep", "darken", "fill"]
Layout = Literal["opengl", "three"]

#: Rows of the grid on which gaps are filled: a harmonic fill is smooth, so that a finer one shows no difference.
FILL_ROWS = 128
#: π A_l of Ramamoorthi and Hanrahan (2001), eq. 8, by degree: irradiance has the coefficients A_l c_lm.
COSINE_FACTORS = (np.pi, 2 * np.pi / 3, np.pi / 4, 0.0, -np.pi / 24)
#: From directions in which a cube map is looked up to those of the world.
LAYOUTS = {"opengl": Y_UP_TO_WORLD, "three": Y_UP_TO_WORLD @ np.diag([-1.0, 1, 1])}


def light_of(prediction: Path, confidence: Confidence) -> Float[np.ndarray, "H W 3"]:
    """The predicted map E, as `confidence` has it: E, visibility · E, or E filled where the visibility is 0.

    Raises InputError when visibility is needed and the prediction has none.
    """
    radiance = read_environment_map(prediction)
    if confidence == "keep":
        return radiance
    visibility = _visibility(prediction, f"--confidence {confidence}", "Take --confidence keep.")
    if len(visibility) != len(radiance):
        visibility = sample_latlong(visibility[..., None], latlong_directions(len(radiance)))[..., 0]
    if confidence == "darken":
        return radiance * visibility[..., None]
    return filled(radiance, visibility > 0)


def seen_mask(prediction: Path, feather_deg: float, threshold: float = 0.5) -> Float[np.ndarray, "H W"]:
    """Where the light was seen, as a lat-long mask in [0, 1] for a program that must not trust the rest.

    2 b − 1 with b the share of directions in a Gaussian of half of `feather_deg` whose visibility is at least the
    threshold: zero along a straight border, and one at about the feather's width within it. Zero beyond.
    """
    seen = _visibility(prediction, "--to mask", "Leave mask out.") >= threshold
    if feather_deg <= 0:
        return seen.astype(np.float64)
    share = blur_latlong(seen[..., None].astype(np.float64), np.radians(feather_deg) / 2)[..., 0]
    return np.clip(2 * share - 1, 0, 1) * seen


def _visibility(prediction: Path, needed_for: str, remedy: str) -> Float[np.ndarray, "H W"]:
    visibility = read_visibility(prediction)
    if visibility is None:
        raise InputError(expected=f"{VISIBILITY} in {prediction}, for {needed_for}", found="none", remedy=remedy)
    return visibility


def filled(radiance: Float[np.ndarray, "H W 3"], seen: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W 3"]:
    """A harmonic fill: Δ_S² u = 0 where nothing was seen and u = E elsewhere, which keeps its value to the bit.

    It is solved on at most `FILL_ROWS` rows, of means of what was seen. A map of which all or nothing was seen is left
    as it is.
    """
    if seen.all() or not seen.any():
        return radiance
    step = 1
    while len(radiance) // step > FILL_ROWS and len(radiance) % (2 * step) == 0:
        step *= 2
    rows = len(radiance) // step
    blocks = np.concatenate([radiance * seen[..., None], seen[..., None]], -1).astype(np.float64)
    *colors, number = np.moveaxis(blocks.reshape(rows, step, 2 * rows, step, 4).sum((1, 3)), -1, 0)
    coarse = (np.stack(colors, -1) / np.maximum(number, 1)[..., None]).reshape(-1, 3)
    known = number.ravel() > 0
    if not known.all():
        hidden = latlong_laplacian(rows)[~known]
        coarse[~known] = splu(hidden[:, ~known].tocsc()).solve(-(hidden[:, known] @ coarse[known]))
    smooth = sample_latlong(coarse.reshape(rows, 2 * rows, 3), latlong_directions(len(radiance)))
    return np.where(seen[..., None], radiance, smooth).astype(radiance.dtype)


def cube_faces(latlong: Float[np.ndarray, "H W 3"], layout: Layout) -> Float[np.ndarray, "6 L L 3"]:
    """Six faces px, nx, py, ny, pz, nz of half the map's height, as OpenGL's table 8.19 has rows and columns, Y up.

    `opengl`: a lookup in the right-handed direction (x, y, z) finds the light of the world's (x, −z, y). `three`: the
    same for three.js, which looks up (−x, y, z) for the direction (x, y, z). Means of 2×2 points a texel.
    """
    resolution = max(len(latlong) // 2, 1)
    fine = sample_latlong(latlong, cube_directions(2 * resolution) @ LAYOUTS[layout].T)
    return fine.reshape(6, resolution, 2, resolution, 2, 3).mean((2, 4))


def harmonics_of(latlong: Float[np.ndarray, "H W 3"], degree: int) -> dict[str, Any]:
    """The content of harmonics.json: radiance in spherical harmonics about Y-up axes, and what the numbers mean.

    Y-up directions (x, y, z) are (x, −z, y) in the world, as in the cube maps and the GLB.
    """
    if not 0 <= degree < len(COSINE_FACTORS):
        raise InputError(
            expected=f"--degree from 0 to {len(COSINE_FACTORS) - 1}",
            found=str(degree),
            remedy="Irradiance needs 2; 4 is the most.",
        )
    return {
        "degree": degree,
        "coefficients": project_latlong(latlong, degree, Y_UP_TO_WORLD).tolist(),
        "order": "entry l*l + l + m is [R, G, B] of degree l and order m, m from -l to l",
        "basis": "real, orthonormal over the sphere, no Condon-Shortley phase: Y(0,0) = 0.282095, "
        "Y(1,-1) = 0.488603 y, Y(1,0) = 0.488603 z, Y(1,1) = 0.488603 x; m < 0 has sin, m > 0 cos",
        "quantity": "linear radiance: L(d) = sum of coefficients times Y(d)",
        "axes": "right-handed, +Y up, as in glTF; (x, y, z) is (x, -z, y) in the world of the dataset",
        "irradiance_factors": list(COSINE_FACTORS[: degree + 1]),
        "irradiance": "multiply the coefficients of degree l by irradiance_factors[l]; divide by pi for diffuse white",
    }
