"""3D Gaussians as splats in plain torch: every splat against every pixel, in any float type and on any device."""

import torch
from torch import Tensor

from panoless.splats.kernels.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    SPLAT_DILATION,
    SPLAT_TANGENT_SHARE,
    TRANSMITTANCE_MIN,
)
from panoless.splats.kernels.reference.rasterize import rotation_matrices


def project_gaussians(means, quats, scales, camera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Definition of `project_gaussians`; what is not drawn is replaced by a unit splat."""
    pose = camera.world_to_camera.to(means)
    points = means @ pose[:3, :3].T + pose[:3, 3]
    with torch.no_grad():
        finite = torch.stack([each.isfinite().all(1) for each in (means, quats, scales)]).all(0)
        drawn = finite & (points[:, 2] >= camera.near) & (scales > 0).all(1) & (quats != 0).any(1)
    keep = drawn[:, None]
    points = torch.where(keep, points, points.new_tensor([0.0, 0.0, 1.0]))
    quats = torch.where(keep, quats, quats.new_tensor([1.0, 0.0, 0.0, 0.0]))
    axes = pose[:3, :3] @ rotation_matrices(quats) * torch.where(keep, scales, 1.0)[:, None, :]
    x, y, z = points.unbind(1)
    rows = []
    for along, focal, center, extent in (
        (x, camera.fx, camera.cx, camera.width),
        (y, camera.fy, camera.cy, camera.height),
    ):
        middle, half = (extent / 2 - center) / focal, SPLAT_TANGENT_SHARE * extent / 2 / focal
        tangent = (along / z).clamp(middle - half, middle + half)
        side = axes[:, 0] if along is x else axes[:, 1]
        rows.append((side - tangent[:, None] * axes[:, 2]) * (focal / z)[:, None])
    (u, v) = rows
    xx, xy, yy = (u * u).sum(1) + SPLAT_DILATION, (u * v).sum(1), (v * v).sum(1) + SPLAT_DILATION
    determinant = xx * yy - xy * xy
    precisions = torch.stack([yy, -xy, xx], 1) / determinant[:, None]
    centers = torch.stack([x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy], 1)
    return centers, precisions, z, drawn


def blend_splats(centers, precisions, opacities, attributes, depths, drawn, height, width) -> tuple[Tensor, Tensor]:
    """Definition of `panoless.splats.kernels.splats.blend_splats`."""
    kept = drawn.nonzero()[:, 0]
    order = kept[torch.argsort(depths[kept], stable=True)]
    rows, columns = (torch.arange(size, dtype=centers.dtype, device=centers.device) + 0.5 for size in (height, width))
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).reshape(-1, 1, 2)
    dx, dy = (pixels - centers[order]).unbind(-1)
    xx, xy, yy = precisions[order].unbind(-1)
    gaussian = torch.exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy))
    alpha = (opacities[order] * gaussian).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
    after = torch.cumprod(1 - alpha, -1)
    alpha = torch.where(after >= TRANSMITTANCE_MIN, alpha, 0)
    before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], -1), -1)[:, :-1]
    weight = alpha * before
    channels = (weight @ attributes[order]).T.reshape(-1, height, width)
    return channels, weight.sum(-1).reshape(height, width)


def tile_boxes(centers, precisions, opacities, drawn, height, width) -> Tensor:
    """(K, 4) int32 first and last column, first and last row of pixels whose alpha may reach ALPHA_MIN; where there is
    none, or the splat is not drawn, the last column is before the first.
    """
    xx, xy, yy = precisions.unbind(1)
    rho = 2 * torch.log(opacities.clamp(min=ALPHA_MIN) / ALPHA_MIN)
    determinant = (xx * yy - xy * xy).clamp(min=1e-20)
    reach = torch.sqrt(rho[:, None] * torch.stack([yy, xx], 1) / determinant[:, None])
    size = centers.new_tensor([width, height])
    first = (centers - reach - 0.5).ceil().clamp(min=0).minimum(size)
    last = (centers + reach - 0.5).floor().clamp(min=-1).minimum(size - 1)
    visible = drawn & (last >= first).all(1)
    first = torch.where(visible[:, None], first, 1).nan_to_num(1)
    last = torch.where(visible[:, None], last, 0).nan_to_num(0)
    return torch.stack([first[:, 0], last[:, 0], first[:, 1], last[:, 1]], 1).to(torch.int32)
