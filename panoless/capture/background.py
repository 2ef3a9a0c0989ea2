"""What was seen past the object, beside what it mirrors."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.encoding import RadianceEncoding
from shinypartial.core.sphere import latlong_directions
from shinypartial.dataset.read import read_background
from shinypartial.dataset.schema import Dataset


@dataclass(frozen=True)
class Background:
    """Light in unit directions from the object, up to a factor of each channel: what the mirror takes from it."""

    directions: Float[Tensor, "P 3"]
    radiance: Float[Tensor, "P 3"]
    """Linear, encoded."""
    weight: Float[Tensor, "P"]
    """By solid angle; 1 at the horizon."""

    def to(self, device: torch.device) -> "Background":
        """The same on a device."""
        return Background(*(each.to(device) for each in (self.directions, self.radiance, self.weight)))


def load_background(dataset: Dataset, encoding: RadianceEncoding) -> Background:
    """That of a capture. Raises InputError where its file is missing or damaged."""
    light, seen = read_background(dataset)
    directions = latlong_directions(len(light))[seen]
    weight = np.sqrt(1 - directions[:, 2] ** 2)
    parts = (directions, encoding.encoded(light)[seen], weight)
    return Background(*(torch.from_numpy(np.ascontiguousarray(each)).float() for each in parts))
