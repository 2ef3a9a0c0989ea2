"""A mirror of revolution as views, made by the forward model that is tested: `SurfaceOfRevolution` and `mean_light`.

They test steps of a fit for themselves, on data without model error. `traced_vessel` makes independent data.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import pose_of, unit_rays_camera
from panoless.capture.views import Views
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.revolution.render import mean_light
from panoless.kernels.camera import RasterCamera
from panoless.kernels.cubemap import cubemap_directions
from tests.support.mirror_plane import camera_at, train_view
from tests.support.synthetic_dataset import environment_radiance

TILTED = np.array([0.15, -0.1, 0.98]) / np.linalg.norm([0.15, -0.1, 0.98])
AROUND = np.array([0.05, 0.02, 0.0])


def around(count: int, size: int = 96) -> list[RasterCamera]:
    """Cameras on an arc of 140° at elevations between −10° and 45°."""
    cameras = []
    for index, azimuth in enumerate(np.radians(np.linspace(-70, 70, count))):
        elevation = np.radians((-10.0, 10.0, 30.0, 45.0)[index % 4])
        across = np.cos(elevation)
        position = np.array([across * np.sin(azimuth), -across * np.cos(azimuth), np.sin(elevation)])
        cameras.append(camera_at(3.5 * position, size))
    return cameras


def goblet(half_width: float = 0.5) -> SurfaceOfRevolution:
    """A waisted body with sharp ends and a flat lid; ρ = w + 0.12 cos(4 h) for h in [−0.7, 0.6]."""
    height = np.linspace(-0.7, 0.6, 200)
    outer = np.stack([half_width + 0.12 * np.cos(4 * height), height], 1)
    profile = np.concatenate([[[0.0, -0.7]], outer, [[0.0, 0.6]]])
    return SurfaceOfRevolution(AROUND - (AROUND @ TILTED) * TILTED, TILTED, profile, len(outer))


def funnel(depth: float = 0.3) -> SurfaceOfRevolution:
    """The goblet with a conical inside."""
    body = goblet()
    inner = np.linspace(body.profile[body.lip], [0.0, 0.6 - depth], 60)
    return replace(body, profile=np.concatenate([body.profile[: body.lip], inner]))


def bowl() -> SurfaceOfRevolution:
    """A wall without thickness that flares to its lip at (0.6, 0.5); ρ = 0.3 + 0.3 ((h + 0.7)/1.2)², closed below."""
    height = np.linspace(-0.7, 0.5, 200)
    outer = np.stack([0.3 + 0.3 * ((height + 0.7) / 1.2) ** 2, height], 1)
    profile = np.concatenate([[[0.0, -0.7]], outer])
    return SurfaceOfRevolution(AROUND - (AROUND @ TILTED) * TILTED, TILTED, profile, len(outer))


def revolution_views(surface: SurfaceOfRevolution, cameras: list[RasterCamera], subpixels: int = 4) -> Views:
    """Views of a surface of revolution under the environment of the synthetic dataset, clipped to [0, 1]; one
    reflection only.
    """
    views = []
    for camera in cameras:
        fine = replace(
            camera,
            fx=camera.fx * subpixels,
            fy=camera.fy * subpixels,
            cx=camera.cx * subpixels,
            cy=camera.cy * subpixels,
            width=camera.width * subpixels,
            height=camera.height * subpixels,
        )
        met = surface.hits(*rays_of(fine)).met.reshape(camera.height, subpixels, camera.width, subpixels)
        view = train_view(camera, met.mean((1, 3)))
        origins, directions = rays_of(camera)
        hits = surface.hits(origins, directions)
        normals = hits.normals
        reflect = directions - 2 * (directions * normals).sum(1, keepdims=True) * normals
        radiance = environment_radiance(reflect).clip(0, 1) * hits.met[:, None]
        image = radiance.T.reshape(3, camera.height, camera.width)
        views.append(replace(view, radiance=torch.from_numpy(np.ascontiguousarray(image)).float()))
    return Views(tuple(views), ObjectFrame(np.zeros(3), 1.0), 0.3)


def known_environment(resolution: int = 64) -> Float[torch.Tensor, "6 3 L L"]:
    """The environment of the synthetic dataset as a cubemap, clipped to [0, 1]."""
    directions = cubemap_directions(resolution).double().numpy()
    return torch.from_numpy(environment_radiance(directions).clip(0, 1).transpose(0, 3, 1, 2).copy()).float()


def deep_views(
    surface: SurfaceOfRevolution, environment: Float[torch.Tensor, "6 3 L L"], cameras: list[RasterCamera]
) -> Views:
    """Views in which every pixel is the mean over its area, many reflections deep."""
    plain = revolution_views(surface, cameras)
    views = []
    for view in plain.train:
        pixels = torch.nonzero(view.mask.flatten() > 0)[:, 0]
        radiance = torch.zeros(3, view.mask.numel())
        radiance[:, pixels] = mean_light(surface, environment, view.camera, pixels).T * view.mask.flatten()[pixels]
        views.append(replace(view, radiance=radiance.reshape(view.radiance.shape)))
    return replace(plain, train=tuple(views))


def rays_of(camera: RasterCamera) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Origins and unit directions of the rays through all pixel centers."""
    rotation, center = pose_of(camera)
    directions = unit_rays_camera(camera).numpy().astype(np.float64).reshape(3, -1).T @ rotation
    return np.broadcast_to(center, directions.shape), directions


def pillar_views(cameras: list[RasterCamera], half_width: float = 0.4, half_height: float = 0.7) -> Views:
    """Masks of an upright square pillar: rays against three slabs."""
    sides = np.array([half_width, half_width, half_height])
    views = []
    for camera in cameras:
        origins, directions = rays_of(camera)
        nearer = (-np.sign(directions) * sides - origins) / directions
        farther = (np.sign(directions) * sides - origins) / directions
        met = nearer.max(1) < farther.min(1)
        views.append(train_view(camera, met.reshape(camera.height, camera.width).astype(np.float64)))
    return Views(tuple(views), ObjectFrame(np.zeros(3), 1.0), 0.3)
