"""Small sets of surfels and cameras for tests of the rasterizer."""

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.kernels.backend import Backend
from panoless.kernels.camera import RasterCamera
from panoless.splats.kernels.rasterize import RasterBuffers, rasterize

IMAGES = ("colors", "normals_camera", "accumulated_depth", "alpha", "median_depth", "distortion")


@dataclass(frozen=True)
class SurfelScene:
    """Arguments of `rasterize`, and the camera."""

    means: Float[Tensor, "K 3"]
    quats: Float[Tensor, "K 4"]
    scales: Float[Tensor, "K 2"]
    opacities: Float[Tensor, " K"]
    colors: Float[Tensor, "K 3"]
    curvatures: Float[Tensor, "K 3"] | None
    screen_offsets: Float[Tensor, "K 2"]
    camera: RasterCamera

    def parameters(self) -> dict[str, Tensor]:
        """The tensors that there are, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "camera"}
        return {name: value for name, value in values.items() if value is not None}

    def cast(self, dtype: torch.dtype) -> "SurfelScene":
        """Fresh leaves of another type that require gradients."""
        leaves = {n: p.detach().to(dtype).clone().requires_grad_() for n, p in self.parameters().items()}
        return self.replace(**leaves)

    def replace(self, **changes) -> "SurfelScene":
        """The same scene with some arguments changed."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return SurfelScene(**{**values, **changes})

    def render(self, backend: Backend, **options) -> RasterBuffers:
        """Rasterize with one backend; `options` are those of `rasterize`."""
        return rasterize(
            self.means,
            self.quats,
            self.scales,
            self.opacities,
            self.colors,
            self.curvatures,
            self.camera,
            screen_offsets=self.screen_offsets,
            backend=backend,
            **options,
        )


def straight_camera(width: int = 24, height: int = 20, focal: float = 20.0) -> RasterCamera:
    """At the origin, looking along +z, world axes as camera axes."""
    return RasterCamera(torch.eye(4, dtype=torch.float64), focal, focal * 1.1, width / 2, height / 2, width, height)


def tilted_camera(width: int = 37, height: int = 29) -> RasterCamera:
    """Off the axes, with unequal focal lengths and an image that is no multiple of a tile."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = rotation(torch.tensor([0.9, 0.2, -0.3, 0.1], dtype=torch.float64))
    matrix[:3, 3] = torch.tensor([0.1, -0.2, 3.0])
    return RasterCamera(matrix, 30.0, 33.0, width / 2 + 1.3, height / 2 - 0.7, width, height)


def rotation(quat: Float[Tensor, " 4"]) -> Float[Tensor, "3 3"]:
    """The rotation of a quaternion wxyz, as the exponential of its axis times its angle."""
    angle = 2 * torch.atan2(quat[1:].norm(), quat[0])
    x, y, z = (angle * quat[1:] / quat[1:].norm()).tolist()
    return torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=quat.dtype))


def random_scene(count: int, seed: int, curved: bool, camera: RasterCamera, size: float = 0.3) -> SurfelScene:
    """Surfels of every orientation in a ball of radius 0.8 around the origin, in float64."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    radii = 0.8 * uniform(0, 1, count, 1) ** (1 / 3)
    return SurfelScene(
        means=radii * torch.nn.functional.normalize(directions, dim=-1),
        quats=torch.randn(count, 4, generator=generator, dtype=torch.float64),
        scales=size * torch.exp(uniform(-0.7, 0.7, count, 2)),
        opacities=uniform(0.2, 1.0, count),
        colors=uniform(0, 2, count, 3),
        curvatures=uniform(-1.5, 1.5, count, 3) if curved else None,
        screen_offsets=torch.zeros(count, 2, dtype=torch.float64),
        camera=camera,
    )


def facing_surfel(camera: RasterCamera, depth: float, opacity: float, size: float = 0.5) -> SurfelScene:
    """One surfel on the optical axis of `straight_camera`, parallel to the image."""
    return SurfelScene(
        means=torch.tensor([[0.0, 0.0, depth]], dtype=torch.float64),
        quats=torch.tensor([[2.0, 0.0, 0.0, 0.0]], dtype=torch.float64),
        scales=torch.tensor([[size, size / 2]], dtype=torch.float64),
        opacities=torch.tensor([opacity], dtype=torch.float64),
        colors=torch.tensor([[0.2, 0.5, 3.0]], dtype=torch.float64),
        curvatures=None,
        screen_offsets=torch.zeros(1, 2, dtype=torch.float64),
        camera=camera,
    )


def edge_on_quat() -> Tensor:
    """Turns the normal from z to x."""
    return torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0], dtype=torch.float64)


def merged(*scenes: SurfelScene) -> SurfelScene:
    """All surfels of flat scenes, seen by the first scene's camera."""
    names = [name for name in scenes[0].parameters() if name != "curvatures"]
    joined = {name: torch.cat([scene.parameters()[name] for scene in scenes]) for name in names}
    return SurfelScene(**joined, curvatures=None, camera=scenes[0].camera)
