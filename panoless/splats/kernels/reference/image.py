"""Depth to normals and structural similarity, in plain torch: the definition."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

# Wang et al. 2004: an 11×11 Gaussian window of 1.5 px, and stabilizers (0.01)² and (0.03)² for a data range of 1.
SSIM_RADIUS = 5
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2


def depth_normals(depth: Float[Tensor, "H W"], fx: float, fy: float, cx: float, cy: float) -> Float[Tensor, "3 H W"]:
    """Definition of `panoless.splats.kernels.image.depth_normals`."""
    height, width = depth.shape
    normals = depth.new_zeros(3, height, width)
    if min(height, width) < 3:
        return normals
    usable = (depth > 0) & depth.isfinite()
    x = (torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5 - cx) / fx
    y = (torch.arange(height, dtype=depth.dtype, device=depth.device) + 0.5 - cy) / fy
    rays = torch.stack([x.expand(height, width), y[:, None].expand(height, width), torch.ones_like(depth)])
    points = rays * torch.where(usable, depth, 1)
    along_u = points[:, 1:-1, 2:] - points[:, 1:-1, :-2]
    along_v = points[:, 2:, 1:-1] - points[:, :-2, 1:-1]
    inner = torch.nn.functional.normalize(torch.linalg.cross(along_v, along_u, dim=0), dim=0, eps=0)
    defined = usable[1:-1, 2:] & usable[1:-1, :-2] & usable[2:, 1:-1] & usable[:-2, 1:-1]
    normals[:, 1:-1, 1:-1] = torch.where(defined, inner, 0)
    return normals


def ssim(image: Float[Tensor, "C H W"], target: Float[Tensor, "C H W"]) -> Float[Tensor, ""]:
    """Definition of `panoless.splats.kernels.image.ssim`."""
    mean_x, mean_y = _window_mean(image), _window_mean(target)
    variance_x = _window_mean(image * image) - mean_x * mean_x
    variance_y = _window_mean(target * target) - mean_y * mean_y
    covariance = _window_mean(image * target) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x * mean_x + mean_y * mean_y + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_x + variance_y + SSIM_C2)
    return (luminance * structure).mean()


def ssim_window() -> tuple[float, ...]:
    """The weights of the one-dimensional window; their sum is 1."""
    taps = [math.exp(-0.5 * (i / SSIM_SIGMA) ** 2) for i in range(-SSIM_RADIUS, SSIM_RADIUS + 1)]
    return tuple(tap / sum(taps) for tap in taps)


def _window_mean(image: Float[Tensor, "C H W"]) -> Float[Tensor, "C H W"]:
    """Gaussian-weighted mean around every pixel, the image continued by zeros."""
    window = torch.tensor(ssim_window(), dtype=image.dtype, device=image.device)
    conv2d = torch.nn.functional.conv2d
    rows = conv2d(image[:, None], window[None, None, None, :], padding=(0, SSIM_RADIUS))
    return conv2d(rows, window[None, None, :, None], padding=(SSIM_RADIUS, 0))[:, 0]
