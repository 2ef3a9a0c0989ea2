"""The sphere as a kind of geometry."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import pixel_rays
from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from panoless.environment.footprints import Footprints, PixelFootprints
from panoless.environment.rays import Rays
from panoless.geometry.base import SAMPLES, Geometry, Mesh, Proposal, parts_of_pixel
from panoless.geometry.exact import ExactFamily, ExactGeometry
from panoless.geometry.sphere.fit import fit_sphere
from panoless.geometry.sphere.model import CENTER, Sphere, mirrored
from panoless.geometry.sphere.unknowns import SphereUnknowns
from panoless.kernels.camera import RasterCamera
from panoless.kernels.cubemap import sample_cubemap
from shinypartial.core.errors import InputError

WIDEST_FOOTPRINT_RAD = 0.2
"""Pixels that span more determine the map by their centers only."""
OPERATOR_TRUST = 0.01
"""Rays that show who takes the pictures count so little that any other view of their directions decides."""


@dataclass(frozen=True)
class SphereMirror(ExactGeometry):
    """A mirror ball. It is convex, so every pixel of it shows the surroundings."""

    kind: ClassVar[str] = "sphere"
    sphere: Sphere
    operator_deg: float = 0.0
    """Rays that return to their camera within this angle are hardly trusted."""

    def usable_pixels(self, view: TrainView) -> Int[Tensor, "P"]:
        """Solid pixels whose centers the sphere covers."""
        met = self.sphere.hits(*pixel_rays(view.camera, view.solid.cpu().numpy())).met
        return view.solid[torch.from_numpy(met).to(view.solid.device)]

    def observe(self, view: TrainView, pixels: Int[Tensor, "P"]) -> Rays:
        """The rays of those of the pixels that the sphere covers, trusted by the angle that each spans."""
        index = pixels.cpu().numpy()
        outgoing, met = mirrored(self.sphere, view.camera, index, [CENTER])
        kept = met[:, 0]
        chosen, found = pixels[torch.from_numpy(kept).to(pixels.device)], outgoing[kept, 0]
        corners, _ = mirrored(self.sphere, view.camera, index[kept], parts_of_pixel(2))
        trust = _trust_by_span(corners) * self._trust_by_return(view, found)
        return Rays(
            torch.from_numpy(found).float().to(view.radiance.device),
            view.radiance_at(chosen),
            torch.from_numpy(trust).float().to(view.radiance.device),
            view.directions_world(chosen),
        )

    def footprints(self, views: Views, max_pixels: int) -> Footprints | None:
        """Of the pixels that the sphere covers wholly and that span a narrow angle."""
        found = []
        for view in views.train:
            corners, met = mirrored(self.sphere, view.camera, view.solid.cpu().numpy(), parts_of_pixel(2))
            kept = met.all(1) & (_spans(corners) < WIDEST_FOOTPRINT_RAD**2)
            pixels = view.solid[torch.from_numpy(kept).to(view.solid.device)]
            trust = self._trust_by_return(view, corners[kept].mean(1))
            directions, trusted = (
                torch.from_numpy(each).float().to(view.radiance.device) for each in (corners[kept], trust)
            )
            found.append(PixelFootprints(directions, view.radiance_at(pixels), trusted))
        return Footprints.of(found)

    def shade(
        self,
        environment: Float[Tensor, "6 3 L L"],
        camera: RasterCamera,
        pixels: Int[Tensor, "P"],
        normals_camera: Float[Tensor, "3 P"],
    ) -> Float[Tensor, "P 3"]:
        """Mean over the pixels' areas, as far as the sphere covers them; zero where it covers nothing."""
        outgoing, met = mirrored(self.sphere, camera, pixels.cpu().numpy(), parts_of_pixel(SAMPLES))
        directions, weight = (torch.from_numpy(each).to(environment) for each in (outgoing, met))
        light = sample_cubemap(environment, directions.flatten(0, 1)).unflatten(0, met.shape)
        return (light * weight[..., None]).sum(1) / weight.sum(1).clamp(min=1)[:, None]

    def mesh(self, frame: ObjectFrame) -> Mesh:
        """Quadrilaterals between meridians and rings, with exact normals."""
        normals, faces = Mesh.unit_sphere()
        return Mesh.smooth(frame.to_world(self.sphere.center + self.sphere.radius * normals), faces, normals)

    def _trust_by_return(self, view: TrainView, outgoing: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """Little where rays come back to their camera, which sees itself and who holds it there."""
        back = view.position - self.sphere.center
        returns = outgoing @ (back / np.linalg.norm(back)) > np.cos(np.radians(self.operator_deg))
        return np.where(returns & (self.operator_deg > 0), OPERATOR_TRUST, 1.0)


def _spans(corners: Float[np.ndarray, "P 4 3"]) -> Float[np.ndarray, "P"]:
    """The square of the larger angle that pixels span along rows and columns, by the middles of their four quarters."""
    along_row, along_column = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 4 * np.maximum((along_row**2).sum(1), (along_column**2).sum(1))


def _trust_by_span(corners: Float[np.ndarray, "P 4 3"]) -> Float[np.ndarray, "P"]:
    """1/(1 + a/ā) of the square angles a of pixels with the median ā: beside the silhouette one spans a wide strip."""
    spans = _spans(corners)
    return 1 / (1 + spans / np.median(spans)) if len(spans) else spans


class SphereFamily(ExactFamily):
    """Spheres that explain silhouettes."""

    kind: ClassVar[str] = "sphere"
    geometry: ClassVar[type[Geometry]] = SphereMirror
    label: ClassVar[str] = "a sphere"
    needs_depth: ClassVar[bool] = False
    silhouettes_suffice: ClassVar[bool] = True

    def propose(self, views: Views, config: FitConfig, *, requested: bool) -> Proposal | None:
        """Center and radius by silhouettes."""
        found = fit_sphere(views, config.sphere.radius, requested=requested)
        if found is None and requested:
            raise InputError(
                expected="masks with a silhouette, for --model sphere",
                found="none within the pictures",
                remedy="Check that the ball lies within the pictures.",
            )
        return found

    def unknowns(self, views: Views, proposal: Proposal, config: FitConfig) -> SphereUnknowns:
        """See there."""
        return SphereUnknowns(proposal.shape, config.sphere.radius > 0)

    def finished(self, views: Views, solved: SphereMirror, config: FitConfig) -> SphereMirror:
        """With how little rays count that come back to their camera, where there are several."""
        return replace(solved, operator_deg=config.sphere.operator_deg if len(views.train) > 1 else 0.0)
