"""How kernels are launched: sizes that change speed, never results."""

from dataclasses import dataclass

import torch
import triton
from triton import knobs

ELEMENTS_PER_PROGRAM = 256
"""Surfels, rays, pixels or candidates that one program of an elementwise kernel does."""


@dataclass(frozen=True)
class TileLaunch:
    """Shape of the tile kernels. One warp a tile needs no barrier where the backward sums over the tile."""

    tile: int = 8
    """Edge of a tile in pixels; a power of two. All pixels of a tile walk the same list of surfels."""
    warps: int = 1
    chunk: int = 16
    """Surfels between two looks at whether every pixel of the tile is finished."""


TILES = TileLaunch()


def programs(elements: int) -> tuple[int]:
    """Grid of an elementwise kernel."""
    return (triton.cdiv(elements, ELEMENTS_PER_PROGRAM),)


def runs_on(device: torch.device) -> bool:
    """Whether the kernels can take tensors of a device: in Triton's interpreter (TRITON_INTERPRET=1) the CPU's."""
    return device.type == ("cpu" if knobs.runtime.interpret else "cuda")
