"""The differentiable 2D Gaussian surfel rasterizer (Huang et al. 2024), with an optional linear normal field on each surfel."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class RasterCamera:
    """A pinhole camera with OpenCV axes (+x right, +y down, +z forward); pixel (0, 0) has its center at (0.5, 0.5).

    No gradient flows to the camera: to refine a pose, transform the surfels in torch and rasterize the result.
    """

    world_to_camera: Float[Tensor, "4 4"]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float = 0.2
    """Surfels whose center is nearer than this, in scene units, are culled; also the near end of the distortion's scale."""
    far: float = 100.0
    """Far end of the distortion's scale, in scene units; nothing is culled by it."""


@dataclass(frozen=True)
class RasterBuffers:
    """Images of the surfels, zero where no surfel is. With weights w = transmittance · fragment alpha, z in camera coordinates:"""

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
    """Σ over pairs i < j of w_i w_j (m_i − m_j)² = A·M2 − M1², m = far/(far − near) · (1 − near/z) (Huang et al. 2024, Eq. 13, squared)."""
    in_frustum: Bool[Tensor, " K"]
    """Surfels that were not culled: finite, beyond `near`, opaque enough to be seen, with a bounding box that holds a pixel center."""


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
    backend: str = "auto",
) -> RasterBuffers:
    """Blend surfels front to back, ordered by the depth of their centers (ties by index).

    A ray meets surfel i at mean + s_u u t_u + s_v v t_v (Huang et al. 2024, Eq. 10), where its alpha is
    min(0.99, o·exp(−½ min(u² + v², 2·|pixel − center|²))) (Eq. 11); below 1/255 a fragment is skipped, and a pixel is finished
    before the fragment that would bring its transmittance below 10⁻⁴. Where the low pass wins, the center's depth and normal are used.

    Args:
        means: Centers in world coordinates, scene units.
        quats: Rotations, wxyz, of any norm but zero; the first two columns are the tangents, their cross product is the normal.
        scales: Standard deviations along the tangents, scene units, positive.
        opacities: Peak alpha, in [0, 1].
        colors: Any three linear channels.
        curvatures: None for flat surfels, or the symmetric shape operator (a, b, c) in 1/scene units: the normal at (u, v) is
            n − (a s_u u + b s_v v) t_u − (b s_u u + c s_v v) t_v, then turned toward the camera as n is; it is not renormalized.
        camera: Where the picture is taken from.
        screen_offsets: Pixels by which each surfel's whole footprint is moved. Pass zeros that require a gradient to read the
            screen-space positional gradient that density control uses.
        backend: "reference" (plain torch, any float type and device), "cpu" (Numba, float32 on the CPU) or "auto", which takes
            "cpu" where it applies.

    Returns:
        The images. Gradients flow from each of them to every tensor argument; surfels with a value that is not finite, a zero
        quaternion or a scale that is not positive are culled and get zero gradients.

    Raises:
        ValueError: If a shape, type or device does not fit, or the backend is unknown.
    """
    _check(means, quats, scales, opacities, colors, curvatures, screen_offsets, camera)
    native = means.device.type == "cpu" and means.dtype == torch.float32
    if backend == "reference" or (backend == "auto" and not native):
        from panoless.kernels.reference.rasterize import rasterize_reference as implementation
    elif backend in ("cpu", "auto"):
        if not native:
            raise ValueError(
                f"backend 'cpu' needs float32 tensors on the CPU, found {means.dtype} on {means.device}; use backend='reference'."
            )
        from panoless.kernels.cpu.rasterize import rasterize_cpu as implementation
    else:
        raise ValueError(f"backend must be 'auto', 'reference' or 'cpu', found {backend!r}.")
    return RasterBuffers(
        *implementation(means, quats, scales, opacities, colors, curvatures, screen_offsets, camera)
    )


def _check(means, quats, scales, opacities, colors, curvatures, screen_offsets, camera):
    count = means.shape[0] if means.ndim else 0
    expected = {
        "means": (means, (count, 3)),
        "quats": (quats, (count, 4)),
        "scales": (scales, (count, 2)),
        "opacities": (opacities, (count,)),
        "colors": (colors, (count, 3)),
        "curvatures": (curvatures, (count, 3)),
        "screen_offsets": (screen_offsets, (count, 2)),
        "camera.world_to_camera": (camera.world_to_camera, (4, 4)),
    }
    for name, (tensor, shape) in expected.items():
        if tensor is None:
            continue
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {shape}, found {tuple(tensor.shape)}; K is taken from means.")
        if tensor is not camera.world_to_camera and (tensor.dtype, tensor.device) != (means.dtype, means.device):
            raise ValueError(
                f"{name} must be {means.dtype} on {means.device} like means, found {tensor.dtype} on {tensor.device}."
            )
    if camera.width < 1 or camera.height < 1 or not 0 < camera.near < camera.far:
        raise ValueError(
            f"the camera needs a positive size and 0 < near < far, found {camera.width}×{camera.height}, "
            f"near {camera.near}, far {camera.far}."
        )
