"""Gradients of the records back to the surfels' parameters."""

import triton
import triton.language as tl

from panoless.splats.kernels.gpu.project import load_quat, surfel_frame
from panoless.splats.kernels.gpu.records import (
    A0,
    A1,
    A2,
    B0,
    B1,
    B2,
    CENTER_X,
    CENTER_Y,
    DEPTH,
    GRAD_COLOR,
    GRAD_CURVED_U,
    GRAD_CURVED_V,
    GRAD_NORMAL,
    GRAD_OPACITY,
    GRADIENT_SIZE,
)
from panoless.splats.kernels.gpu.vectors import (
    added,
    cross,
    dot,
    load_rotation,
    load_vector,
    rotate_back,
    scaled,
    store_vector,
)


@triton.jit
def quat_gradient(quat, u, v, n):
    """From gradients of the rotation's columns (world axes) to that of the quaternion before it was normalized."""
    qw, qx, qy, qz, inverse_norm = quat[0], quat[1], quat[2], quat[3], quat[4]
    w = 2.0 * (qz * u[1] - qy * u[2] - qz * v[0] + qx * v[2] + qy * n[0] - qx * n[1])
    x = 2.0 * (qy * u[1] + qz * u[2] + qy * v[0] + qw * v[2] + qz * n[0] - qw * n[1]) - 4.0 * qx * (v[1] + n[2])
    y = 2.0 * (qx * u[1] - qw * u[2] + qx * v[0] + qz * v[2] + qw * n[0] + qz * n[1]) - 4.0 * qy * (u[0] + n[2])
    z = 2.0 * (qw * u[1] + qx * u[2] - qw * v[0] + qy * v[2] + qx * n[0] + qy * n[1]) - 4.0 * qz * (u[0] + v[1])
    radial = w * qw + x * qx + y * qy + z * qz
    return (
        (w - qw * radial) * inverse_norm,
        (x - qx * radial) * inverse_norm,
        (y - qy * radial) * inverse_norm,
        (z - qz * radial) * inverse_norm,
    )


@triton.jit(do_not_specialize=["count"])
def project_backward(
    means,
    quats,
    scales,
    opacities,
    curvatures,
    world_to_camera,
    candidates,
    sums,
    grad_means,
    grad_quats,
    grad_scales,
    grad_opacities,
    grad_colors,
    grad_curvatures,
    grad_offsets,
    count,
    fx,
    fy,
    CURVED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write the gradients of drawn surfels; those of culled ones keep the zeros that they must come with."""
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = k < count
    drawn = active & (tl.load(candidates + k, mask=active, other=0) > 0)
    quat = load_quat(quats, k, drawn)
    frame = surfel_frame(load_vector(means + 3 * k, drawn), quat, world_to_camera)
    center, tangent_u, tangent_v, normal = frame.center, frame.tangent_u, frame.tangent_v, frame.normal
    facing, toward = frame.facing, frame.toward
    rows = load_rotation(world_to_camera)
    scale_u = tl.load(scales + 2 * k, mask=drawn, other=1.0)
    scale_v = tl.load(scales + 2 * k + 1, mask=drawn, other=1.0)
    depth = center[2]
    hit = tl.where(frame.edge_on, 0.0, depth / toward)
    row = sums + k * GRADIENT_SIZE
    zero = tl.zeros([BLOCK], tl.float32)

    slope_u = (
        tl.load(row + A0, mask=drawn, other=0.0) / fx,
        tl.load(row + B0, mask=drawn, other=0.0) / fy,
        zero,
    )
    slope_v = (
        tl.load(row + A1, mask=drawn, other=0.0) / fx,
        tl.load(row + B1, mask=drawn, other=0.0) / fy,
        zero,
    )
    slope_w = (
        tl.load(row + A2, mask=drawn, other=0.0) / fx,
        tl.load(row + B2, mask=drawn, other=0.0) / fy,
        zero,
    )
    plane_u = scaled(cross(tangent_v, center), 1.0 / scale_u)
    plane_v = scaled(cross(center, tangent_u), 1.0 / scale_v)
    grad_hit = dot(slope_u, plane_u) + dot(slope_v, plane_v) + dot(slope_w, normal)
    grad_toward = -grad_hit * hit / toward

    normal_gradient = scaled(load_vector(row + GRAD_NORMAL, drawn), facing)
    normal_gradient = added(normal_gradient, scaled(slope_w, hit))
    normal_gradient = added(normal_gradient, scaled(center, grad_toward))
    over_u = scaled(slope_u, hit / scale_u)
    over_v = scaled(slope_v, hit / scale_v)
    scale_gradient_u = -dot(over_u, plane_u)
    scale_gradient_v = -dot(over_v, plane_v)
    gradient_u = cross(over_v, center)
    gradient_v = cross(center, over_u)
    center_gradient = added(cross(over_u, tangent_v), cross(tangent_u, over_v))
    center_gradient = added(center_gradient, scaled(normal, grad_toward))

    grad_x = tl.load(row + CENTER_X, mask=drawn, other=0.0)
    grad_y = tl.load(row + CENTER_Y, mask=drawn, other=0.0)
    step_x = grad_x * fx / depth
    step_y = grad_y * fy / depth
    along = tl.load(row + DEPTH, mask=drawn, other=0.0) + grad_hit / toward
    along -= (step_x * center[0] + step_y * center[1]) / depth
    center_gradient = added(center_gradient, (step_x, step_y, along))

    if CURVED:
        a, b, c = load_vector(curvatures + 3 * k, drawn)
        turned_u = scaled(load_vector(row + GRAD_CURVED_U, drawn), -facing)
        turned_v = scaled(load_vector(row + GRAD_CURVED_V, drawn), -facing)
        uu, uv = dot(turned_u, tangent_u), dot(turned_u, tangent_v)
        vu, vv = dot(turned_v, tangent_u), dot(turned_v, tangent_v)
        scale_gradient_u += a * uu + b * uv
        scale_gradient_v += b * vu + c * vv
        gradient_u = added(gradient_u, added(scaled(turned_u, scale_u * a), scaled(turned_v, scale_v * b)))
        gradient_v = added(gradient_v, added(scaled(turned_u, scale_u * b), scaled(turned_v, scale_v * c)))
        curvature_gradient = (scale_u * uu, scale_u * uv + scale_v * vu, scale_v * vv)
        store_vector(grad_curvatures + 3 * k, drawn, curvature_gradient)

    store_vector(grad_means + 3 * k, drawn, rotate_back(rows, center_gradient))
    rotation = quat_gradient(
        quat, rotate_back(rows, gradient_u), rotate_back(rows, gradient_v), rotate_back(rows, normal_gradient)
    )
    tl.store(grad_quats + 4 * k, rotation[0], mask=drawn)
    tl.store(grad_quats + 4 * k + 1, rotation[1], mask=drawn)
    tl.store(grad_quats + 4 * k + 2, rotation[2], mask=drawn)
    tl.store(grad_quats + 4 * k + 3, rotation[3], mask=drawn)
    tl.store(grad_scales + 2 * k, scale_gradient_u, mask=drawn)
    tl.store(grad_scales + 2 * k + 1, scale_gradient_v, mask=drawn)
    opacity = tl.load(opacities + k, mask=drawn, other=1.0)
    tl.store(grad_opacities + k, tl.load(row + GRAD_OPACITY, mask=drawn, other=0.0) / opacity, mask=drawn)
    store_vector(grad_colors + 3 * k, drawn, load_vector(row + GRAD_COLOR, drawn))
    tl.store(grad_offsets + 2 * k, grad_x, mask=drawn)
    tl.store(grad_offsets + 2 * k + 1, grad_y, mask=drawn)
