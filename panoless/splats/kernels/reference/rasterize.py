"""The rasterizer in plain torch: every surfel against every pixel, in any float type and on any device."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from panoless.splats.kernels.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    CAMERA_PLANE_MARGIN,
    EDGE_ON_COSINE_MIN,
    HIT_RATIO_MIN,
    LOW_PASS_SIGMA,
    MEDIAN_TRANSMITTANCE,
    TRANSMITTANCE_MIN,
)

PAIRS_AT_ONCE = 1 << 22
"""Surfel–pixel pairs held in memory together; larger images are done in chunks of pixels that the backward computes
again.
"""


class Footprint(NamedTuple):
    """Surfels in camera coordinates."""

    centers: Tensor
    scaled_tangents_u: Tensor
    scaled_tangents_v: Tensor
    facing_normals: Tensor
    turns_u: Tensor
    """How the facing normal changes with u (K, 3); zero for flat surfels."""
    turns_v: Tensor
    projected: Tensor
    """Centers in the image, pixels (K, 2)."""
    offsets: Tensor
    edge_on: Tensor
    opacities: Tensor
    colors: Tensor


def rotation_matrices(quats: Tensor) -> Tensor:
    """(K, 4) quaternions wxyz of any norm to (K, 3, 3) rotations; columns are tangent_u, tangent_v and the normal."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(entries, -1).unflatten(-1, (3, 3))


def bounding_boxes(footprint: Footprint, camera) -> Tensor:
    """(K, 4) left, right, top, bottom in pixels of where alpha may reach ALPHA_MIN.

    With slopes taken against the ray to the center, the outline u² + v² = ρ lies within middle ± √(middle² −
    ρ·|lean|²/plane).
    """
    rho = 2 * torch.log(footprint.opacities / ALPHA_MIN)
    depth = footprint.centers[:, 2]
    tangents = torch.stack([footprint.scaled_tangents_u, footprint.scaled_tangents_v], -1)
    plane = rho * tangents[:, 2].square().sum(-1) - depth.square()
    bounded = plane < -CAMERA_PLANE_MARGIN * depth.square()
    radius = LOW_PASS_SIGMA * rho.sqrt()
    sides = []
    for axis, focal in ((0, camera.fx), (1, camera.fy)):
        lean = tangents[:, axis] - (footprint.centers[:, axis] / depth)[:, None] * tangents[:, 2]
        middle = rho * (lean * tangents[:, 2]).sum(-1) / plane
        half = (middle.square() - rho * lean.square().sum(-1) / plane).clamp(min=0).sqrt()
        center = footprint.projected[:, axis]
        for sign, pick in ((-1, torch.minimum), (1, torch.maximum)):
            edge = pick(center + focal * (middle + sign * half), center + sign * radius)
            sides.append(torch.where(bounded, edge, sign * torch.inf))
    return torch.stack(sides, -1)


def touches_image(boxes: Tensor, camera) -> Tensor:
    """Whether a box holds the center of a pixel."""
    left, right, top, bottom = boxes.unbind(-1)
    columns = (right - 0.5).floor().clamp(max=camera.width - 1) - (left - 0.5).ceil().clamp(min=0)
    rows = (bottom - 0.5).floor().clamp(max=camera.height - 1) - (top - 0.5).ceil().clamp(min=0)
    return (columns >= 0) & (rows >= 0)


def project(parameters: tuple[Tensor, ...], camera) -> Footprint:
    """Bring surfels, given in the order of `rasterize_reference`, to camera coordinates."""
    means, quats, scales, opacities, colors, curvatures, offsets = parameters
    world_to_camera = camera.world_to_camera.to(means)
    centers = means @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    tangents_u, tangents_v, normals = (world_to_camera[:3, :3] @ rotation_matrices(quats)).unbind(-1)
    toward = (normals * centers).sum(-1)
    facing = torch.where(toward > 0, -1.0, 1.0).to(means)[:, None]
    scaled_u = tangents_u * scales[:, :1]
    scaled_v = tangents_v * scales[:, 1:]
    a, b, c = curvatures.unbind(-1)
    turns_u = -facing * scales[:, :1] * (a[:, None] * tangents_u + b[:, None] * tangents_v)
    turns_v = -facing * scales[:, 1:] * (b[:, None] * tangents_u + c[:, None] * tangents_v)
    focal = centers.new_tensor([camera.fx, camera.fy])
    projected = centers[:, :2] / centers[:, 2:] * focal + centers.new_tensor([camera.cx, camera.cy]) + offsets
    edge_on = toward.abs() < EDGE_ON_COSINE_MIN * centers.norm(dim=-1)
    return Footprint(
        centers,
        scaled_u,
        scaled_v,
        normals * facing,
        turns_u,
        turns_v,
        projected,
        offsets,
        edge_on,
        opacities,
        colors,
    )


def sort_by_depth(footprint: Footprint) -> Footprint:
    """Nearest center first; equal depths keep their order."""
    order = torch.argsort(footprint.centers[:, 2].detach(), stable=True)
    return Footprint(*(field[order] for field in footprint))


class Hits(NamedTuple):
    """Every surfel seen through every pixel of a chunk, (P, K)."""

    u: Tensor
    v: Tensor
    depth: Tensor
    rho: Tensor


def intersect(footprint: Footprint, pixels: Tensor, camera) -> Hits:
    """Ray–surfel intersections, replaced by the center where the screen-space low pass is larger.

    The ray through a pixel is d; from z·d = center + u·U + v·V, Cramer's rule gives z, u and v over d·(U × V).
    """
    moved = pixels[:, None] - footprint.offsets
    ray_x = (moved[..., 0] - camera.cx) / camera.fx
    ray_y = (moved[..., 1] - camera.cy) / camera.fy
    rays = torch.stack([ray_x, ray_y, torch.ones_like(ray_x)], -1)
    center, tangent_u, tangent_v = footprint.centers, footprint.scaled_tangents_u, footprint.scaled_tangents_v
    plane = torch.linalg.cross(tangent_u, tangent_v)
    toward = (center * plane).sum(-1)
    across = (rays * plane).sum(-1)
    ratio = across * center[:, 2] / torch.where(footprint.edge_on, torch.ones_like(toward), toward)
    valid = ~footprint.edge_on & (ratio.detach() >= HIT_RATIO_MIN)
    divisor = torch.where(valid, across, torch.ones_like(across))
    u = (rays * torch.linalg.cross(tangent_v, center)).sum(-1) / divisor
    v = (rays * torch.linalg.cross(center, tangent_u)).sum(-1) / divisor
    low_pass = (pixels[:, None] - footprint.projected).square().sum(-1) / LOW_PASS_SIGMA**2
    by_hit = valid & (u * u + v * v <= low_pass)
    zero = torch.zeros_like(u)
    return Hits(
        torch.where(by_hit, u, zero),
        torch.where(by_hit, v, zero),
        torch.where(by_hit, toward / divisor, center[:, 2].expand_as(u)),
        torch.where(by_hit, u * u + v * v, low_pass),
    )


def blend(footprint: Footprint, pixels: Tensor, camera) -> Tensor:
    """Blend a chunk of pixels; (P, 10): color, normal, accumulated depth, alpha, median depth, distortion."""
    hits = intersect(footprint, pixels, camera)
    alpha = (footprint.opacities * torch.exp(-0.5 * hits.rho)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, -1)
    alpha = torch.where(after >= TRANSMITTANCE_MIN, alpha, torch.zeros_like(alpha))
    transmittance = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha[:, :-1]], -1), -1)
    weight = alpha * transmittance
    normal = weight @ footprint.facing_normals
    normal = normal + (weight * hits.u) @ footprint.turns_u + (weight * hits.v) @ footprint.turns_v
    m = camera.far / (camera.far - camera.near) * (1 - camera.near / hits.depth)
    m = m - m[:, :1].detach()
    total, first, second = weight.sum(-1), (weight * m).sum(-1), (weight * m * m).sum(-1)
    in_front_half = (alpha > 0) & (transmittance > MEDIAN_TRANSMITTANCE)
    ranks = torch.arange(1, alpha.shape[-1] + 1, device=alpha.device)
    last = (in_front_half * ranks).amax(-1)
    median = hits.depth.gather(-1, (last - 1).clamp(min=0)[:, None])[:, 0] * (last > 0)
    columns = [(weight * hits.depth).sum(-1), total, median, total * second - first * first]
    return torch.cat([weight @ footprint.colors, normal, torch.stack(columns, -1)], -1)


def rasterize_reference(means, quats, scales, opacities, colors, curvatures, screen_offsets, camera):
    """Rasterize by definition; see `panoless.splats.kernels.rasterize.rasterize`."""
    count = means.shape[0]
    curvatures = means.new_zeros(count, 3) if curvatures is None else curvatures
    offsets = means.new_zeros(count, 2) if screen_offsets is None else screen_offsets
    parameters = (means, quats, scales, opacities, colors, curvatures, offsets)
    with torch.no_grad():
        finite = torch.stack([(p if p.ndim == 2 else p[:, None]).isfinite().all(-1) for p in parameters]).all(0)
        world_to_camera = camera.world_to_camera.to(means)
        depth = means @ world_to_camera[2, :3] + world_to_camera[2, 3]
        drawn = finite & (depth >= camera.near) & (opacities >= ALPHA_MIN) & (scales > 0).all(-1) & (quats != 0).any(-1)
        found = drawn.nonzero()[:, 0]
        boxes = bounding_boxes(project(tuple(p[found] for p in parameters), camera), camera)
        drawn[found] = touches_image(boxes, camera)
    kept = drawn.nonzero()[:, 0]
    rows = torch.arange(camera.height, dtype=means.dtype, device=means.device) + 0.5
    columns = torch.arange(camera.width, dtype=means.dtype, device=means.device) + 0.5
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).reshape(-1, 2)
    if len(kept) == 0:
        image = means.new_zeros(10, camera.height, camera.width)
    else:
        footprint = sort_by_depth(project(tuple(p[kept] for p in parameters), camera))
        chunks = pixels.split(max(1, PAIRS_AT_ONCE // len(kept)))
        blended = [
            checkpoint(blend, footprint, chunk, camera, use_reentrant=False)
            if len(chunks) > 1
            else blend(footprint, chunk, camera)
            for chunk in chunks
        ]
        image = torch.cat(blended).T.reshape(10, camera.height, camera.width)
    return image[:3], image[3:6], image[6], image[7], image[8], image[9], drawn
