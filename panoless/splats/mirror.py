"""Surfels as a geometry: what they observed, how far each is to be trusted, and the map that follows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.poses import Poses
from panoless.capture.views import TrainView, Views, at_most_pixels, split_held_out
from panoless.config import FitConfig
from panoless.environment.footprints import Footprints, thinned
from panoless.environment.rays import Rays
from panoless.environment.resolution import RESOLUTIONS, prediction_error
from panoless.environment.solve import solve_environment
from panoless.environment.surroundings import FAR, Surroundings
from panoless.geometry.base import SOLID_SURFACE_ALPHA, Mesh, SurfaceBuffers, from_plain
from panoless.geometry.exact import mirrored_directions, shade_centers
from panoless.kernels.camera import RasterCamera
from panoless.kernels.cubemap import sample_cubemap
from panoless.numeric.gauss_newton import LEAST_GAIN, keep_if_better
from panoless.numeric.robust import robust_weight
from panoless.splats.kernels.rasterize import Channels, RasterBuffers
from panoless.splats.model import ShadedSurfels, Surfels
from panoless.splats.objective import MirrorObjective, StepObjective
from panoless.splats.rendering import ALPHA_FLOOR, rasterize_surfels, surface_buffers, tiles_of
from shinypartial.core.conventions import SOLID_ALPHA

SH_DEGREE_0 = 0.28209479177387814
TRIAL_SHARE = 1 / 8
"""Share of the rays that decides which surfels to trust and how fine a map is worth it."""
TRIAL_RESOLUTION = 128
"""Texels along a face side of the map by which that is decided."""
TRUST_VIEWS = 40
"""Most views by which surfels are judged."""
TRUST_SCALE = 0.15
"""Residual (linear radiance) beyond which a pixel lowers the trust in its surfels."""
PRIOR_PIXELS = 1.0
"""Weight of the prior of each surfel, in pixels, so that one that is hardly seen is hardly trusted…"""
PRIOR_TRUST = 0.2
"""…and its value."""
TRUST_POWER = 4.0
"""The power of the blended trust by which a ray counts."""


@dataclass(frozen=True)
class SurfelMirror:
    """A set of surfels, and which of their parameters count."""

    kind: ClassVar[str] = "surfels"
    surfels: Surfels
    curved: bool = True
    albedo: bool = False
    roughness: bool = False

    @classmethod
    def of(cls, surfels: Surfels, config: FitConfig) -> "SurfelMirror":
        """Surfels as a configuration takes them."""
        splats = config.splats
        return cls(surfels, splats.surfels.curved, splats.albedo, splats.loss.roughness_weighted)

    @property
    def reflectance(self) -> None:
        """None: of an even mirror."""
        return None

    @property
    def num_parameters(self) -> int:
        """Center, rotation, radii and opacity of each, and what else is learned."""
        return (3 + 4 + 2 + 1 + 3 * self.albedo + 3 * self.curved + self.roughness) * self.surfels.count

    @property
    def num_primitives(self) -> int:
        """The number of surfels."""
        return self.surfels.count

    @property
    def poses(self) -> Poses | None:
        """None: cameras are fixed."""
        return None

    def with_poses(self, poses: Poses | None) -> "SurfelMirror":
        """Itself: surfels find no poses."""
        return self

    def corrected(self, views: Views) -> Views:
        """As they are."""
        return views

    @property
    def surroundings(self) -> Surroundings:
        """Far."""
        return FAR

    def in_surroundings(self, surroundings: Surroundings) -> "SurfelMirror":
        """Itself: surfels know only a far world."""
        return self

    def usable_pixels(self, view: TrainView) -> Int[Tensor, "P"]:
        """All solid ones."""
        return view.solid

    def observe(self, view: TrainView, pixels: Int[Tensor, "P"]) -> Rays:
        """The rays of those of the pixels that surfels cover, less what is diffuse."""
        return self.observe_covered(view, pixels)[0]

    def observe_covered(self, view: TrainView, pixels: Int[Tensor, "P"]) -> tuple[Rays, Int[Tensor, "Q"]]:
        """The rays, and which pixels they belong to."""
        buffers = rasterize_surfels(
            self.surfels,
            view.camera,
            curved=self.curved,
            channels=Channels(colors=self.albedo, depth=False, distortion=False),
            active_tiles=tiles_of(view.mask > SOLID_ALPHA),
        )
        pixels = pixels[buffers.alpha.flatten()[pixels] > SOLID_SURFACE_ALPHA]
        diffuse = buffers.colors.flatten(1)[:, pixels]
        radiance = view.radiance_at(pixels) - diffuse.T
        directions = mirrored_directions(view.camera, pixels, buffers.normals_camera.flatten(1)[:, pixels])
        return Rays(directions, radiance, incoming=view.directions_world(pixels)), pixels

    def footprints(self, views: Views, max_pixels: int) -> Footprints | None:
        """None: normals are not known well enough beside a pixel's center."""
        return None

    def solve_map(self, views: Views, config: FitConfig) -> tuple[Float[Tensor, "6 3 L L"], list[Rays]]:
        """The map from rays weighted by the trust in their surfels.

        A trial map says which surfels to trust, and held-out views how fine the map should be, unless the
        configuration does; then all rays are solved.
        """
        most = config.environment.rays
        observed = [(view, *self.observe_covered(view, pixels)) for view, pixels in at_most_pixels(views, most)]
        resolution, few = config.environment.solve_resolution, most * TRIAL_SHARE
        trial_resolution = resolution or TRIAL_RESOLUTION
        coarse = solve_environment(thinned([rays for _, rays, _ in observed], few), trial_resolution)
        trust = surfel_trust(views, self, coarse)
        rays = [
            replace(rays, trust=self._trust_of(view, trust, pixels) ** TRUST_POWER) for view, rays, pixels in observed
        ]
        trial = thinned(rays, few)
        coarse = solve_environment(trial, trial_resolution)
        return solve_environment(rays, resolution or finest_resolution(trial, coarse), coarse), rays

    def _trust_of(self, view: TrainView, trust: Float[Tensor, "K"], pixels: Int[Tensor, "P"]) -> Float[Tensor, "P"]:
        """The trust of the surfels that pixels see, blended."""
        buffers = rasterize_attribute(view, self.surfels, trust[:, None].expand(-1, 3).contiguous())
        blended = buffers.colors[0].flatten()[pixels] / buffers.alpha.flatten()[pixels].clamp(min=ALPHA_FLOOR)
        return blended.clamp(0, 1)

    def buffers(self, camera: RasterCamera) -> SurfaceBuffers:
        """Blended over the surfels."""
        return surface_buffers(self.surfels, camera, curved=self.curved)

    def shade(
        self,
        environment: Float[Tensor, "6 3 L L"],
        camera: RasterCamera,
        pixels: Int[Tensor, "P"],
        normals_camera: Float[Tensor, "3 P"],
    ) -> Float[Tensor, "P 3"]:
        """The map where the blended normals mirror the pixels' centers to (Eqs. 5–7)."""
        return shade_centers(environment, camera, pixels, normals_camera)

    def objective(self, views: Views, config: FitConfig) -> StepObjective:
        """What the steps of its fit minimize."""
        return MirrorObjective(config)

    def at(self, surfels: Surfels, share: float, objective: StepObjective) -> "SurfelMirror":
        """With its surfels as they are when that share of the steps of its objective is taken."""
        return replace(self, surfels=surfels)

    def mesh(self, frame: ObjectFrame) -> Mesh:
        """A cloud with the column names that Gaussian-splat viewers read.

        Colors are degree-0 spherical harmonics of the albedo; curvature_a, _b, _c are the shape operator.
        """
        surfels = self.surfels.detached()
        columns = {
            **_columns(("nx", "ny", "nz"), surfels.normals),
            **_columns(("f_dc_0", "f_dc_1", "f_dc_2"), (surfels.albedo - 0.5) / SH_DEGREE_0),
            "opacity": surfels.opacity_logits,
            **_columns(("scale_0", "scale_1", "scale_2"), surfels.log_scales + math.log(frame.radius)),
            **_columns(("rot_0", "rot_1", "rot_2", "rot_3"), normalize(surfels.quats, dim=1)),
            **_columns(("curvature_a", "curvature_b", "curvature_c"), surfels.curvatures / frame.radius),
        }
        centers = surfels.means * frame.radius + torch.from_numpy(frame.center).float()
        return Mesh(centers.numpy(), columns={name: column.numpy() for name, column in columns.items()})

    def to(self, device: torch.device) -> "SurfelMirror":
        """The same numbers on a device."""
        return replace(self, surfels=self.surfels.to(device))

    def state_dict(self) -> dict[str, Any]:
        """The surfels' tensors, and the switches."""
        return {**vars(self), "surfels": self.surfels.detached().named()}

    @classmethod
    def from_state_dict(cls, content: dict[str, Any]) -> "SurfelMirror":
        """The geometry that `state_dict` was taken from."""
        from panoless.splats.shading.geometry import ShadedMirror
        from panoless.splats.shading.occlusion import Occluder

        kind, primitives = (ShadedMirror, ShadedSurfels) if "shading" in content else (cls, Surfels)
        if content.get("occluder") is not None:
            content = {**content, "occluder": from_plain(Occluder, content["occluder"])}
        surfels = primitives(**content["surfels"])
        return kind(**{**content, "surfels": surfels})


def _columns(names: Sequence[str], matrix: Tensor) -> dict[str, Tensor]:
    return dict(zip(names, matrix.unbind(1), strict=False))


def surfel_trust(views: Views, mirror: SurfelMirror, environment: Float[Tensor, "6 3 L L"]) -> Float[Tensor, "K"]:
    """Share of the pixels that a surfel makes up, over some views, whose radiance agrees with a map; in [0, 1].

    A surfel whose normal is wrong disagrees in most views although its rays agree with each other in one; a pixel alone
    cannot show that. Agreement is the Geman–McClure weight of the residual; a pixel counts for a surfel by its share in
    the blend, which is the derivative of the blended image.
    """
    surfels = mirror.surfels
    agreeing, total = torch.zeros_like(surfels.means[:, 0]), torch.zeros_like(surfels.means[:, 0])
    for view in views.train[:: math.ceil(len(views.train) / TRUST_VIEWS)]:
        rays, pixels = mirror.observe_covered(view, view.solid)
        error = sample_cubemap(environment, rays.directions) - rays.radiance
        shares = torch.zeros(surfels.count, 3, device=surfels.means.device, requires_grad=True)
        with torch.enable_grad():
            buffers = rasterize_attribute(view, surfels.detached(), shares)
            votes = torch.zeros_like(buffers.colors).flatten(1)
            votes[0, pixels], votes[1, pixels] = robust_weight(error, TRUST_SCALE), 1.0
            # A scalar, because torch loads much code to check the shapes of other cotangents.
            voted = (buffers.colors * votes.view_as(buffers.colors)).sum()
        (gradient,) = torch.autograd.grad(voted, shares)
        agreeing += gradient[:, 0]
        total += gradient[:, 1]
    return (agreeing + PRIOR_TRUST * PRIOR_PIXELS) / (total + PRIOR_PIXELS)


def rasterize_attribute(view: TrainView, surfels: Surfels, attribute: Float[Tensor, "K 3"]) -> RasterBuffers:
    """The blend of a value of each surfel over the solid pixels of a view."""
    return rasterize_surfels(
        surfels,
        view.camera,
        curved=False,
        attribute=attribute,
        channels=Channels(depth=False, distortion=False),
        active_tiles=tiles_of(view.mask > SOLID_ALPHA),
    )


def finest_resolution(
    rays: Sequence[Rays], start: Float[Tensor, "6 3 L L"] | None = None, least_gain: float = LEAST_GAIN
) -> int:
    """Texels along a face side: the first of 64, 128, 256 that held-out views explain as well as the next.

    Every fifth view is held out. Their error is the mean of ‖e‖²/(‖e‖² + s²), s = `ERROR_SCALE`, weighted by trust:
    rays that see the object itself count alike for all resolutions. The next has to lower it by the share `least_gain`.
    """
    solved, held_out = split_held_out(rays)
    if not held_out or not solved:
        return RESOLUTIONS[0]
    return keep_if_better(
        RESOLUTIONS,
        lambda resolution: prediction_error(held_out, solve_environment(solved, resolution, start)),
        least_gain,
    )
