"""What primitives hide of their own surroundings: a truncated signed distance to their surface, and rays through it."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from panoless.kernels.camera import RasterCamera

SOLID = 0.5
"""Pixels of at least this alpha show the surface, the others what is behind it."""
OUTSIDE = 0.25
"""A ray has left the surface that it starts on where the distance exceeds this share of the truncation."""
RAYS_AT_ONCE = 8192
BEGINS = 20_000 / 50_000
"""Share of the steps after which rays are traced (Yao et al. 2024)."""
EVERY = 2_000 / 50_000
"""Share of the steps between two grids (Yao et al. 2024)."""
MOST_VIEWS = 32
"""Depths of so many views, evenly spread, are joined."""
CELLS = 96
"""Grid points along an edge of the cube."""
HALF_EDGE = 1.2
"""Half the edge of the cube, in radii of the object."""
CELL = 2 * HALF_EDGE / (CELLS - 1)
"""Edge of a cell in radii of the object."""
TRUNCATION = 5.0 * CELL
"""Distances are known so far before and behind the surface: five cells (Yao et al. 2024)."""
STRIDE = 2.0 * CELL
"""Length of a ray's steps; what lies behind the surface is thicker."""


class DepthMap(NamedTuple):
    """What a camera sees of a surface."""

    camera: RasterCamera
    depth: Float[Tensor, "H W"]
    alpha: Float[Tensor, "H W"]


@dataclass(frozen=True)
class Occluder:
    """Signed distances over the truncation, at z, y, x of a cube about the origin: negative behind the surface, 1 where
    nothing was seen.
    """

    distances: Float[Tensor, "N N N"]

    @classmethod
    def fused(cls, maps: Iterable[DepthMap], device: torch.device | None = None) -> "Occluder":
        """The mean over the views of how far each grid point lies before the surface (Curless and Levoy 1996).

        A view says nothing of points that lie deeper behind its surface than the truncation. Of what is behind, the
        largest connected part is kept, so that nothing that floats beside the object hides anything.
        """
        axis = torch.linspace(-HALF_EDGE, HALF_EDGE, CELLS, device=device)
        z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
        points = torch.stack([x, y, z], -1).view(-1, 3)
        total = count = torch.zeros_like(points[:, 0])
        for seen in maps:
            signed, known = _signed_distances(points, seen)
            total, count = total + signed * known, count + known
        mean = torch.where(count > 0, total / count.clamp(min=1), 1.0)
        return cls(_largest_part(mean.view(3 * (CELLS,))))

    def to(self, device: torch.device) -> "Occluder":
        """The same on a device."""
        return Occluder(self.distances.to(device))

    @torch.no_grad()
    def hides(self, origins: Float[Tensor, "P 3"], directions: Float[Tensor, "P 3"]) -> Bool[Tensor, "P"]:
        """Whether rays of unit direction that leave the surface meet it again.

        A ray meets it where the distance, interpolated linearly, is negative after it was `OUTSIDE`. So what it meets
        within some four cells, in a crease, is passed over.
        """
        parts = zip(origins.split(RAYS_AT_ONCE), directions.split(RAYS_AT_ONCE), strict=True)
        found = [self._hides(*part) for part in parts]
        return torch.cat(found) if found else torch.zeros(0, dtype=torch.bool, device=origins.device)

    def _hides(self, origins: Float[Tensor, "P 3"], directions: Float[Tensor, "P 3"]) -> Bool[Tensor, "P"]:
        grid = (origins[:, None] + directions[:, None] * self._reaches[:, None]) / HALF_EDGE
        values = grid_sample(self.distances[None, None], grid[None, None], align_corners=True)[0, 0, 0]
        left = (values > OUTSIDE).cummax(1).values
        return (left & (values < 0)).any(1)

    @cached_property
    def _reaches(self) -> Float[Tensor, "S"]:
        """Distances along a ray: steps of the stride to the cube's longest diagonal."""
        steps = int(2 * 3**0.5 * HALF_EDGE / STRIDE)
        return STRIDE * torch.arange(1, steps + 1, device=self.distances.device)


def _signed_distances(points: Float[Tensor, "M 3"], seen: DepthMap) -> tuple[Float[Tensor, "M"], Bool[Tensor, "M"]]:
    """Depth of the surface less that of points, over the truncation and at most 1; and of which points it is known."""
    camera = seen.camera
    pose = camera.world_to_camera.to(points)
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    front = z > camera.near
    depth = z.clamp(min=camera.near)
    column = (camera.fx * x / depth + camera.cx).floor().long()
    row = (camera.fy * y / depth + camera.cy).floor().long()
    inside = front & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    pixels = torch.where(inside, row * camera.width + column, 0)
    signed = (seen.depth.flatten()[pixels] - z) / TRUNCATION
    signed = torch.where(seen.alpha.flatten()[pixels] >= SOLID, signed, 1.0).clamp(max=1)
    return signed, inside & (signed > -1)


def _largest_part(distances: Float[Tensor, "N N N"]) -> Float[Tensor, "N N N"]:
    """With one connected part behind the surface, the others taken for empty."""
    from scipy.ndimage import label

    parts, count = label((distances < 0).cpu().numpy())
    if count < 2:
        return distances
    named = torch.from_numpy(parts).to(distances.device)
    largest = torch.bincount(named.flatten())[1:].argmax() + 1
    return torch.where((named > 0) & (named != largest), 1.0, distances)
