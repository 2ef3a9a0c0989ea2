"""The differentiable 2D Gaussian surfel rasterizer (Huang et al. 2024), with an optional linear normal field on each
surfel.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from panoless.kernels.backend import Backend, choose_backend
from panoless.kernels.camera import RasterCamera
from panoless.splats.kernels.constants import TILE


@dataclass(frozen=True)
class Channels:
    """Which images a caller wants beside normals and alpha. The others cost nothing and come as zeros."""

    colors: bool = True
    depth: bool = True
    """Accumulated and median depth."""
    distortion: bool = True


ALL_CHANNELS = Channels()


@dataclass(frozen=True)
class RasterBuffers:
    """Images of the surfels, zero where no surfel is. With weights w = transmittance · fragment alpha, z in camera
    coordinates:
    """

    colors: Float[Tensor, "3 H W"]
    """Σ w · color; no background is added."""
    normals_camera: Float[Tensor, "3 H W"]
    """Σ w · normal facing the camera, in camera axes, not renormalized."""
    accumulated_depth: Float[Tensor, "H W"]
    """Σ w z; divide by alpha for the expected depth."""
    alpha: Float[Tensor, "H W"]
    """Σ w = 1 − the final transmittance, in [0, 1]."""
    median_depth: Float[Tensor, "H W"]
    """z of the last fragment met while the transmittance is above ½."""
    distortion: Float[Tensor, "H W"]
    """Σ over pairs i < j of w_i w_j (m_i − m_j)² = A·M2 − M1², m = far/(far − near) · (1 − near/z) (Huang et al.
    2024, Eq. 13, squared).
    """
    in_frustum: Bool[Tensor, " K"]
    """Surfels that were not culled: finite, beyond `near`, opaque enough to be seen, with a bounding box that holds a
    pixel center.
    """


def rasterize(
    means: Float[Tensor, "K 3"],
    quats: Float[Tensor, "K 4"],
    scales: Float[Tensor, "K 2"],
    opacities: Float[Tensor, " K"],
    colors: Float[Tensor, "K 3"],
    curvatures: Float[Tensor, "K 3"] | None,
    camera: RasterCamera,
    *,
    screen_offsets: Float[Tensor, "K 2"] | None = None,
    channels: Channels = ALL_CHANNELS,
    active_tiles: Bool[Tensor, "tile_rows tile_columns"] | None = None,
    backend: Backend = "auto",
) -> RasterBuffers:
    """Blend surfels front to back, ordered by the depth of their centers (ties by index).

    A ray meets surfel i at mean + s_u u t_u + s_v v t_v (Huang et al. 2024, Eq. 10), where its alpha is min(0.99,
    o·exp(−½ min(u² + v², 2·|pixel − center|²))) (Eq. 11); below 1/255 a fragment is skipped, and a pixel is finished
    before the fragment that would bring its transmittance below 10⁻⁴. Where the low pass wins, the center's depth and
    normal are used.

    Args:
        means: Centers in world coordinates, scene units.
        quats: Rotations, wxyz, of any norm but zero; the first two columns are the tangents, their cross product is
            the normal.
        scales: Standard deviations along the tangents, scene units, positive.
        opacities: Peak alpha, in [0, 1].
        colors: Any three linear channels.
        curvatures: None for flat surfels, or the symmetric shape operator (a, b, c) in 1/scene units: the normal at
            (u, v) is n − (a s_u u + b s_v v) t_u − (b s_u u + c s_v v) t_v, then turned toward the camera as n is; it
            is not renormalized.
        camera: Where the picture is taken from.
        screen_offsets: Pixels by which each surfel's whole footprint is moved. Pass zeros that require a gradient to
            read the screen-space positional gradient that density control uses.
        channels: Images that are wanted; the others are zero and pass no gradient.
        active_tiles: Tiles of TILE×TILE pixels, from the upper left, that are wanted; None for all. In the others every
            image is zero and passes no gradient. `in_frustum` does not depend on it.
        backend: "reference" (plain torch, any float type and device), "cpu" (Numba, float32 on the CPU), "gpu"
            (Triton, float32 on a GPU) or "auto", which takes the kernels of the tensors' device for float32.

    Returns:
        The images. Gradients flow from each of them to every tensor but the camera's; surfels with a value that is not
        finite, a zero quaternion or a scale that is not positive are culled and get zero gradients.

    Raises:
        ValueError: If a shape, type or device does not fit, or the backend is unknown.
    """
    tensors = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "curvatures": curvatures,
        "screen_offsets": screen_offsets,
    }
    given = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    _check_shapes(given, camera)
    _check_tiles(active_tiles, camera)
    surfels = means, quats, scales, opacities, colors, curvatures, screen_offsets
    chosen = choose_backend(backend, **given)
    if chosen == "cpu":
        from panoless.splats.kernels.cpu.rasterize import rasterize_cpu

        images = rasterize_cpu(*surfels, camera, channels, active_tiles)
    else:
        if chosen == "gpu":
            from panoless.splats.kernels.gpu.rasterize import rasterize_gpu as implementation
        else:
            from panoless.splats.kernels.reference.rasterize import rasterize_reference as implementation
        images = _only_active(implementation(*surfels, camera), active_tiles)
    return RasterBuffers(*_only_wanted(images, channels))


def _only_wanted(images: tuple[Tensor, ...], channels: Channels) -> tuple[Tensor, ...]:
    """Zeros, which take no memory, in place of the images of the channels that are not wanted."""
    colors, normals, depth, alpha, median, distortion, in_frustum = images
    zeros = torch.zeros((), dtype=alpha.dtype, device=alpha.device).expand(alpha.shape)
    if not channels.colors:
        colors = zeros.expand(3, -1, -1)
    if not channels.depth:
        depth = median = zeros
    if not channels.distortion:
        distortion = zeros
    return colors, normals, depth, alpha, median, distortion, in_frustum


def _only_active(images: tuple[Tensor, ...], active_tiles: Tensor | None) -> tuple[Tensor, ...]:
    """Zeros in the tiles that are not active, for implementations that know no tiles."""
    if active_tiles is None:
        return images
    *planes, in_frustum = images
    height, width = planes[0].shape[-2:]
    pixels = active_tiles.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)[:height, :width]
    pixels = pixels.to(planes[0].device)
    return *(torch.where(pixels, plane, 0) for plane in planes), in_frustum


def tile_shape(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of tiles that an image has."""
    return -(-height // TILE), -(-width // TILE)


def tiles_of(pixels: Bool[Tensor, "H W"], margin_px: int = 0) -> Bool[Tensor, "tile_rows tile_columns"]:
    """The tiles that hold one of the pixels, or come within a margin of it."""
    chosen = pixels[None].float()
    if margin_px:
        chosen = max_pool2d(chosen, 2 * margin_px + 1, stride=1, padding=margin_px)
    return max_pool2d(chosen, TILE, ceil_mode=True)[0] > 0


def _check_tiles(active_tiles: Tensor | None, camera: RasterCamera) -> None:
    wanted = tile_shape(camera.height, camera.width)
    if active_tiles is not None and (tuple(active_tiles.shape) != wanted or active_tiles.dtype != torch.bool):
        raise ValueError(
            f"expected active_tiles of shape {wanted}, boolean, for {camera.height}×{camera.width} pixels; "
            f"found {tuple(active_tiles.shape)}, {active_tiles.dtype}."
        )


_WIDTHS = {"means": 3, "quats": 4, "scales": 2, "colors": 3, "curvatures": 3, "screen_offsets": 2}


def _check_shapes(tensors: dict[str, Tensor], camera: RasterCamera) -> None:
    count = tensors["opacities"].numel()
    for name, tensor in tensors.items():
        shape = (count, _WIDTHS[name]) if name in _WIDTHS else (count,)
        if tuple(tensor.shape) != shape:
            raise ValueError(f"expected {name} of shape {shape} for {count} opacities; found {tuple(tensor.shape)}.")
    if tuple(camera.world_to_camera.shape) != (4, 4):
        raise ValueError(f"expected a 4×4 world_to_camera; found {tuple(camera.world_to_camera.shape)}.")
    if camera.width < 1 or camera.height < 1 or not 0 < camera.near < camera.far:
        raise ValueError(
            "expected a camera of positive size with 0 < near < far; "
            f"found {camera.width}×{camera.height}, near {camera.near}, far {camera.far}."
        )
