"""The rasterizer a third time, as plain Python loops over pixels and surfels: slow, obvious, and independent of torch
and Numba.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class LoopImages:
    """The six images of a rasterization, as float64 arrays."""

    colors: Float[np.ndarray, "3 H W"]
    normals_camera: Float[np.ndarray, "3 H W"]
    accumulated_depth: Float[np.ndarray, "H W"]
    alpha: Float[np.ndarray, "H W"]
    median_depth: Float[np.ndarray, "H W"]
    distortion: Float[np.ndarray, "H W"]


@dataclass(frozen=True)
class _Surfel:
    center: np.ndarray
    tangent_u: np.ndarray
    tangent_v: np.ndarray
    facing_normal: np.ndarray
    facing: float
    scale_u: float
    scale_v: float
    opacity: float
    color: np.ndarray
    curvature: np.ndarray
    pixel: np.ndarray


@dataclass(frozen=True)
class _Fragment:
    alpha: float
    depth: float
    normal: np.ndarray


def _rotate(quat, vector):
    """Rotate by q v q*, written with quaternion products rather than a matrix."""
    w, axis = quat[0], quat[1:]
    turned = 2 * np.cross(axis, vector)
    return vector + w * turned + np.cross(axis, turned)


def _place(camera, mean, quat, scale, opacity, color, curvature) -> _Surfel | None:
    matrix = camera.world_to_camera.double().numpy()
    center = matrix[:3, :3] @ mean + matrix[:3, 3]
    if not center[2] >= camera.near or not opacity >= 1 / 255:
        return None
    quat = quat / math.sqrt(quat @ quat)
    tangent_u, tangent_v, normal = (matrix[:3, :3] @ _rotate(quat, axis) for axis in np.eye(3))
    facing = -1.0 if normal @ center > 0 else 1.0
    pixel = np.array([camera.fx * center[0] / center[2] + camera.cx, camera.fy * center[1] / center[2] + camera.cy])
    return _Surfel(
        center, tangent_u, tangent_v, facing * normal, facing, scale[0], scale[1], opacity, color, curvature, pixel
    )


def _shade(surfel: _Surfel, camera, x: float, y: float) -> _Fragment:
    rho = 2 * ((x - surfel.pixel[0]) ** 2 + (y - surfel.pixel[1]) ** 2)
    depth, normal = surfel.center[2], surfel.facing_normal
    ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
    toward = surfel.facing_normal @ surfel.center
    across = surfel.facing_normal @ ray
    if abs(toward) >= 1e-4 * math.sqrt(surfel.center @ surfel.center) and across != 0:
        hit = ray * (toward / across)
        if hit[2] > 0 and surfel.center[2] / hit[2] >= 0.1:
            along_u = (hit - surfel.center) @ surfel.tangent_u
            along_v = (hit - surfel.center) @ surfel.tangent_v
            own = (along_u / surfel.scale_u) ** 2 + (along_v / surfel.scale_v) ** 2
            if own <= rho:
                a, b, c = surfel.curvature
                turn_u = a * along_u + b * along_v
                turn_v = b * along_u + c * along_v
                bent = turn_u * surfel.tangent_u + turn_v * surfel.tangent_v
                rho, depth, normal = own, hit[2], surfel.facing_normal - surfel.facing * bent
    return _Fragment(min(0.99, surfel.opacity * math.exp(-rho / 2)), depth, normal)


def rasterize_loops(means, quats, scales, opacities, colors, curvatures, camera) -> LoopImages:
    """Rasterize float64 arrays; `camera` is a `RasterCamera`."""
    curvatures = np.zeros_like(means) if curvatures is None else curvatures
    columns = zip(means, quats, scales, opacities, colors, curvatures, strict=True)
    placed = [_place(camera, *column) for column in columns]
    surfels = sorted((s for s in placed if s is not None), key=lambda s: s.center[2])
    image = (camera.height, camera.width)
    result = LoopImages(
        np.zeros((3, *image)), np.zeros((3, *image)), np.zeros(image), np.zeros(image), np.zeros(image), np.zeros(image)
    )
    for row in range(camera.height):
        for column in range(camera.width):
            transmittance = 1.0
            met: list[tuple[float, float]] = []
            for surfel in surfels:
                fragment = _shade(surfel, camera, column + 0.5, row + 0.5)
                if fragment.alpha < 1 / 255:
                    continue
                if transmittance * (1 - fragment.alpha) < 1e-4:
                    break
                weight = transmittance * fragment.alpha
                result.colors[:, row, column] += weight * surfel.color
                result.normals_camera[:, row, column] += weight * fragment.normal
                result.accumulated_depth[row, column] += weight * fragment.depth
                result.alpha[row, column] += weight
                if transmittance > 0.5:
                    result.median_depth[row, column] = fragment.depth
                m = camera.far / (camera.far - camera.near) * (1 - camera.near / fragment.depth)
                result.distortion[row, column] += sum(weight * w * (m - other) ** 2 for w, other in met)
                met.append((weight, m))
                transmittance *= 1 - fragment.alpha
    return result
