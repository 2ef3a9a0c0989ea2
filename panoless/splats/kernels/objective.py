"""The objective of a mirror seen by one view: deferred shading against photographs, consistent normals, silhouette."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from panoless.kernels.backend import Backend, choose_backend
from panoless.kernels.cubemap import sample_cubemap
from panoless.kernels.reference import cubemap as reference_cubemap
from panoless.splats.kernels.image import depth_normals
from panoless.splats.kernels.reference import image as reference_image
from panoless.splats.kernels.reference.objective import Operators, mirror_objective_by

LARGEST_KERNEL_FACE = 1024
"""Texels along a face side up to which the Numba kernel may count texels in float32."""


@dataclass(frozen=True)
class MirrorView:
    """What one view contributes: constants, to which no gradient flows."""

    radiance: Float[Tensor, "3 H W"]
    """Target, linear and premultiplied."""
    mask: Float[Tensor, "H W"]
    camera_to_world_rotation: Float[Tensor, "3 3"]
    fx: float
    fy: float
    cx: float
    cy: float
    solid_alpha: float
    """Pixels whose mask is above this lie wholly on the object; only they are compared with the photograph."""

    @cached_property
    def solid_pixels(self) -> int:
        """How many pixels lie wholly on the object."""
        return int((self.mask > self.solid_alpha).sum())


@dataclass(frozen=True)
class ObjectiveTerms:
    """Which terms there are and how they weigh. A weight of zero leaves its term uncomputed."""

    robust_scale: float
    """s of the Geman–McClure weight (1 + ‖e‖²/s²)⁻²; zero or less lets all pixels vote."""
    photometric: bool = True
    lambda_normal_consistency: float = 0.0
    consistency_everywhere: bool = False
    """Let all pixels count in the consistency, not only the mask's."""
    lambda_silhouette: float = 0.0
    depth_blend: float = 0.5
    """λ_d of Eq. 3."""
    activation: Literal["clamp", "sigmoid"] = "clamp"
    alpha_applied: Literal["once", "paper"] = "once"


@dataclass(frozen=True)
class Objective:
    """The weighted sum, which carries the gradient, and its parts before their weights."""

    total: Float[Tensor, ""]
    photometric: float
    normal_consistency: float
    silhouette: float


def mirror_objective(
    normals_camera: Float[Tensor, "3 H W"],
    alpha: Float[Tensor, "H W"],
    accumulated_depth: Float[Tensor, "H W"],
    median_depth: Float[Tensor, "H W"],
    albedo: Float[Tensor, "3 H W"] | None,
    environment: Float[Tensor, "6 3 L L"],
    view: MirrorView,
    terms: ObjectiveTerms,
    *,
    backend: Backend = "auto",
) -> Objective:
    """Loss of the rasterized images of a mirror under an environment (paper Eqs. 3 to 8 and 12 to 14).

    total = photometric + λ_nd · consistency + λ_s · silhouette, with

    - photometric: the mean over solid pixels of w·√(‖e‖² + ε²), e = C − radiance. C = A + L·α (`once`) or (A + L)·α
      (`paper`), A the albedo (None for none) and L the environment, through its activation, in the direction
      ω = v − 2 (v·n) n (Eq. 5), v the unit ray through the pixel's center and n the normalized blended normal. The
      weight w = (1 + ‖e‖²/s²)⁻² is held constant in the gradient.
    - consistency: the mean over pixels, weighted by the mask or everywhere, of 1 − n·n_surf (Eq. 12), where alpha is
      above ½ and the surface depth D = (1 − λ_d) accumulated/alpha + λ_d median (Eq. 3) has a normal.
    - silhouette: the mean binary cross-entropy of alpha and mask over all pixels (Eq. 13).

    Images are as `rasterize` makes them: normals in camera axes and not unit, depths in scene units. Without
    consistency the depths are not read. Gradients flow from `total` to the images and to the environment. The Numba
    kernel finds them together with the value, so it can be differentiated once. A direction that is not finite sees
    nothing.

    Raises ValueError for wrong shapes, mixed dtypes or devices, or a backend that can't take these tensors.
    """
    images = {
        "normals_camera": normals_camera,
        "alpha": alpha,
        "accumulated_depth": accumulated_depth,
        "median_depth": median_depth,
        **({} if albedo is None else {"albedo": albedo}),
    }
    _check_shapes({**images, "radiance": view.radiance, "mask": view.mask}, alpha)
    chosen = choose_backend(backend, **images, environment=environment)
    arguments = normals_camera, alpha, accumulated_depth, median_depth, albedo, environment, view, terms
    if chosen == "cpu" and environment.shape[-1] <= LARGEST_KERNEL_FACE:
        from panoless.splats.kernels.cpu.objective import mirror_objective_cpu

        return Objective(*mirror_objective_cpu(*arguments))
    if chosen == "reference":
        operators = Operators(reference_cubemap.sample_cubemap, reference_image.depth_normals)
    else:
        operators = Operators(sample_cubemap, depth_normals)
    total, *parts = mirror_objective_by(operators, *arguments)
    return Objective(total, *(float(part.detach()) for part in parts))


_SINGLE = ("alpha", "accumulated_depth", "median_depth", "mask")
"""Images of one channel; the others have three."""


def _check_shapes(images: dict[str, Tensor], alpha: Tensor) -> None:
    if alpha.ndim != 2 or alpha.numel() == 0:
        raise ValueError(f"expected alpha (H, W), not empty; found {tuple(alpha.shape)}.")
    for name, image in images.items():
        shape = tuple(alpha.shape) if name in _SINGLE else (3, *alpha.shape)
        if tuple(image.shape) != shape:
            raise ValueError(f"expected {name} of shape {shape}, as alpha has it; found {tuple(image.shape)}.")
