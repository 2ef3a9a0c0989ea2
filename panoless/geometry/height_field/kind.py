"""The height field as a kind of geometry."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from panoless.geometry.base import Geometry, Mesh, Proposal, SurfaceBuffers
from panoless.geometry.exact import SeenByCenters
from panoless.geometry.height_field.fit import CELLS, best_dome, cleared, refined
from panoless.geometry.height_field.model import (
    HeightField,
    flat_height_field,
    height_field_buffers,
    visible_reflections,
)
from panoless.geometry.height_field.unknowns import STIFF, HeightFieldUnknowns
from panoless.geometry.plane.kind import WithinOneBoundary
from panoless.kernels.camera import RasterCamera
from shinypartial.core.errors import InputError


@dataclass(frozen=True)
class HeightFieldMirror(SeenByCenters):
    """A mirror that bends: a smooth height over a plane."""

    kind: ClassVar[str] = "height_field"
    height_field: HeightField

    def seen(self, view: TrainView, pixels: Int[Tensor, "P"]) -> tuple[Int[Tensor, "Q"], Float[Tensor, "Q 3"]]:
        """Those of the pixels whose reflected rays pass the frame."""
        visible = visible_reflections(self.height_field, view, pixels)
        return visible.pixels, torch.from_numpy(visible.outgoing).to(view.radiance)

    def buffers(self, camera: RasterCamera) -> SurfaceBuffers:
        """Coverage by the mirror's edge; depth and normals by intersection."""
        return height_field_buffers(self.height_field, camera)

    def mesh(self, frame: ObjectFrame) -> Mesh:
        """Quadrilaterals within the boundary, with the exact normals of the spline."""
        points, faces = self.height_field.quadrilaterals()
        return Mesh.smooth(frame.to_world(points), faces, self.height_field.normals_at(points))


class HeightFieldFamily(WithinOneBoundary):
    """Heights over a plane that explains the silhouettes, but not what it mirrors."""

    kind: ClassVar[str] = "height_field"
    geometry: ClassVar[type[Geometry]] = HeightFieldMirror
    label: ClassVar[str] = "a height field over it"
    refines: ClassVar[str | None] = "plane"

    def propose(self, views: Views, config: FitConfig, *, requested: bool) -> Proposal | None:
        """None: a height field starts from the proposal of a plane."""
        if requested:
            raise InputError(
                expected="a plane that a height field may bend, for --model height_field",
                found="silhouettes that determine none",
                remedy="Take --model auto.",
            )
        return None

    def as_proposed(self, proposal: Proposal, config: FitConfig) -> Geometry:
        """The plane that it bends, flat as yet."""
        return HeightFieldMirror(flat_height_field(proposal.shape, CELLS))

    def before_steps(self, views: Views, proposal: Proposal, config: FitConfig) -> Geometry:
        """The dome or bowl over the plane that photographs agree on best, or the plane."""
        flat = flat_height_field(proposal.shape, CELLS)
        return HeightFieldMirror(best_dome(views, flat))

    def unknowns(self, views: Views, proposal: Proposal, config: FitConfig) -> HeightFieldUnknowns:
        """A stiff one, for silhouettes."""
        return HeightFieldUnknowns(flat_height_field(proposal.shape, CELLS), STIFF)

    def begun(self, views: Views, surface: HeightFieldUnknowns, config: FitConfig) -> HeightFieldUnknowns:
        """With the dome or bowl more that photographs agree on best."""
        return HeightFieldUnknowns(best_dome(views, surface.height_field))

    def refitted(self, views: Views, fitted: HeightFieldMirror, config: FitConfig) -> Geometry:
        """Heights, plane and boundary after one more round."""
        return fitted.with_shape(refined(self.with_silhouettes(views), fitted.height_field))

    def finished(self, views: Views, solved: HeightFieldMirror, config: FitConfig) -> HeightFieldMirror:
        """With the height that reflected rays have to pass at the rim."""
        return solved.with_shape(cleared(views, solved.height_field))
