"""What a camera sees of a finished fit."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import unit_rays_camera
from panoless.config import FitConfig
from panoless.environment.cubemap import look_up
from panoless.geometry.height_field.model import HeightField, height_field_buffers
from panoless.geometry.plane.model import Plane, plane_buffers
from panoless.geometry.revolution.model import SurfaceOfRevolution, revolution_buffers
from panoless.geometry.revolution.render import mean_light
from panoless.geometry.surfels.model import Surfels
from panoless.geometry.surfels.rendering import ALPHA_FLOOR, compose, reflection_directions_world, surface_buffers
from panoless.kernels.rasterize import RasterCamera


@dataclass(frozen=True)
class Decomposition:
    """What a view is made of. Radiance and albedo are linear and premultiplied; normals are unit, world frame.

    `depth` is camera z-depth in scene units; depth and normals are zero where alpha is below 0.001.
    """

    radiance: Float[Tensor, "3 H W"]
    albedo: Float[Tensor, "3 H W"]
    specular: Float[Tensor, "3 H W"]
    alpha: Float[Tensor, "H W"]
    normals_world: Float[Tensor, "3 H W"]
    depth: Float[Tensor, "H W"]


def render(
    geometry: Surfels | Plane | HeightField | SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    camera: RasterCamera,
    object_frame: ObjectFrame,
    config: FitConfig,
) -> Decomposition:
    """Render one camera with the final environment (radiance, not logits) in a mirror of the configured tint."""
    with torch.no_grad():
        if isinstance(geometry, Plane):
            buffers = plane_buffers(geometry, camera)
        elif isinstance(geometry, HeightField):
            buffers = height_field_buffers(geometry, camera)
        elif isinstance(geometry, SurfaceOfRevolution):
            buffers = revolution_buffers(geometry, camera)
        else:
            curved, depth_blend = config.surfels.curved, config.loss.depth_blend
            buffers = surface_buffers(geometry, camera, curved=curved, depth_blend=depth_blend)
        rotation = camera.world_to_camera[:3, :3].T
        pixels = torch.nonzero(buffers.alpha.flatten() > ALPHA_FLOOR)[:, 0]
        normals_camera = buffers.raster_normals_camera.flatten(1)[:, pixels]
        if isinstance(geometry, SurfaceOfRevolution):
            light = mean_light(geometry, environment, camera, pixels)
        else:
            rays = unit_rays_camera(camera).flatten(1)[:, pixels]
            directions = reflection_directions_world(normals_camera, rays, rotation)
            light = look_up(environment, directions, "clamp")
        specular = torch.zeros_like(buffers.albedo)
        specular.flatten(1)[:, pixels] = light.T
        normals = torch.zeros_like(buffers.albedo)
        normals.flatten(1)[:, pixels] = rotation @ normalize(normals_camera, dim=0, eps=1e-8)
        tint = specular.new_tensor(config.tint)[:, None, None]
        return Decomposition(
            radiance=tint * compose(buffers.albedo, specular, buffers.alpha, config.alpha_applied),
            albedo=tint * buffers.albedo,
            specular=tint * specular,
            alpha=buffers.alpha,
            normals_world=normals,
            depth=buffers.surface_depth * object_frame.radius * (buffers.alpha > ALPHA_FLOOR),
        )
