"""What a camera sees of a finished fit."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from panoless.capture.encoding import encoding_of
from panoless.capture.object_frame import ObjectFrame
from panoless.config import FitConfig
from panoless.environment.reflectance import Reflectance
from panoless.geometry.base import Geometry
from panoless.kernels.camera import RasterCamera
from panoless.kernels.constants import ALPHA_FLOOR
from panoless.splats.kernels.reference.objective import compose


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
    geometry: Geometry,
    environment: Float[Tensor, "6 3 L L"],
    camera: RasterCamera,
    frame: ObjectFrame,
    config: FitConfig,
    reflectance: Reflectance | None = None,
) -> Decomposition:
    """Render one camera with an environment as the surface shows it (radiance, not logits) in a mirror of that
    reflectance, else of the configured tint. Shading computes in sRGB where the fit did.
    """
    with torch.no_grad():
        encoding = encoding_of(config)
        environment, buffers = encoding.shown(environment), geometry.buffers(camera)
        rotation = camera.world_to_camera[:3, :3].T
        pixels = torch.nonzero(buffers.alpha.flatten() > ALPHA_FLOOR)[:, 0]
        normals_camera = buffers.normals_camera.flatten(1)[:, pixels]
        specular, normals = torch.zeros_like(buffers.albedo), torch.zeros_like(buffers.albedo)
        specular.flatten(1)[:, pixels] = geometry.shade(environment, camera, pixels, normals_camera).T
        normals.flatten(1)[:, pixels] = rotation @ normalize(normals_camera, dim=0, eps=1e-8)
        tint = specular.new_tensor(config.tint)[:, None, None]
        scattered = torch.zeros_like(specular)
        if reflectance is not None:
            tint = torch.ones_like(specular)
            tint.flatten(1)[:, pixels], scattered.flatten(1)[:, pixels] = (
                each.T for each in buffers.shown(reflectance, camera, pixels)
            )
            scattered = buffers.alpha * scattered
        radiance, albedo = compose(buffers.albedo, specular, buffers.alpha, config.splats.alpha_applied), buffers.albedo
        if encoding.srgb:
            alpha = buffers.alpha.clamp(min=ALPHA_FLOOR)
            radiance, albedo = (alpha * encoding.decoded((part / alpha).clamp(0, 1)) for part in (radiance, albedo))
            specular = (radiance - albedo) / alpha
        return Decomposition(
            radiance=tint * radiance + scattered,
            albedo=tint * albedo + scattered,
            specular=tint * specular,
            alpha=buffers.alpha,
            normals_world=normals,
            depth=buffers.depth * frame.radius * (buffers.alpha > ALPHA_FLOOR),
        )
