"""A planar mirror: one plane with an boundary, and what a camera sees of it.

A surface of one normal needs no blending: coverage and depth are exact.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from panoless.capture.rays import camera_rays, pose_of
from panoless.environment.surroundings import FAR, Surroundings
from panoless.geometry.base import SurfaceBuffers, buffers_from_arrays
from panoless.kernels.camera import RasterCamera
from panoless.numeric.polygon import depth_inside, projected_coverage
from shinypartial.core.camera import Similarity
from shinypartial.core.conventions import PIXEL_CENTER


@dataclass(frozen=True)
class Plane:
    """A one-sided mirror: x = d n + p₁ t_u + p₂ t_v in the normalized frame with (p₁, p₂) inside the boundary.

    The normal n = t_u × t_v is unit and faces the cameras; d is the offset, n·x = d. The boundary is one closed polygon
    without holes, convex or not, counterclockwise for who looks at the mirror; its last vertex is joined to its first.
    """

    normal: Float[np.ndarray, "3"]
    offset: float
    tangent_u: Float[np.ndarray, "3"]
    tangent_v: Float[np.ndarray, "3"]
    boundary: Float[np.ndarray, "N 2"]
    frame_height: float = 0.0
    """How far the frame stands out in front of the mirror: it hides what the boundary, moved by this along the normal,
    does not let through. Zero: no frame, or a flat one.
    """
    surroundings: Surroundings = FAR
    """What it stands in."""

    @property
    def num_parameters(self) -> int:
        """How many numbers it is made of: normal and offset; the boundary's vertices; the frame."""
        return 3 + self.boundary.size + (self.frame_height > 0)

    @property
    def bars(self) -> list[Float[np.ndarray, "4 2"]]:
        """Corners of the bars that hide parts of the mirror: none."""
        return []

    def taken_back(self, common: Similarity) -> "Plane":
        """As it is in the world from which a motion was taken back."""
        origin = common.undone(self.offset * self.normal[None])[0]
        normal, *tangents = np.stack([self.normal, self.tangent_u, self.tangent_v]) @ common.rotation
        return replace(
            self,
            normal=normal,
            offset=float(normal @ origin),
            tangent_u=tangents[0],
            tangent_v=tangents[1],
            boundary=self.boundary / common.scale + np.stack(tangents) @ origin,
            frame_height=self.frame_height / common.scale,
        )

    def points(self, coordinates: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 3"]:
        """Plane coordinates to points in space."""
        return self.offset * self.normal + coordinates @ np.stack([self.tangent_u, self.tangent_v])


def passes_frame(
    plane: Plane,
    points: Float[np.ndarray, "P 3"],
    outgoing: Float[np.ndarray, "P 3"],
    height: float,
    margin: Float[np.ndarray, "P"],
) -> Bool[np.ndarray, "P"]:
    """Whether rays that leave points pass what stands at a height over the boundary, by a margin or more."""
    rising = outgoing @ plane.normal
    if height <= 0:
        return rising > 0
    rise = np.maximum(height + plane.offset - points @ plane.normal, 0.0) / np.where(rising > 0, rising, 1.0)
    places = points + rise[:, None] * outgoing
    coordinates = np.stack([places @ plane.tangent_u, places @ plane.tangent_v], 1)
    return (rising > 0) & (depth_inside(coordinates, plane.boundary) > margin)


def plane_buffers(plane: Plane, camera: RasterCamera) -> SurfaceBuffers:
    """What a camera sees of a plane: alpha is the covered area of each pixel, depth that of its center.

    Where a pixel's center lies beside the plane, its depth stays within the depths of the boundary. All is zero where
    alpha is, and everywhere for a camera behind the mirror. With a frame, alpha is the smaller of the coverages of the
    boundary and of the frame, which is exact but for pixels that both silhouettes cut.
    """
    rotation, center = pose_of(camera)
    height_above = float(plane.normal @ center) - plane.offset
    if height_above <= 0:
        nothing = np.zeros((camera.height, camera.width))
        return buffers_from_arrays(nothing, nothing, np.zeros((3, 1, 1)), camera)
    corners = (plane.points(plane.boundary) - center) @ rotation.T
    normal = rotation @ plane.normal
    alpha = projected_coverage(corners, camera)
    if 0 < plane.frame_height < height_above:
        alpha = np.minimum(alpha, projected_coverage(corners + plane.frame_height * normal, camera))
    centers = (np.arange(size) + PIXEL_CENTER for size in (camera.width, camera.height))
    slope = -(camera_rays(camera, *np.meshgrid(*centers)) @ normal)
    nearest, farthest = max(corners[:, 2].min(), camera.near), max(corners[:, 2].max(), camera.near)
    depth = np.where(slope > 0, height_above / np.maximum(slope, 1e-12), farthest).clip(nearest, farthest)
    return buffers_from_arrays(alpha, depth * (alpha > 0), normal[:, None, None], camera)


def unoccluded_share(plane: Plane, camera: RasterCamera) -> Float[Tensor, "H W"]:
    """Share of each pixel that sees the environment in the mirror, not the frame from within; 1 beside the mirror.

    A reflected ray passes the frame where the straight ray behind the mirror passes the frame's mirror image, which is
    the boundary moved by the frame's height against the normal. Without a frame it is 1 everywhere.
    """
    rotation, center = pose_of(camera)
    if plane.frame_height <= 0 or plane.normal @ center <= plane.offset:
        return camera.world_to_camera.new_ones(camera.height, camera.width)
    boundary = (plane.points(plane.boundary) - center) @ rotation.T
    image = projected_coverage(boundary - plane.frame_height * (rotation @ plane.normal), camera)
    share = np.where(projected_coverage(boundary, camera) > 0, image, 1.0)
    return torch.from_numpy(share).float().to(camera.world_to_camera.device)
