"""What a method of shading is, and what the methods share: blending, pixels with a surface, light by direction.

All radiance is in the encoding of the fit, which for these methods is sRGB, as they compute.
"""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from panoless.capture.rays import reflect, unit_rays_camera
from panoless.capture.views import TrainView
from panoless.kernels.camera import RasterCamera
from panoless.splats.density import PROPAGATED_OPACITY, PROPAGATION_GROWTH
from panoless.splats.kernels.image import depth_normals
from panoless.splats.kernels.rasterize import rasterize
from panoless.splats.kernels.reference.objective import normal_consistency, surface_depth
from panoless.splats.kernels.reference.rasterize import rotation_matrices
from panoless.splats.kernels.splats import blend_splats, project_gaussians
from panoless.splats.model import ShadedSurfels, Surfels
from panoless.splats.rendering import ALPHA_FLOOR
from panoless.splats.shading.occlusion import Occluder
from panoless.splats.split_sum import LEVELS, Prefiltered, look_up_rough, specular_share
from shinypartial.core.harmonics import harmonic_polynomials

HARMONICS = 16
"""Coefficients of spherical harmonics up to degree 3."""
HIGHER_SLOWNESS = 20
"""Harmonics above degree 0 learn so many times slower (Kerbl et al. 2023)."""
LEAST_LOGIT = 1e-6
THINNESS = 0.1
"""Thickness over the smaller radius of 3D Gaussians that start on a surface."""


class Blended(NamedTuple):
    """What one camera sees of primitives: attributes and normals Σ w a, alpha Σ w, the depth of the surface."""

    attributes: Float[Tensor, "C H W"]
    normals_camera: Float[Tensor, "3 H W"]
    alpha: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"]
    in_frustum: Bool[Tensor, " K"]


class Seen(NamedTuple):
    """A shaded view: its surface, and diffuse and specular radiance, premultiplied by alpha."""

    surface: Blended
    diffuse: Float[Tensor, "3 H W"]
    specular: Float[Tensor, "3 H W"]


@runtime_checkable
class Shading(Protocol):
    """A method: what its primitives have, how they are shaded, and what they become between steps."""

    learned: ClassVar[frozenset[str]]
    """The parameters that steps change beside the shapes."""

    @property
    def restarts_at(self) -> float:
        """Share of the steps after which materials and map begin again; 0: they never do."""
        ...

    @property
    def traces(self) -> bool:
        """Whether it traces what the object hides of its surroundings."""
        ...

    def begun(self, surfels: Surfels, *, random: bool) -> ShadedSurfels:
        """Its primitives where surfels lie, which were placed at random or on a surface."""
        ...

    def seen(
        self,
        surfels: ShadedSurfels,
        camera: RasterCamera,
        environment: Float[Tensor, "6 3 L L"],
        share: float,
        offsets: Float[Tensor, "K 2"] | None = None,
        occluder: Occluder | None = None,
    ) -> Seen:
        """A camera's view when that share of the steps is taken; the map holds values in [0, 1], no logits."""
        ...

    def penalty(
        self, seen: Seen, surfels: ShadedSurfels, view: TrainView, neighbor: RasterCamera, share: float
    ) -> Tensor | None:
        """What the objective has beyond the image, consistent normals and the silhouette; the neighbor is the camera of
        another view, the nearest one.
        """
        ...

    def propagated(self, surfels: ShadedSurfels, share: float, generator: torch.Generator) -> ShadedSurfels:
        """After a round of normal propagation."""
        ...

    def revived(self, surfels: ShadedSurfels) -> ShadedSurfels:
        """What becomes of materials where opacities are reset."""
        ...


class Unchanging:
    """What a method without terms, propagation or resets of its own does about them: nothing."""

    def penalty(
        self, seen: Seen, surfels: ShadedSurfels, view: TrainView, neighbor: RasterCamera, share: float
    ) -> Tensor | None:
        """None."""
        return None

    def propagated(self, surfels: ShadedSurfels, share: float, generator: torch.Generator) -> ShadedSurfels:
        """As they are."""
        return surfels

    def revived(self, surfels: ShadedSurfels) -> ShadedSurfels:
        """As they are."""
        return surfels


def at_least(surfels: ShadedSurfels, strength: float) -> ShadedSurfels:
    """Primitives that reflect at least so strongly."""
    return replace(surfels, strength_logits=surfels.strength_logits.clamp(min=logit(strength)))


def shaded(
    surfels: Surfels,
    log_scales: Float[Tensor, "K _"],
    strength: float,
    roughness: float,
    base_color: float = 0.5,
    *,
    indirect: bool = False,
) -> ShadedSurfels:
    """Primitives with the shapes of surfels, gray, without normals of their own and with equal materials."""
    flat, count = surfels.opacity_logits, surfels.count
    return ShadedSurfels(
        **{
            **surfels.named(),
            "log_scales": log_scales,
            "roughness_logits": torch.full_like(flat, logit(roughness)),
            "harmonics": flat.new_zeros(count, HARMONICS, 3),
            "strength_logits": torch.full_like(flat, logit(strength)),
            "base_color_logits": flat.new_full((count, 3), logit(base_color)),
            "normal_residuals": flat.new_zeros(count, 2, 3),
            "indirect_harmonics": flat.new_zeros(count, HARMONICS * indirect, 3),
        }
    )


def logit(share: float) -> float:
    """ln(p/(1 − p))."""
    return float(torch.logit(torch.tensor(share), eps=LEAST_LOGIT))


def blend_surfels(
    surfels: Surfels,
    camera: RasterCamera,
    attributes: Float[Tensor, "K C"],
    offsets: Float[Tensor, "K 2"] | None,
) -> Blended:
    """Flat surfels by the rasterizer, three attributes at a time, with the expected depth."""
    missing = -attributes.shape[1] % 3
    padded = torch.nn.functional.pad(attributes, (0, missing))
    shapes = surfels.means, surfels.quats, surfels.scales, surfels.opacities
    rasters = [
        rasterize(*shapes, part.contiguous(), None, camera, screen_offsets=offsets) for part in padded.split(3, 1)
    ]
    first = rasters[0]
    return Blended(
        torch.cat([each.colors for each in rasters])[: attributes.shape[1]],
        first.normals_camera,
        first.alpha,
        surface_depth(first.accumulated_depth, first.median_depth, first.alpha, depth_blend=0.0),
        first.in_frustum,
    )


def blend_gaussians(
    surfels: Surfels,
    camera: RasterCamera,
    attributes: Float[Tensor, "K C"],
    offsets: Float[Tensor, "K 2"] | None,
    normals: Float[Tensor, "K 3"],
) -> Blended:
    """3D Gaussians as splats, with the given world normals; the depth is the mean one of their centers."""
    splats = project_gaussians(surfels.means, surfels.quats, surfels.scales, camera)
    if offsets is not None:
        splats = replace(splats, centers=splats.centers + offsets)
    own = normals @ camera.world_to_camera[:3, :3].T.to(normals), splats.depths[:, None]
    images = blend_splats(splats, surfels.opacities, torch.cat([attributes, *own], 1), (camera.height, camera.width))
    channels, normal, depth = images.channels.split((attributes.shape[1], 3, 1))
    return Blended(channels, normal, images.alpha, depth[0] / images.alpha.clamp(min=ALPHA_FLOOR), splats.drawn)


def shortest_axes(surfels: Surfels) -> Float[Tensor, "K 3"]:
    """World directions along which 3D Gaussians are thinnest; which of the axes that is passes no gradient."""
    shortest = surfels.log_scales.detach().argmin(1)
    return rotation_matrices(surfels.quats)[torch.arange(surfels.count, device=shortest.device), :, shortest]


def solid_scales(surfels: Surfels, *, random: bool) -> Float[Tensor, "K 3"]:
    """Logarithms of three radii: balls where surfels lie at random, else `THINNESS` of the smaller radius thick."""
    smaller = surfels.log_scales.amin(1, keepdim=True)
    return torch.cat([surfels.log_scales, smaller if random else smaller + math.log(THINNESS)], 1)


def consistency_with_depth(
    surface: Blended, camera: RasterCamera, weight: Float[Tensor, "H W"], *, constant_depth: bool = False
) -> Float[Tensor, ""]:
    """1 − n·n_surf (Eq. 12), a weighted mean; the normals of the depth may be held constant."""
    depth = surface.depth.detach() if constant_depth else surface.depth
    from_depth = depth_normals(depth, camera.fx, camera.fy, camera.cx, camera.cy)
    return normal_consistency(surface.normals_camera, surface.alpha, from_depth, weight)


def seen_from(camera: RasterCamera, points: Float[Tensor, "K 3"]) -> Float[Tensor, "K 3"]:
    """Unit world directions from the camera to points."""
    pose = camera.world_to_camera.to(points)
    return normalize(points + pose[:3, :3].T @ pose[:3, 3], dim=1)


def facing(normals: Float[Tensor, "K 3"], views: Float[Tensor, "K 3"]) -> Float[Tensor, "K 3"]:
    """Normals, turned toward the camera that sees them along `views`."""
    return normals * torch.where((normals * views).sum(1, keepdim=True) > 0, -1.0, 1.0)


def incidence_cosines(views: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]) -> Float[Tensor, "P"]:
    """cos θ of unit directions from the camera; 0 where a normal is turned away."""
    return -(views * normals).sum(1).clamp(-1, 0)


def split_sum_light(
    light: Prefiltered,
    views: Float[Tensor, "P 3"],
    normals: Float[Tensor, "P 3"],
    at_normal: Float[Tensor, "P 3"],
    roughness: Float[Tensor, "P"],
) -> Float[Tensor, "P 3"]:
    """P(ω_r, ρ) (F₀ A + B) of surfaces with the reflectance F₀ at normal incidence, seen along unit directions."""
    cosines, mirrored = incidence_cosines(views, normals), reflect(views, normals)
    return look_up_rough(light, mirrored, roughness) * specular_share(at_normal, cosines, roughness)


def ambient_light(light: Prefiltered, normals: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    """P(n, 1), which diffuse surfaces are lit by."""
    return look_up_rough(light, normals, torch.full_like(normals[:, 0], LEVELS[-1]))


def harmonic_color(
    coefficients: Float[Tensor, "K B 3"], views: Float[Tensor, "K 3"], degree: int, middle: float = 0.5
) -> Float[Tensor, "K 3"]:
    """max(0, ½ + Σ c Y(v)) up to a degree (Kerbl et al. 2023); the direction passes no gradient.

    Coefficients above degree 0 count a twentieth, by which they learn so much slower.
    """
    x, y, z = views.detach().unbind(-1)
    constant, *higher = harmonic_polynomials(x, y, z, degree)
    basis = torch.stack([torch.full_like(x, constant), *(values / HIGHER_SLOWNESS for values in higher)], -1)
    return ((basis[..., None] * coefficients[:, : basis.shape[1]]).sum(1) + middle).clamp(min=0)


def points_at(
    camera: RasterCamera, depth: Float[Tensor, "H W"], pixels: Int[Tensor, "P"], views: Float[Tensor, "P 3"]
) -> Float[Tensor, "P 3"]:
    """World points that pixels show at their depth along +z of the camera; unit world directions are given."""
    pose = camera.world_to_camera.to(depth)
    reach = depth.flatten()[pixels] / (views @ pose[2, :3])
    return views * reach[:, None] - pose[:3, :3].T @ pose[:3, 3]


@dataclass(frozen=True)
class SurfacePixels:
    """The pixels of a view that show a surface, in world axes."""

    pixels: Int[Tensor, "P"]
    alpha: Float[Tensor, "P"]
    normals: Float[Tensor, "P 3"]
    views: Float[Tensor, "P 3"]

    @classmethod
    def of(cls, surface: Blended, camera: RasterCamera) -> "SurfacePixels":
        """Those with an alpha above `ALPHA_FLOOR`, their blended normals made unit."""
        alpha = surface.alpha.flatten()
        pixels = torch.nonzero(alpha.detach() > ALPHA_FLOOR)[:, 0]
        to_world = camera.world_to_camera[:3, :3].T.to(alpha)
        rays = unit_rays_camera(camera, alpha.device).to(alpha.dtype).flatten(1)[:, pixels]
        normals = normalize(to_world @ surface.normals_camera.flatten(1)[:, pixels], dim=0, eps=1e-8)
        return cls(pixels, alpha[pixels], normals.T, (to_world @ rays).T)

    def of_image(self, image: Float[Tensor, "C H W"]) -> Float[Tensor, "P C"]:
        """What a premultiplied image holds there, divided by alpha."""
        return (image.flatten(1)[:, self.pixels] / self.alpha).T

    def image(self, values: Float[Tensor, "P C"], like: Float[Tensor, "_ H W"]) -> Float[Tensor, "C H W"]:
        """The premultiplied image that holds values there."""
        flat = values.new_zeros(values.shape[1], like[0].numel())
        return flat.index_copy(1, self.pixels, (values * self.alpha[:, None]).T).view(-1, *like.shape[1:])


def propagated(
    surfels: ShadedSurfels, reflects: Tensor, generator: torch.Generator, disturbance: float
) -> ShadedSurfels:
    """Normal propagation and color sabotage (Ye et al. 2024).

    Opacities rise to at least 0.9; what reflects grows by half along its two longer axes; the diffuse color of the rest
    is disturbed by up to so much, so that it is not taken for good.
    """
    surfels = surfels.detached()
    grows = reflects[:, None].expand_as(surfels.log_scales).clone()
    if grows.shape[1] == 3:
        grows &= surfels.log_scales > surfels.log_scales.amin(1, keepdim=True)
    noise = torch.rand(surfels.count, 3, generator=generator).to(surfels.means) * 2 - 1
    harmonics = surfels.harmonics.clone()
    harmonics[:, 0] += disturbance * noise * ~reflects[:, None]
    return replace(
        surfels,
        opacity_logits=surfels.opacity_logits.clamp(min=logit(PROPAGATED_OPACITY)),
        log_scales=surfels.log_scales + math.log(PROPAGATION_GROWTH) * grows,
        harmonics=harmonics,
    )
