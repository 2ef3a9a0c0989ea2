"""Which pixels of a ground-truth view count: wholly on the object, and of those the ones that see the environment."""

import numpy as np
from jaxtyping import Bool

from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.dataset.schema import View


def solid_mask(truth: View) -> Bool[np.ndarray, "H W"]:
    """Pixels that lie wholly on the object and have a ground-truth normal."""
    if truth.normals_world is None:
        return truth.alpha > SOLID_ALPHA
    return (truth.alpha > SOLID_ALPHA) & (np.linalg.norm(truth.normals_world, axis=-1) > 0.5)


def environment_mask(truth: View) -> Bool[np.ndarray, "H W"]:
    """Pixels of `solid_mask` whose mirror ray leaves the scene, as far as the dataset knows which rays don't."""
    mask = solid_mask(truth)
    return mask if truth.self_reflection is None else mask & ~(truth.self_reflection > 0)
