"""The plane as a kind of geometry."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.silhouettes import without_gaps
from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from panoless.geometry.base import SOLID_SURFACE_ALPHA, Geometry, Mesh, Proposal, SurfaceBuffers
from panoless.geometry.exact import ExactFamily, SeenByCenters, looked_up, mirrored_directions
from panoless.geometry.plane.fit import fit_plane
from panoless.geometry.plane.model import Plane, plane_buffers, unoccluded_share
from panoless.geometry.plane.unknowns import PlaneUnknowns
from panoless.kernels.camera import RasterCamera
from shinypartial.core.errors import InputError

UNOCCLUDED_SHARE = 0.99


@dataclass(frozen=True)
class PlaneMirror(SeenByCenters):
    """A flat mirror with a boundary and, perhaps, a frame that stands out before it."""

    kind: ClassVar[str] = "plane"
    plane: Plane
    occlusion_test: bool = True
    """Whether pixels that show the frame in the mirror are left out."""

    def usable_pixels(self, view: TrainView) -> Int[Tensor, "P"]:
        """Solid pixels that do not show the frame in the mirror."""
        if not self.occlusion_test:
            return view.solid
        share = unoccluded_share(self.plane, view.camera).flatten()[view.solid]
        return view.solid[share > UNOCCLUDED_SHARE]

    def seen(self, view: TrainView, pixels: Int[Tensor, "P"]) -> tuple[Int[Tensor, "Q"], Float[Tensor, "Q 3"]]:
        """Those of the pixels that the plane covers."""
        buffers = plane_buffers(self.plane, view.camera)
        pixels = pixels[buffers.alpha.flatten()[pixels] > SOLID_SURFACE_ALPHA]
        directions = mirrored_directions(view.camera, pixels, buffers.normals_camera.flatten(1)[:, pixels])
        return pixels, looked_up(self.surroundings, view.camera, buffers.depth, pixels, directions)

    def buffers(self, camera: RasterCamera) -> SurfaceBuffers:
        """Exact coverage and depth."""
        return plane_buffers(self.plane, camera)

    def mesh(self, frame: ObjectFrame) -> Mesh:
        """One polygon, with the normal of the plane at every vertex."""
        corners = frame.to_world(self.plane.points(self.plane.boundary))
        return Mesh.smooth(corners, np.arange(len(corners))[None], np.broadcast_to(self.plane.normal, corners.shape))


class WithinOneBoundary(ExactFamily):
    """A kind whose silhouette is one polygon: gaps between pieces of masks, such as bars, are closed."""

    def with_silhouettes(self, views: Views) -> Views:
        """With masks without gaps."""
        return without_gaps(views)


class PlaneFamily(WithinOneBoundary):
    """Planes that explain silhouettes."""

    kind: ClassVar[str] = "plane"
    geometry: ClassVar[type[Geometry]] = PlaneMirror
    label: ClassVar[str] = "a plane"
    by_silhouettes: ClassVar[bool] = True

    def propose(self, views: Views, config: FitConfig, *, requested: bool) -> Proposal | None:
        """Plane, boundary and frame by silhouettes."""
        try:
            found = fit_plane(self.with_silhouettes(views), thorough=requested)
        except InputError:
            if requested:
                raise
            return None
        return Proposal(found.plane, float(np.median(found.median_px)), float(np.median(found.iou)))

    def as_proposed(self, proposal: Proposal, config: FitConfig) -> Geometry:
        """The plane within its boundary."""
        return PlaneMirror(proposal.shape, config.environment.trace)

    def unknowns(self, views: Views, proposal: Proposal, config: FitConfig) -> PlaneUnknowns:
        """See there."""
        return PlaneUnknowns(proposal.shape)
