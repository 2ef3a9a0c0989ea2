"""Gradients of the records back to the surfels' parameters, sixteen surfels at a time."""

import numpy as np
from numba import njit

from panoless.kernels.cpu.compilation import INLINED_LANE_CODE, LANE_CODE
from panoless.kernels.cpu.simd import (
    LANES,
    lane_indices,
    lanes,
    where,
)
from panoless.kernels.cpu.simd_memory import (
    fetch_add,
    load_lanes,
    load_strided,
    store_lanes,
    store_strided,
    thread_slot,
)
from panoless.splats.kernels.cpu import records as rec
from panoless.splats.kernels.cpu.project import (
    GROUPS_PER_CLAIM,
    UnitQuat,
    added,
    cross,
    dot,
    load_quat,
    load_vector,
    rotate_back,
    scaled,
    store_vector,
    surfel_frame,
)


@njit(**INLINED_LANE_CODE)
def quat_gradient(q, tangent_u, tangent_v, normal):
    """From gradients of the rotation's columns (world axes) to that of the quaternion before it was normalized."""
    u0, u1, u2 = tangent_u
    v0, v1, v2 = tangent_v
    n0, n1, n2 = normal
    w = 2.0 * (q.z * u1 - q.y * u2 - q.z * v0 + q.x * v2 + q.y * n0 - q.x * n1)
    x = 2.0 * (q.y * u1 + q.z * u2 + q.y * v0 + q.w * v2 + q.z * n0 - q.w * n1) - 4.0 * q.x * (v1 + n2)
    y = 2.0 * (q.x * u1 - q.w * u2 + q.x * v0 + q.z * v2 + q.w * n0 + q.z * n1) - 4.0 * q.y * (u0 + n2)
    z = 2.0 * (q.w * u1 + q.x * u2 - q.w * v0 + q.y * v2 + q.x * n0 + q.y * n1) - 4.0 * q.z * (u0 + v1)
    radial = w * q.w + x * q.x + y * q.y + z * q.z
    s = q.inverse_norm
    return UnitQuat((w - q.w * radial) * s, (x - q.x * radial) * s, (y - q.y * radial) * s, (z - q.z * radial) * s, s)


@njit(**INLINED_LANE_CODE)
def sum_slots(slots, slot_starts, first, curved, sums, visible):
    """Add up each surfel's rows, one a tile, in a fixed order: the result does not depend on the number of threads."""
    size = slots.shape[1]
    for lane in range(LANES):
        k = first + lane
        visible[lane] = np.float32(0)
        if k + 1 >= slot_starts.size:
            continue
        low = lanes(0.0)
        high = lanes(0.0)
        for slot in range(slot_starts[k], slot_starts[k + 1]):
            low += load_lanes(slots, slot * size)
            if curved:
                high += load_lanes(slots, slot * size + size - LANES)
            visible[lane] = np.float32(1)
        store_lanes(sums, lane * size, low)
        if curved:
            store_lanes(sums, lane * size + size - LANES, high)


@njit(**INLINED_LANE_CODE)
def load_sums(sums, field, active):
    """Three consecutive columns of the summed rows; 0 where `active` fails."""
    size = sums.shape[1]
    return (
        load_strided(sums, field, size, active),
        load_strided(sums, field + 1, size, active),
        load_strided(sums, field + 2, size, active),
    )


@njit(**INLINED_LANE_CODE)
def project_group_backward(first, count, surfels, camera, curved, sums, visible, gradients):
    """Chain the summed record gradients of sixteen surfels back to their parameters."""
    means, quats, scales, opacities, _, curvatures, _ = surfels
    grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_curvatures, grad_offsets = gradients
    active = lane_indices() < np.float32(min(count - first, LANES))
    drawn = (load_lanes(visible, 0) > 0.0) & active
    quat = load_quat(quats, first, active)
    frame = surfel_frame(load_vector(means, first, active), quat, camera)
    scale_u = load_strided(scales, 2 * first, 2, active)
    scale_v = load_strided(scales, 2 * first + 1, 2, active)
    depth = frame.center[2]
    fx = camera[rec.CAMERA_FX]
    fy = camera[rec.CAMERA_FY]
    hit = where(frame.edge_on, 0.0, depth / frame.normal_dot_center)
    size = sums.shape[1]
    zero = lanes(0.0)

    slope_u = (load_strided(sums, rec.A0, size, drawn) / fx, load_strided(sums, rec.B0, size, drawn) / fy, zero)
    slope_v = (load_strided(sums, rec.A1, size, drawn) / fx, load_strided(sums, rec.B1, size, drawn) / fy, zero)
    slope_w = (load_strided(sums, rec.A2, size, drawn) / fx, load_strided(sums, rec.B2, size, drawn) / fy, zero)
    plane_u = scaled(cross(frame.tangent_v, frame.center), 1.0 / scale_u)
    plane_v = scaled(cross(frame.center, frame.tangent_u), 1.0 / scale_v)
    grad_hit = dot(slope_u, plane_u) + dot(slope_v, plane_v) + dot(slope_w, frame.normal)
    grad_toward = -grad_hit * hit / frame.normal_dot_center

    normal_gradient = scaled(load_sums(sums, rec.GRAD_NORMAL, drawn), frame.facing)
    normal_gradient = added(normal_gradient, scaled(slope_w, hit))
    normal_gradient = added(normal_gradient, scaled(frame.center, grad_toward))
    over_u = scaled(slope_u, hit / scale_u)
    over_v = scaled(slope_v, hit / scale_v)
    scale_gradient_u = -dot(over_u, plane_u)
    scale_gradient_v = -dot(over_v, plane_v)
    gradient_u = cross(over_v, frame.center)
    gradient_v = cross(frame.center, over_u)
    center_gradient = added(cross(over_u, frame.tangent_v), cross(frame.tangent_u, over_v))
    center_gradient = added(center_gradient, scaled(frame.normal, grad_toward))

    grad_x = load_strided(sums, rec.CENTER_X, size, drawn)
    grad_y = load_strided(sums, rec.CENTER_Y, size, drawn)
    step_x = grad_x * fx / depth
    step_y = grad_y * fy / depth
    along = load_strided(sums, rec.DEPTH, size, drawn) + grad_hit / frame.normal_dot_center
    along -= (step_x * frame.center[0] + step_y * frame.center[1]) / depth
    center_gradient = added(center_gradient, (step_x, step_y, along))

    if curved:
        a, b, c = load_vector(curvatures, first, active)
        turned_u = scaled(load_sums(sums, rec.GRAD_CURVED_U, drawn), -frame.facing)
        turned_v = scaled(load_sums(sums, rec.GRAD_CURVED_V, drawn), -frame.facing)
        uu = dot(turned_u, frame.tangent_u)
        uv = dot(turned_u, frame.tangent_v)
        vu = dot(turned_v, frame.tangent_u)
        vv = dot(turned_v, frame.tangent_v)
        curvature_gradient = (scale_u * uu, scale_u * uv + scale_v * vu, scale_v * vv)
        scale_gradient_u += a * uu + b * uv
        scale_gradient_v += b * vu + c * vv
        gradient_u = added(gradient_u, added(scaled(turned_u, scale_u * a), scaled(turned_v, scale_v * b)))
        gradient_v = added(gradient_v, added(scaled(turned_u, scale_u * b), scaled(turned_v, scale_v * c)))
        if grad_curvatures.size:
            store_vector(grad_curvatures, 3 * first, 3, drawn, curvature_gradient)

    store_vector(grad_means, 3 * first, 3, drawn, rotate_back(camera, center_gradient))
    rotation = quat_gradient(
        quat,
        rotate_back(camera, gradient_u),
        rotate_back(camera, gradient_v),
        rotate_back(camera, normal_gradient),
    )
    store_strided(grad_quats, 4 * first, 4, drawn, rotation.w)
    store_strided(grad_quats, 4 * first + 1, 4, drawn, rotation.x)
    store_strided(grad_quats, 4 * first + 2, 4, drawn, rotation.y)
    store_strided(grad_quats, 4 * first + 3, 4, drawn, rotation.z)
    store_strided(grad_scales, 2 * first, 2, drawn, scale_gradient_u)
    store_strided(grad_scales, 2 * first + 1, 2, drawn, scale_gradient_v)
    opacity = load_strided(opacities, first, 1, active)
    store_strided(grad_opacities, first, 1, drawn, load_strided(sums, rec.GRAD_OPACITY, size, drawn) / opacity)
    if grad_colors.size:
        color_at = rec.GRAD_COLOR_CURVED if curved else rec.GRAD_COLOR_FLAT
        store_vector(grad_colors, 3 * first, 3, drawn, load_sums(sums, color_at, drawn))
    if grad_offsets.size:
        store_strided(grad_offsets, 2 * first, 2, drawn, grad_x)
        store_strided(grad_offsets, 2 * first + 1, 2, drawn, grad_y)


@njit(**LANE_CODE)
def project_backward(counter, surfels, camera, curved, slots, slot_starts, gradients, scratch):
    """Fill the gradients of all visible surfels; those of culled surfels keep the zeros that they must come with.

    Gradients that nobody wants are empty arrays. `scratch` has LANES + 1 rows of a gradient's size for each thread.
    """
    count = slot_starts.size - 1
    rows = scratch[thread_slot(counter)]
    sums = rows[:LANES]
    visible = rows[LANES]
    while True:
        begin = fetch_add(counter, GROUPS_PER_CLAIM * LANES)
        if begin >= count:
            return
        for first in range(begin, min(begin + GROUPS_PER_CLAIM * LANES, count), LANES):
            if slot_starts[min(first + LANES, count)] > slot_starts[first]:
                sum_slots(slots, slot_starts, first, curved, sums, visible)
                project_group_backward(first, count, surfels, camera, curved, sums, visible, gradients)
