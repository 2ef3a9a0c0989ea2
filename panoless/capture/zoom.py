"""Cameras farther away through a longer lens, which leaves outlines where they are.

With eˢ times the distance from the object's center and eˢ times the focal length a camera sees every point where it
did, to first order, but from another side. Of a camera with the optical axis a the ray o + t d becomes

o + (eˢ − 1) o + t (d + (eˢ − 1)(d·a) a), to first order one of the turn ω = s (d·a) d × a and the shift τ = s o.
"""

import numpy as np
from jaxtyping import Float

from panoless.capture.corrections import with_focal_factor
from panoless.capture.poses import moved_view
from panoless.capture.views import TrainView


def farther(view: TrainView, change: float) -> TrainView:
    """A view after the logarithm s of distance and focal length has changed."""
    return with_focal_factor(moved_view(view, np.eye(3), np.expm1(change) * view.position), float(np.exp(change)))


def farther_rays(
    origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], axes: Float[np.ndarray, "P 3"], s: float
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Origins and unit directions of rays after that change; `axes` are the optical ones of their cameras."""
    found = directions + np.expm1(s) * (directions * axes).sum(1, keepdims=True) * axes
    return origins + np.expm1(s) * origins, found / np.linalg.norm(found, axis=1, keepdims=True)


def farther_motion(
    origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], axes: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "P 6"]:
    """(ω, τ)/s: how rays are turned and shifted by s, to first order."""
    return np.concatenate([np.cross(directions, (directions * axes).sum(1, keepdims=True) * axes), origins], 1)
