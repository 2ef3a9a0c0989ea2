"""The objective of a mirror in plain torch: the definition, equation by equation."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, normalize

from panoless.kernels.camera import reflection_directions_world, unit_rays
from panoless.kernels.constants import ALPHA_FLOOR, SHORTEST_NORMAL
from panoless.splats.kernels.constants import ALPHA_MARGIN, CHARBONNIER, SURFACE_ALPHA


class Operators(NamedTuple):
    """The two operators that the objective is made of: their definitions, or kernels of another device."""

    sample_cubemap: Callable[..., Tensor]
    depth_normals: Callable[..., Tensor]


def mirror_objective_by(
    operators: Operators, normals_camera, alpha, accumulated_depth, median_depth, albedo, environment, view, terms
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Definition of `panoless.splats.kernels.objective.mirror_objective`: the sum and its three parts."""
    photometric = _photometric(operators, normals_camera, alpha, albedo, environment, view, terms)
    total, consistency, outline = photometric, photometric.new_zeros(()), photometric.new_zeros(())
    if terms.lambda_normal_consistency > 0:
        depth = surface_depth(accumulated_depth, median_depth, alpha, terms.depth_blend)
        from_depth = operators.depth_normals(depth, view.fx, view.fy, view.cx, view.cy)
        weight = torch.ones_like(view.mask) if terms.consistency_everywhere else view.mask
        consistency = normal_consistency(normals_camera, alpha, from_depth, weight)
        total = total + terms.lambda_normal_consistency * consistency
    if terms.lambda_silhouette > 0:
        outline = silhouette(alpha, view.mask)
        total = total + terms.lambda_silhouette * outline
    return total, photometric, consistency, outline


def _photometric(operators, normals_camera, alpha, albedo, environment, view, terms) -> Tensor:
    if not terms.photometric:
        return alpha.new_zeros(())
    pixels = torch.nonzero(view.mask.flatten() > view.solid_alpha)[:, 0]
    flat_alpha = alpha.flatten()[pixels]
    rays = unit_rays(tuple(alpha.shape), (view.fx, view.fy), (view.cx, view.cy), alpha.dtype, alpha.device)
    directions = reflection_directions_world(
        normals_camera.flatten(1)[:, pixels], rays.flatten(1)[:, pixels], view.camera_to_world_rotation
    )
    specular = operators.sample_cubemap(environment, directions).T
    if terms.activation == "sigmoid":
        specular = torch.sigmoid(specular)
    diffuse = torch.zeros_like(specular) if albedo is None else albedo.flatten(1)[:, pixels]
    color = compose(diffuse, specular, flat_alpha, terms.alpha_applied)
    target = view.radiance.flatten(1)[:, pixels]
    return photometric_masked(color.T, target.T, terms.robust_scale)


def surface_depth(
    accumulated_depth: Float[Tensor, "H W"],
    median_depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    depth_blend: float,
) -> Float[Tensor, "H W"]:
    """D_surf = (1 − λ_d) D_exp + λ_d D_med (Eq. 3), with the expected depth D_exp = accumulated depth over alpha."""
    expected = accumulated_depth / alpha.clamp(min=ALPHA_FLOOR)
    return expected if depth_blend == 0.0 else (1 - depth_blend) * expected + depth_blend * median_depth


def compose(
    albedo: Float[Tensor, "3 *S"], specular: Float[Tensor, "3 *S"], alpha: Float[Tensor, "*S"], alpha_applied: str
) -> Float[Tensor, "3 *S"]:
    """C = A + L_env (Eq. 8) under the matte α, without the background term (1 − α) b.

    `paper`: (A + L)·α as Eq. 10 is written, although the blended A holds α already; `once`: A + L·α.
    """
    if alpha_applied == "paper":
        return (albedo + specular) * alpha
    return albedo + specular * alpha


def photometric_masked(
    color: Float[Tensor, "P 3"], target: Float[Tensor, "P 3"], robust_scale: float
) -> Float[Tensor, ""]:
    """Weighted mean over pixels of √(‖e‖² + ε²), ε = 0.01: quadratic near zero, linear beyond.

    With `robust_scale` s > 0 each pixel weighs (1 + ‖e‖²/s²)⁻² (Geman–McClure, held constant in the gradient), so
    that pixels which see the object itself instead of the environment lose their vote. Zero when there is no pixel.
    """
    squared = (color - target).square().sum(1)
    distance = torch.sqrt(squared + CHARBONNIER**2)
    if robust_scale <= 0:
        return distance.sum() / max(len(color), 1)
    weight = (1 + squared.detach() / robust_scale**2) ** -2
    return (weight * distance).sum() / max(len(color), 1)


def silhouette(alpha: Float[Tensor, "H W"], mask: Float[Tensor, "H W"]) -> Float[Tensor, ""]:
    """Binary cross-entropy between accumulated opacity and mask (Eq. 13)."""
    return binary_cross_entropy(alpha.clamp(ALPHA_MARGIN, 1 - ALPHA_MARGIN), mask)


def normal_consistency(
    raster_normals_camera: Float[Tensor, "3 H W"],
    alpha: Float[Tensor, "H W"],
    from_depth: Float[Tensor, "3 H W"],
    weight: Float[Tensor, "H W"],
) -> Float[Tensor, ""]:
    """Weighted mean of 1 − N·n_surf (Eq. 12); both normals in the camera frame, which changes nothing.

    `weight` chooses pixels, e.g. the mask; pixels without a depth normal (the border, holes) don't count.
    """
    raster = normalize(raster_normals_camera, dim=0, eps=SHORTEST_NORMAL)
    valid = weight * (alpha.detach() > SURFACE_ALPHA) * (from_depth.detach() != 0).any(0)
    return ((1 - (raster * from_depth).sum(0)) * valid).sum() / valid.sum().clamp(min=1)
