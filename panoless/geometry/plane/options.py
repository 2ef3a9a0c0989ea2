"""What a user may sweep in the fit of a plane."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta


@dataclass(frozen=True)
class PlaneOptions:
    """How simple the boundary of a plane is."""

    max_vertices: Annotated[int, Meta(ge=3)] = 128
    """Most vertices of the boundary."""
