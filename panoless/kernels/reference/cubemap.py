"""Seamless bilinear cubemap lookup, its adjoint and the texel geometry, in plain torch: the definition.

Faces are ordered (+X, −X, +Y, −Y, +Z, −Z) and oriented as OpenGL 4.6 table 8.19, in unswizzled world axes.
Texel (row j, column i) of a face is centered at s = 2(i + ½)/L − 1, t = 2(j + ½)/L − 1.

A lookup interpolates on the face padded by one ring of texels of its neighbors, so it is continuous on the whole
sphere. A padded texel is the texel straight across the edge; where three faces meet, it is the mean of their three
corner texels, which makes the value at a corner of the cube that same mean, seen from all three faces.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

NUM_CORNERS = 8
SHORTEST_DIRECTION = 1e-30
# Direction of growing s, direction of growing t, and outward axis of each face.
FACE_FRAMES = (
    ((0, 0, -1), (0, -1, 0), (1, 0, 0)),
    ((0, 0, 1), (0, -1, 0), (-1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, 1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, -1, 0), (0, 0, -1)),
)


@dataclass(frozen=True)
class CubemapPadding:
    """Where the texels of the padded faces come from.

    Entries of `sources` below 6·L² are flat texels (face, row, column); entry 6·L² + k is the mean of the three
    texels `corners[k]` that meet at corner k of the cube.
    """

    sources: Int[Tensor, "6 padded padded"]
    corners: Int[Tensor, "8 3"]


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # A table first built in inference mode could never serve a backward.
def cubemap_padding(resolution: int, device: torch.device) -> CubemapPadding:
    """The padding table of faces of `resolution`² texels; computed once per resolution and device."""
    sources = pad(torch.arange(6 * resolution**2).reshape(6, resolution, resolution), (1, 1, 1, 1))
    ends, lines = torch.tensor([-1, resolution]), torch.arange(-1, resolution + 1)
    for rows, columns in ((ends, lines), (lines, ends)):
        directions = _face_directions(resolution, columns.double(), rows.double())
        face, st, _ = project_to_face(directions.reshape(-1, 3))
        sources[:, rows[:, None] + 1, columns + 1] = _texel_index(face, st, resolution).reshape(6, len(rows), -1)
    octant = ((_face_directions(resolution, ends.double()) > 0) * torch.tensor([1, 2, 4])).sum(-1)
    sources[:, ends[:, None] + 1, ends + 1] = 6 * resolution**2 + octant

    signs = torch.tensor([[1 if corner >> axis & 1 else -1 for axis in range(3)] for corner in range(NUM_CORNERS)])
    # A shade inside the corner of the face of each axis lies the texel that this face contributes.
    inward = 1 - (1 - torch.eye(3, dtype=torch.float64)) / resolution
    face, st, _ = project_to_face((signs[:, None, :] * inward).reshape(-1, 3))
    corners = _texel_index(face, st, resolution).reshape(NUM_CORNERS, 3)
    return CubemapPadding(sources.to(device), corners.to(device))


def project_to_face(
    directions: Float[Tensor, "P 3"],
) -> tuple[Int[Tensor, "P"], Float[Tensor, "P 2"], Bool[Tensor, "P"]]:
    """Dominant face (ties: x before y before z), coordinates (s, t) in [−1, 1]², and whether a direction is usable.

    Directions need not be unit. One that is zero (every component below 1e-30) or not finite
    is not usable; it gets the center of face +X.
    """
    with torch.no_grad():
        magnitude = directions.abs()
        usable = (magnitude.amax(-1) >= SHORTEST_DIRECTION) & directions.isfinite().all(-1)
        x, y, z = torch.where(usable[:, None], magnitude, 1).unbind(-1)
        axis = torch.where((x >= y) & (x >= z), 0, torch.where(y >= z, 1, 2))
        face = 2 * axis + (directions.gather(1, axis[:, None])[:, 0] < 0)
        face = torch.where(usable, face, 0)
        frames = torch.tensor(FACE_FRAMES, dtype=directions.dtype, device=directions.device)
        plus_x = frames[0, 2]
    safe = torch.where(usable[:, None], directions, plus_x)
    s, t, major = (frames[face] * safe[:, None, :]).sum(-1).unbind(-1)
    return face, torch.stack([s / major, t / major], -1), usable


def sample_cubemap(cubemap: Float[Tensor, "6 C L L"], directions: Float[Tensor, "P 3"]) -> Float[Tensor, "P C"]:
    """Definition of `panoless.kernels.cubemap.sample_cubemap`."""
    taps, weights = bilinear_taps(directions, cubemap.shape[-1])
    return (padded_texels(cubemap)[taps] * weights[..., None]).sum(1)


def padded_texels(cubemap: Float[Tensor, "6 C L L"]) -> Float[Tensor, "N C"]:
    """The texels of the padded faces, flat."""
    _, channels, resolution, _ = cubemap.shape
    padding = cubemap_padding(resolution, cubemap.device)
    texels = cubemap.movedim(1, -1).reshape(-1, channels)
    return torch.cat([texels, texels[padding.corners].mean(1)])[padding.sources.reshape(-1)]


def scatter_cubemap(
    values: Float[Tensor, "P C"], directions: Float[Tensor, "P 3"], resolution: int
) -> Float[Tensor, "6 C L L"]:
    """Definition of `panoless.kernels.cubemap.scatter_cubemap`."""
    channels = values.shape[1]
    taps, weights = bilinear_taps(directions, resolution)
    padded = values.new_zeros(6 * (resolution + 2) ** 2, channels)
    padded.index_add_(0, taps.reshape(-1), (weights[..., None] * values[:, None, :]).reshape(-1, channels))
    return fold_padding(padded, resolution)


def fold_padding(padded: Float[Tensor, "N C"], resolution: int) -> Float[Tensor, "6 C L L"]:
    """The adjoint of `padded_texels`: what lies in a ring goes to the texels that it shows."""
    channels = padded.shape[1]
    padding = cubemap_padding(resolution, padded.device)
    texels = padded.new_zeros(6 * resolution**2 + NUM_CORNERS, channels)
    texels.index_add_(0, padding.sources.reshape(-1), padded)
    texels, corners = texels.split([6 * resolution**2, NUM_CORNERS])
    shares = (corners / 3).repeat_interleave(3, 0)
    texels = texels.index_add(0, padding.corners.reshape(-1), shares)
    return texels.reshape(6, resolution, resolution, channels).movedim(-1, 1).contiguous()


PAIRS = ((0, 0, 0), (1, 1, 0), (2, 2, 0), (3, 3, 0), (0, 1, 1), (2, 3, 1), (0, 2, 2), (1, 3, 2), (0, 3, 3), (1, 2, 4))
"""Two of the four taps of a lookup each, the earlier first, and which neighbor of the one the other is."""
NEIGHBORS = ((0, 0), (0, 1), (1, 0), (1, 1), (1, -1))
"""Rows and columns from a padded texel to those that lookups read with it and that come no earlier."""


def lookup_gram(
    directions: Float[Tensor, "P 3"], weights: Float[Tensor, "P"], resolution: int
) -> Float[Tensor, "6 padded padded 5"]:
    """Definition of `panoless.kernels.cubemap.lookup_gram`."""
    (taps, shares), padded = bilinear_taps(directions, resolution), resolution + 2
    gram = weights.new_zeros(5, 6 * padded**2)
    for one, other, neighbor in PAIRS:
        gram[neighbor].index_add_(0, taps[:, one], weights * shares[:, one] * shares[:, other])
    return gram.T.reshape(6, padded, padded, 5).contiguous()


def apply_gram(gram: Float[Tensor, "6 padded padded 5"], cubemap: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C L L"]:
    """Definition of `panoless.kernels.cubemap.apply_gram`."""
    channels, padded = cubemap.shape[1], gram.shape[1]
    texels = padded_texels(cubemap).reshape(6, padded, padded, channels)
    result = gram[..., :1] * texels
    for neighbor, (down, right) in enumerate(NEIGHBORS[1:], 1):
        here = slice(0, padded - down), slice(max(-right, 0), padded - max(right, 0))
        there = slice(down, padded), slice(max(right, 0), padded - max(-right, 0))
        shared = gram[:, *here, neighbor, None]
        result[:, *here] += shared * texels[:, *there]
        result[:, *there] += shared * texels[:, *here]
    return fold_padding(result.reshape(-1, channels), padded - 2)


def bilinear_taps(directions: Float[Tensor, "P 3"], resolution: int) -> tuple[Int[Tensor, "P 4"], Float[Tensor, "P 4"]]:
    """Flat indices into the padded faces of the four texels around each direction, and their weights.

    The weights of a direction that is not usable are all zero.
    """
    face, st, usable = project_to_face(directions)
    position = (st + 1) * (resolution / 2) + 0.5
    origin = position.detach().floor().clamp(0, resolution)
    column_weight, row_weight = (position - origin).unbind(-1)
    column, row = origin.long().unbind(-1)
    stride = resolution + 2
    first = (face * stride + row) * stride + column
    taps = torch.stack([first, first + 1, first + stride, first + stride + 1], -1)
    left, top = 1 - column_weight, 1 - row_weight
    weights = torch.stack([top * left, top * column_weight, row_weight * left, row_weight * column_weight], -1)
    return taps, torch.where(usable[:, None], weights, 0)


def cubemap_directions(resolution: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "6 L L 3"]:
    """Definition of `panoless.kernels.cubemap.cubemap_directions`."""
    directions = _face_directions(resolution, torch.arange(resolution, dtype=torch.float64))
    return torch.nn.functional.normalize(directions, dim=-1).to(device, dtype)


def cubemap_solid_angles(resolution: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "L L"]:
    """Definition of `panoless.kernels.cubemap.cubemap_solid_angles`."""
    edges = torch.linspace(-1, 1, resolution + 1, dtype=torch.float64)
    s, t = edges[None, :], edges[:, None]
    below = torch.atan2(s * t, torch.sqrt(s * s + t * t + 1))
    return below.diff(dim=0).diff(dim=1).to(device, dtype)


def _face_directions(
    resolution: int, columns: Float[Tensor, "N"], rows: Float[Tensor, "M"] | None = None
) -> Float[Tensor, "6 M N 3"]:
    """Directions (not unit) of the centers of texels, which may lie outside the face; the same rows as columns
    unless given.
    """
    s_axis, t_axis, outward = torch.tensor(FACE_FRAMES, dtype=torch.float64)[:, None, None].unbind(-2)
    s, t = (2 * (texel + 0.5) / resolution - 1 for texel in (columns, columns if rows is None else rows))
    return outward + s[None, None, :, None] * s_axis + t[None, :, None, None] * t_axis


def _texel_index(face: Int[Tensor, "P"], st: Float[Tensor, "P 2"], resolution: int) -> Int[Tensor, "P"]:
    """Flat index (face, row, column) of the texel that contains each point of a face."""
    column, row = ((st + 1) * (resolution / 2)).floor().long().clamp(0, resolution - 1).unbind(-1)
    return (face * resolution + row) * resolution + column
