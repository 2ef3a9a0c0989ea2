"""The surface of revolution as a kind of geometry."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from panoless.environment.footprints import Footprints
from panoless.environment.rays import Rays
from panoless.geometry.base import Geometry, Mesh, Proposal, SurfaceBuffers, from_plain, poses_from_plain, to_plain
from panoless.geometry.exact import ExactFamily, ExactGeometry
from panoless.geometry.revolution.deblurred_map import pixel_footprints
from panoless.geometry.revolution.fit import follow_views, propose_revolution, refine_revolution
from panoless.geometry.revolution.lip import CLEARANCE_PX, beside_lip
from panoless.geometry.revolution.model import SurfaceOfRevolution, revolution_buffers, revolution_rays
from panoless.geometry.revolution.render import SAMPLES, mean_light
from panoless.geometry.revolution.silhouette import contour_rays
from panoless.geometry.revolution.unknowns import STIFF_PX, RevolutionUnknowns
from panoless.kernels.camera import RasterCamera
from shinypartial.core.errors import InputError

MERIDIANS = 128


@dataclass(frozen=True)
class RevolutionMirror(ExactGeometry):
    """An axis and a meridian profile."""

    kind: ClassVar[str] = "revolution"
    surface: SurfaceOfRevolution
    occlusion_test: bool = True
    """Whether pixels that see the object again are left out."""

    def usable_pixels(self, view: TrainView) -> Int[Tensor, "P"]:
        """Solid pixels, but for those beside the lip of an open wall, which mix two surfaces."""
        if not self.surface.is_open:
            return view.solid
        mixed = torch.from_numpy(beside_lip(view.camera, self.surface, CLEARANCE_PX).ravel())
        return view.solid[~mixed.to(view.solid.device)[view.solid]]

    def observe(self, view: TrainView, pixels: Int[Tensor, "P"]) -> Rays:
        """The rays of the pixels; where all solid ones are taken, trusted by the solid angle of each."""
        return revolution_rays(
            self.surface,
            view,
            pixels,
            occlusion_test=self.occlusion_test,
            weighted=len(pixels) == len(view.solid),
        )[0]

    def footprints(self, views: Views, max_pixels: int) -> Footprints:
        """Of all pixels that see the environment at once, and of a sample of the others."""
        return pixel_footprints(views, self.surface, occlusion_test=self.occlusion_test)

    def buffers(self, camera: RasterCamera) -> SurfaceBuffers:
        """By intersection; alpha by 4×4 rays where neighbors disagree."""
        return revolution_buffers(self.surface, camera, SAMPLES)

    def shade(
        self,
        environment: Float[Tensor, "6 3 L L"],
        camera: RasterCamera,
        pixels: Int[Tensor, "P"],
        normals_camera: Float[Tensor, "3 P"],
    ) -> Float[Tensor, "P 3"]:
        """Mean over the pixels' areas, followed through all their reflections."""
        return mean_light(self.surface, environment, camera, pixels)

    def state_dict(self) -> dict[str, Any]:
        """All numbers as lists and plain values."""
        surface, poses = to_plain(self.surface), to_plain(self.poses)
        return {"surface": surface, "occlusion_test": self.occlusion_test, "poses": poses}

    @classmethod
    def from_state_dict(cls, content: dict[str, Any]) -> "RevolutionMirror":
        """The geometry that `state_dict` was taken from."""
        surface = from_plain(SurfaceOfRevolution, content["surface"])
        return cls(surface, content["occlusion_test"], poses=poses_from_plain(content))

    def mesh(self, frame: ObjectFrame) -> Mesh:
        """Quadrilaterals between 128 meridians, with the normals of the surface; a crease has a ring for each side."""
        rings = self.surface.rings(MERIDIANS)
        index = np.arange(rings.points[..., 0].size).reshape(-1, MERIDIANS)
        lower, upper = index[rings.sides[:, 0]], index[rings.sides[:, 1]]
        faces = np.stack([lower, np.roll(lower, -1, 1), np.roll(upper, -1, 1), upper], -1).reshape(-1, 4)
        return Mesh.smooth(frame.to_world(rings.points.reshape(-1, 3)), faces, rings.normals.reshape(-1, 3))


class RevolutionFamily(ExactFamily):
    """Surfaces of revolution that explain silhouettes."""

    kind: ClassVar[str] = "revolution"
    geometry: ClassVar[type[Geometry]] = RevolutionMirror
    label: ClassVar[str] = "a surface of revolution"

    def propose(self, views: Views, config: FitConfig, *, requested: bool) -> Proposal | None:
        """Axis and outer profile by silhouettes."""
        found = propose_revolution(views)
        if found is not None:
            return Proposal(found.surface, float(np.median(found.median_px)), float(np.median(found.iou)))
        if requested:
            raise InputError(
                expected="masks of a surface of revolution, for --model revolution",
                found="no axis around which their silhouettes agree",
                remedy="Take --model auto.",
            )
        return None

    def as_proposed(self, proposal: Proposal, config: FitConfig) -> Geometry:
        """The outside, closed flat at both ends."""
        return RevolutionMirror(proposal.shape, config.environment.trace)

    def unknowns(self, views: Views, proposal: Proposal, config: FitConfig) -> RevolutionUnknowns:
        """See there."""
        return RevolutionUnknowns(proposal.shape, contour_rays(views).pixel)

    def begun(self, views: Views, surface: RevolutionUnknowns, config: FitConfig) -> RevolutionUnknowns:
        """With a stiff profile."""
        return replace(surface, knot_px=STIFF_PX)

    def finished(self, views: Views, solved: RevolutionMirror, config: FitConfig) -> RevolutionMirror:
        """With what is inside, and finer than the joint solve has it."""
        return solved.with_shape(refine_revolution(views, solved.surface))

    def refitted(self, views: Views, fitted: RevolutionMirror, config: FitConfig) -> Geometry:
        """Profile and axis after one more round."""
        return fitted.with_shape(follow_views(views, fitted.surface))
