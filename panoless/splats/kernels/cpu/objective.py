"""The objective of a mirror as a differentiable torch operator: all terms and all gradients in a few passes.

The value and its gradients come together, in the forward pass: they share almost everything, and the loss is a scalar,
so the backward only multiplies by its cotangent. Sums are taken in an order that doesn't depend on the number of
threads.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from panoless.kernels.cpu.simd import LANES
from panoless.kernels.cpu.workers import run_shared, thread_count
from panoless.splats.kernels.cpu import consistency, mirror
from panoless.splats.kernels.cpu.buffers import take
from panoless.splats.kernels.cpu.faces import CHANNELS, collect_faces, fold_ring, ring_of, show_ring, spread_faces

f32 = np.float32
_NOTHING = np.zeros(0, f32)
LN_2 = float(np.log(2))


class Gradients(NamedTuple):
    """Gradients of the total; empty where they are not wanted."""

    normals: np.ndarray
    alpha: np.ndarray
    accumulated: np.ndarray
    median: np.ndarray
    albedo: np.ndarray
    environment: np.ndarray


class _MirrorObjective(torch.autograd.Function):
    @staticmethod
    def forward(ctx, view, terms, normals, alpha, accumulated, median, albedo, environment):
        height, width = alpha.shape
        compares = terms.lambda_normal_consistency > 0
        wanted = ctx.needs_input_grad[2:]
        geometry = any(wanted[:5])
        gradients = Gradients(
            _image(geometry, 3, height, width),
            _image(geometry, height, width),
            _image(geometry and compares, height, width),
            _image(geometry and compares and terms.depth_blend > 0, height, width),
            _image(wanted[4], 3, height, width),
            _image(wanted[5] and terms.photometric, *environment.shape),
        )
        images = mirror.Pixels(*map(_flat, (normals, alpha, albedo, view.mask, view.radiance)))
        photometric, outline = _shade(images, width, environment, view, terms, gradients, geometry)
        total, compared = photometric + terms.lambda_silhouette * outline, 0.0
        if compares:
            weight = np.ones_like(images.mask) if terms.consistency_everywhere else images.mask
            surface = consistency.Surface(images.normals, images.alpha, _flat(accumulated), _flat(median), weight)
            grid = _grid(width, height, view)
            compared = _compare(surface, grid, terms, gradients)
            total += terms.lambda_normal_consistency * compared
        found = tuple(torch.from_numpy(gradient) for gradient in gradients)
        ctx.found = tuple(g if want and g.numel() else None for g, want in zip(found, wanted, strict=True))
        parts = tuple(torch.tensor(part, dtype=torch.float64) for part in (photometric, compared, outline))
        ctx.mark_non_differentiable(*parts)
        return alpha.new_tensor(total), *parts

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, cotangent, *_):
        gradients, ctx.found = ctx.found, None
        if gradients is None:
            raise RuntimeError("the gradients of this objective were given away: call backward once.")
        if float(cotangent) != 1.0:
            gradients = tuple(None if gradient is None else gradient.mul_(cotangent) for gradient in gradients)
        return None, None, *gradients


def _shade(images, width, environment, view, terms, gradients: Gradients, geometry: bool) -> tuple[float, float]:
    """Photometric and silhouette terms; fills the gradients of normals, alpha, albedo and environment."""
    resolution, pixels = environment.shape[-1], images.alpha.size
    solid_alpha = f32(view.solid_alpha if terms.photometric else np.inf)
    padded, area, ring = (6, resolution + 2, resolution + 2), resolution**2, ring_of(resolution)
    texture = take((CHANNELS, *padded))
    flat_texture = texture.reshape(CHANNELS, -1)
    if terms.photometric:
        cubemap = environment.detach().contiguous().numpy()
        run_shared(spread_faces, cubemap, texture)
        show_ring(cubemap.reshape(-1), ring, area, flat_texture)
    numbers = mirror.ShadingNumbers(
        resolution=resolution,
        inverse_scale_squared=f32(1 / terms.robust_scale**2 if terms.robust_scale > 0 else 0),
        share=f32(1 / max(view.solid_pixels, 1)),
        silhouette_share=f32(terms.lambda_silhouette / pixels),
        solid_alpha=solid_alpha,
        sigmoid=terms.activation == "sigmoid",
        alpha_twice=terms.alpha_applied == "paper",
        geometry=geometry,
        width=width,
        focal=(f32(view.fx), f32(view.fy)),
        center=(f32(view.cx), f32(view.cy)),
    )
    kept = take((mirror.RAY_SIZE * pixels,))
    sums = take((-(-pixels // mirror.PIXELS_PER_CLAIM), LANES))
    written = mirror.PixelGradients(*(g.reshape(-1) for g in (gradients.normals, gradients.alpha, gradients.albedo)))
    rotation = view.camera_to_world_rotation.contiguous().numpy().astype(f32).reshape(-1)
    run_shared(mirror.shade_pixels, images, rotation, flat_texture, numbers, written, kept, sums)
    if gradients.environment.size:
        faces = take((*padded, 4))
        lists = take((thread_count(), LANES), np.int32)
        run_shared(mirror.scatter_rays, kept, pixels, resolution + 2, faces, lists)
        run_shared(collect_faces, faces, gradients.environment)
        fold_ring(faces.reshape(-1, 4), ring, area, gradients.environment.reshape(-1))
    photometric, bits = sums[:, : mirror.PIXEL_SUMS].sum(0, dtype=np.float64).tolist()
    return photometric, bits * LN_2 / pixels if terms.lambda_silhouette > 0 else 0.0


def _compare(surface, grid, terms, gradients: Gradients) -> float:
    """Consistency term; adds to the gradients of normals and alpha, fills those of the depths."""
    blend = f32(terms.depth_blend)
    rows = grid.height + 2 * consistency.MARGIN
    depth = take((grid.stride * rows + 2 * LANES,))
    sums = take((-(-rows // consistency.ROWS_PER_CLAIM), LANES))
    run_shared(consistency.blend_depth, surface, grid, blend, depth)
    run_shared(consistency.add_weights, surface, grid, depth, sums)
    tasks = -(-grid.height // consistency.ROWS_PER_CLAIM)
    weight = max(float(sums[:tasks, 0].sum(dtype=np.float64)), 1.0)
    written = consistency.SurfaceGradients(*(gradient.reshape(-1) for gradient in gradients[:4]))
    sent = take((2 * grid.stride * rows + 2 * LANES,)) if written.alpha.size else _NOTHING
    scale = f32(terms.lambda_normal_consistency / weight)
    run_shared(consistency.compare_normals, surface, grid, depth, scale, sent, written, sums)
    if written.alpha.size:
        run_shared(consistency.spread_to_depths, surface, grid, blend, depth, sent, written)
    return float(sums[:, 0].sum(dtype=np.float64)) / weight


def _grid(width, height, view):
    stride = width + 2 * consistency.MARGIN
    return consistency.Grid(width, height, stride, f32(view.fx), f32(view.fy), f32(view.cx), f32(view.cy))


def _image(wanted: bool, *shape: int) -> np.ndarray:
    return take(shape) if wanted else _NOTHING


def _flat(tensor: Tensor | None) -> np.ndarray:
    return _NOTHING if tensor is None else tensor.detach().contiguous().numpy().reshape(-1)


def mirror_objective_cpu(
    normals, alpha, accumulated, median, albedo, environment, view, terms
) -> tuple[Tensor, float, float, float]:
    """Total and parts for float32 tensors on the CPU; see `panoless.splats.kernels.objective.mirror_objective`."""
    images = normals, alpha, accumulated, median, albedo
    total, *parts = _MirrorObjective.apply(view, terms, *images, environment)
    photometric, compared, outline = (float(part) for part in parts)
    return total, photometric, compared, outline
