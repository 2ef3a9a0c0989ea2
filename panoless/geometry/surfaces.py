"""Buffers of surfaces that rays are intersected with, one hit a pixel, without blending."""

import numpy as np
import torch
from jaxtyping import Float

from panoless.geometry.surfels.rendering import SurfaceBuffers
from panoless.kernels.rasterize import RasterCamera


def buffers_from_arrays(
    alpha: Float[np.ndarray, "H W"],
    depth: Float[np.ndarray, "H W"],
    normals_camera: Float[np.ndarray, "3 #H #W"],
    camera: RasterCamera,
) -> SurfaceBuffers:
    """Coverage in [0, 1], depth along the camera's axis and unit normals in camera axes, as buffers.

    Normals are multiplied by alpha, the three depths agree, albedo and distortion are zero, and `in_frustum` has one
    element: whether anything is covered. All is float32 on the device of the camera.
    """
    covered, distance, normals = (
        torch.from_numpy(np.ascontiguousarray(values)).float().to(camera.world_to_camera.device)
        for values in (alpha, depth, normals_camera)
    )
    return SurfaceBuffers(
        albedo=covered.new_zeros(3, *covered.shape),
        alpha=covered,
        raster_normals_camera=normals * covered,
        expected_depth=distance,
        median_depth=distance,
        surface_depth=distance,
        distortion=torch.zeros_like(covered),
        in_frustum=(covered > 0).any()[None],
    )
