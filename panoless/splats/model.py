"""The surfel set: its parameters and the physical quantities that they stand for."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.splats.kernels.reference.rasterize import rotation_matrices

Set = TypeVar("Set", bound="Surfels")


@dataclass(frozen=True)
class Surfels:
    """K two-dimensional Gaussian disks with a linear normal field each, in the normalized frame.

    `quats` (wxyz, any length) rotate the axes (1,0,0), (0,1,0), (0,0,1) into tangent_u, tangent_v and the normal.
    `curvatures` (a, b, c) is the shape operator of the fragment normal
    n(u, v) ∝ n₀ − (a s_u u + b s_v v) t_u − (b s_u u + c s_v v) t_v, in inverse units of that frame.
    `albedo` is unshaded diffuse radiance, not a reflectance.
    """

    means: Float[Tensor, "K 3"]
    quats: Float[Tensor, "K 4"]
    log_scales: Float[Tensor, "K D"]
    opacity_logits: Float[Tensor, "K"]
    albedo: Float[Tensor, "K 3"]
    curvatures: Float[Tensor, "K 3"]
    roughness_logits: Float[Tensor, "K"]

    @property
    def count(self) -> int:
        """Number of surfels, K."""
        return self.means.shape[0]

    @property
    def scales(self) -> Float[Tensor, "K D"]:
        """Radii s_u, s_v > 0 along the tangents; of 3D Gaussians one along the third axis, too."""
        return self.log_scales.exp()

    @property
    def normals(self) -> Float[Tensor, "K 3"]:
        """Unit world normals of flat surfels: their third axes."""
        return rotation_matrices(self.quats)[:, :, 2]

    @property
    def opacities(self) -> Float[Tensor, "K"]:
        """Opacity o in (0, 1)."""
        return torch.sigmoid(self.opacity_logits)

    def named(self) -> dict[str, Tensor]:
        """Parameters by name, in the order of the fields."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def mapped(self: Set, change: Callable[[Tensor], Tensor]) -> Set:
        """What becomes of every parameter."""
        return type(self)(**{name: change(value) for name, value in self.named().items()})

    def select(self: Set, index: Tensor) -> Set:
        """The surfels of an index or boolean mask."""
        return self.mapped(lambda value: value[index])

    def to(self: Set, device: torch.device) -> Set:
        """The same numbers on a device."""
        return self.mapped(lambda value: value.to(device))

    def detached(self: Set) -> Set:
        """The same numbers without gradients."""
        return self.mapped(torch.Tensor.detach)


@dataclass(frozen=True)
class ShadedSurfels(Surfels):
    """Surfels, or 3D Gaussians where there are three scales, with what other methods shade them by.

    What a method does not learn stays as it is. `harmonics` are coefficients of diffuse light that depends on where it
    is seen from, in the order of `shinypartial.core.harmonics`; `strength_logits` of how strongly a primitive reflects,
    or of its metalness; `base_color_logits` of its reflectance; `normal_residuals` are added to its normal where its
    front and where its back is seen; `indirect_harmonics` are of light from the object itself, by the direction that it
    comes from, with I = 0 where a method has none.
    """

    harmonics: Float[Tensor, "K B 3"]
    strength_logits: Float[Tensor, "K"]
    base_color_logits: Float[Tensor, "K 3"]
    normal_residuals: Float[Tensor, "K 2 3"]
    indirect_harmonics: Float[Tensor, "K I 3"]
