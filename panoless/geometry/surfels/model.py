"""The surfel set: its parameters and the physical quantities that they stand for."""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Surfels:
    """K two-dimensional Gaussian disks with a linear normal field each, in the normalized frame.

    `quats` (wxyz, any length) rotate the axes (1,0,0), (0,1,0), (0,0,1) into tangent_u, tangent_v and the normal.
    `curvatures` (a, b, c) is the shape operator of the fragment normal
    n(u, v) ∝ n₀ − (a s_u u + b s_v v) t_u − (b s_u u + c s_v v) t_v, in inverse scene units.
    `albedo` is unshaded diffuse radiance, not a reflectance.
    """

    means: Float[Tensor, "K 3"]
    quats: Float[Tensor, "K 4"]
    log_scales: Float[Tensor, "K 2"]
    opacity_logits: Float[Tensor, "K"]
    albedo: Float[Tensor, "K 3"]
    curvatures: Float[Tensor, "K 3"]
    roughness_logits: Float[Tensor, "K"]

    @property
    def count(self) -> int:
        """Number of surfels, K."""
        return self.means.shape[0]

    @property
    def scales(self) -> Float[Tensor, "K 2"]:
        """Radii s_u, s_v > 0 along the tangents."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, "K"]:
        """Opacity o in (0, 1)."""
        return torch.sigmoid(self.opacity_logits)

    def named(self) -> dict[str, Tensor]:
        """Parameters by name, in the order of the fields."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def select(self, index: Tensor) -> "Surfels":
        """The surfels of an index or boolean mask."""
        return Surfels(**{name: value[index] for name, value in self.named().items()})

    def to(self, device: torch.device) -> "Surfels":
        """The same numbers on a device."""
        return Surfels(**{name: value.to(device) for name, value in self.named().items()})

    def detached(self) -> "Surfels":
        """The same numbers without gradients."""
        return Surfels(**{name: value.detach() for name, value in self.named().items()})
