"""Surfels to records and back, sixteen surfels at a time: the part of the rasterizer that does not depend on pixels."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from panoless.kernels.cpu.compilation import INLINED_LANE_CODE, LANE_CODE
from panoless.kernels.cpu.simd import (
    LANES,
    absolute,
    float_bits,
    lane_indices,
    log2,
    mask_bits,
    maximum,
    minimum,
    square_root,
    where,
)
from panoless.kernels.cpu.simd_memory import fetch_add, load_strided, store_lanes, store_strided, thread_slot
from panoless.splats.kernels.constants import ALPHA_MIN, CAMERA_PLANE_MARGIN, EDGE_ON_COSINE_MIN
from panoless.splats.kernels.cpu import records as rec

GROUPS_PER_CLAIM = 16
THIN_ELLIPSE = np.float32(1e-4)
ELLIPSE_SLACK = np.float32(0.98)
LOG2_INVERSE_ALPHA_MIN = np.float32(np.log2(1 / ALPHA_MIN))
TWO_LN_2 = np.float32(2 * np.log(2))
INFINITY = np.float32(np.inf)
NO_BOUND = np.float32(1e9)


class Frame(NamedTuple):
    """Sixteen surfels in camera coordinates; vectors are triples of lanes."""

    center: Any
    tangent_u: Any
    tangent_v: Any
    normal: Any
    """tangent_u × tangent_v, whichever way it faces."""
    facing: Any
    """±1, the sign that turns the normal toward the camera."""
    normal_dot_center: Any
    edge_on: Any


class UnitQuat(NamedTuple):
    """Sixteen normalized quaternions and the inverse of the norms they had."""

    w: Any
    x: Any
    y: Any
    z: Any
    inverse_norm: Any


@njit(**INLINED_LANE_CODE)
def cross(a, b):
    """Vector product of two triples."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@njit(**INLINED_LANE_CODE)
def dot(a, b):
    """Scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(**INLINED_LANE_CODE)
def scaled(a, s):
    """A triple times a scalar or lanes."""
    return (a[0] * s, a[1] * s, a[2] * s)


@njit(**INLINED_LANE_CODE)
def added(a, b):
    """Sum of two triples."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@njit(**INLINED_LANE_CODE)
def rotate(camera, a):
    """World to camera, directions."""
    return (
        camera[0] * a[0] + camera[1] * a[1] + camera[2] * a[2],
        camera[3] * a[0] + camera[4] * a[1] + camera[5] * a[2],
        camera[6] * a[0] + camera[7] * a[1] + camera[8] * a[2],
    )


@njit(**INLINED_LANE_CODE)
def rotate_back(camera, a):
    """Camera to world, directions; also the adjoint of `rotate`."""
    return (
        camera[0] * a[0] + camera[3] * a[1] + camera[6] * a[2],
        camera[1] * a[0] + camera[4] * a[1] + camera[7] * a[2],
        camera[2] * a[0] + camera[5] * a[1] + camera[8] * a[2],
    )


@njit(**INLINED_LANE_CODE)
def load_vector(array, first, active):
    """Rows first … first + 15 of a (K, 3) array."""
    start = 3 * first
    return (
        load_strided(array, start, 3, active),
        load_strided(array, start + 1, 3, active),
        load_strided(array, start + 2, 3, active),
    )


@njit(**INLINED_LANE_CODE)
def store_vector(array, start, stride, active, vector):
    """Store a triple of lanes in three consecutive columns of a table."""
    store_strided(array, start, stride, active, vector[0])
    store_strided(array, start + 1, stride, active, vector[1])
    store_strided(array, start + 2, stride, active, vector[2])


@njit(**INLINED_LANE_CODE)
def load_quat(quats, first, active):
    """Rows first … first + 15 of a (K, 4) array, normalized."""
    w = load_strided(quats, 4 * first, 4, active)
    x = load_strided(quats, 4 * first + 1, 4, active)
    y = load_strided(quats, 4 * first + 2, 4, active)
    z = load_strided(quats, 4 * first + 3, 4, active)
    inverse_norm = 1.0 / square_root(w * w + x * x + y * y + z * z)
    return UnitQuat(w * inverse_norm, x * inverse_norm, y * inverse_norm, z * inverse_norm, inverse_norm)


@njit(**INLINED_LANE_CODE)
def surfel_frame(mean, q, camera):
    """Bring sixteen surfels to camera coordinates; the tangents and the normal are the columns of the rotation."""
    tangent_u = (1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y + q.w * q.z), 2.0 * (q.x * q.z - q.w * q.y))
    tangent_v = (2.0 * (q.x * q.y - q.w * q.z), 1.0 - 2.0 * (q.x * q.x + q.z * q.z), 2.0 * (q.y * q.z + q.w * q.x))
    normal = (2.0 * (q.x * q.z + q.w * q.y), 2.0 * (q.y * q.z - q.w * q.x), 1.0 - 2.0 * (q.x * q.x + q.y * q.y))
    center = rotate(camera, mean)
    center = (
        center[0] + camera[rec.CAMERA_TRANSLATION],
        center[1] + camera[rec.CAMERA_TRANSLATION + 1],
        center[2] + camera[rec.CAMERA_TRANSLATION + 2],
    )
    normal = rotate(camera, normal)
    toward = dot(normal, center)
    edge_on = absolute(toward) < EDGE_ON_COSINE_MIN * square_root(dot(center, center))
    return Frame(
        center,
        rotate(camera, tangent_u),
        rotate(camera, tangent_v),
        normal,
        where(toward > 0.0, -1.0, 1.0),
        where(edge_on, 1.0, toward),
        edge_on,
    )


class Extent(NamedTuple):
    """Where u² + v² ≤ rho lies along one image axis, in units of the focal length, relative to the projected center."""

    middle: Any
    half_squared: Any
    lean_u: Any
    lean_v: Any


@njit(**INLINED_LANE_CODE)
def extent_along(axis, center, scaled_u, scaled_v, rho, inverse_plane):
    """The surfel's outline along one axis: the tangents' slopes against the viewing ray keep the formula free of
    cancellation.
    """
    slope = center[axis] / center[2]
    lean_u = scaled_u[axis] - slope * scaled_u[2]
    lean_v = scaled_v[axis] - slope * scaled_v[2]
    middle = rho * (lean_u * scaled_u[2] + lean_v * scaled_v[2]) * inverse_plane
    half_squared = middle * middle - rho * (lean_u * lean_u + lean_v * lean_v) * inverse_plane
    return Extent(middle, half_squared, lean_u, lean_v)


@njit(**INLINED_LANE_CODE)
def store_field(table, first, field, active, value):
    """Store one field of sixteen consecutive records."""
    store_strided(table, first * rec.RECORD_SIZE + field, rec.RECORD_SIZE, active, value)


@njit(**INLINED_LANE_CODE)
def store_outline(table, boxes, first, active, camera, center_xy, frame, scaled_u, scaled_v, rho):
    """Store the culling ellipse in the record and the exact bounding box, in pixels, in `boxes`."""
    fx = camera[rec.CAMERA_FX]
    fy = camera[rec.CAMERA_FY]
    depth = frame.center[2]
    plane = rho * (scaled_u[2] * scaled_u[2] + scaled_v[2] * scaled_v[2]) - depth * depth
    bounded = plane < -CAMERA_PLANE_MARGIN * depth * depth
    inverse_plane = 1.0 / where(bounded, plane, -1.0)
    along_x = extent_along(0, frame.center, scaled_u, scaled_v, rho, inverse_plane)
    along_y = extent_along(1, frame.center, scaled_u, scaled_v, rho, inverse_plane)
    ellipse_x = center_xy[0] + along_x.middle * fx
    ellipse_y = center_xy[1] + along_y.middle * fy
    xx = along_x.half_squared * (fx * fx)
    yy = along_y.half_squared * (fy * fy)
    xy = along_x.middle * along_y.middle
    xy -= rho * (along_x.lean_u * along_y.lean_u + along_x.lean_v * along_y.lean_v) * inverse_plane
    xy *= fx * fy
    determinant = xx * yy - xy * xy
    thin = ~(determinant > THIN_ELLIPSE * xx * yy)
    inverse = ELLIPSE_SLACK / where(thin, 1.0, determinant)
    outlined = bounded & ~frame.edge_on
    form_xx = where(outlined, where(thin, 0.5 / maximum(xx, 1e-6), yy * inverse), 0.0)
    form_yy = where(outlined, where(thin, 0.5 / maximum(yy, 1e-6), xx * inverse), 0.0)
    form_xy = where(outlined & ~thin, -xy * inverse, 0.0)
    store_field(table, first, rec.ELLIPSE_X, active, ellipse_x)
    store_field(table, first, rec.ELLIPSE_Y, active, ellipse_y)
    store_field(table, first, rec.FORM_XX, active, form_xx)
    store_field(table, first, rec.FORM_XY, active, form_xy)
    store_field(table, first, rec.FORM_YY, active, form_yy)
    store_field(table, first, rec.SLOPE_X, active, -form_xy / where(outlined, form_xx, 1.0))
    store_field(table, first, rec.SLOPE_Y, active, -form_xy / where(outlined, form_yy, 1.0))
    disk = square_root(0.5 * rho)
    half_x = square_root(xx)
    half_y = square_root(yy)
    unbounded = ~bounded
    box_left = where(unbounded, -NO_BOUND, minimum(ellipse_x - half_x, center_xy[0] - disk))
    box_right = where(unbounded, NO_BOUND, maximum(ellipse_x + half_x, center_xy[0] + disk))
    box_top = where(unbounded, -NO_BOUND, minimum(ellipse_y - half_y, center_xy[1] - disk))
    box_bottom = where(unbounded, NO_BOUND, maximum(ellipse_y + half_y, center_xy[1] + disk))
    store_lanes(boxes, 0, box_left)
    store_lanes(boxes, LANES, box_right)
    store_lanes(boxes, 2 * LANES, box_top)
    store_lanes(boxes, 3 * LANES, box_bottom)


@njit(**INLINED_LANE_CODE)
def first_pixel(edge):
    """The first pixel whose center is not left of `edge`."""
    return np.int64(np.ceil(max(edge, np.float32(-1e6)) - np.float32(0.5)))


@njit(**INLINED_LANE_CODE)
def last_pixel(edge):
    """The last pixel whose center is not right of `edge`."""
    return np.int64(np.floor(min(edge, np.float32(1e6)) - np.float32(0.5)))


@njit(**INLINED_LANE_CODE)
def store_tiles(keys, tile_ranges, first, drawn_bits, boxes, depths, width, height):
    """Scalar end of the projection: pixels that the box covers, tiles that they lie in, and the sorting key."""
    for lane in range(LANES):
        k = first + lane
        if k >= keys.size:
            break
        keys[k] = rec.CULLED
        if (drawn_bits >> lane) & 1:
            left = max(first_pixel(boxes[0, lane]), 0)
            right = min(last_pixel(boxes[1, lane]), width - 1)
            top = max(first_pixel(boxes[2, lane]), 0)
            bottom = min(last_pixel(boxes[3, lane]), height - 1)
            if left <= right and top <= bottom:
                tile_ranges[k, 0] = left // rec.TILE
                tile_ranges[k, 1] = right // rec.TILE
                tile_ranges[k, 2] = top // rec.TILE
                tile_ranges[k, 3] = bottom // rec.TILE
                keys[k] = float_bits(depths[lane])


@njit(**INLINED_LANE_CODE)
def project_group(first, surfels, camera, width, height, curved, table, keys, tile_ranges, boxes, depths):
    """Project surfels first … first + 15: records, keys and tile ranges."""
    means, quats, scales, opacities, colors, curvatures, offsets = surfels
    active = lane_indices() < np.float32(min(keys.size - first, LANES))
    frame = surfel_frame(load_vector(means, first, active), load_quat(quats, first, active), camera)
    scale_u = load_strided(scales, 2 * first, 2, active)
    scale_v = load_strided(scales, 2 * first + 1, 2, active)
    opacity = load_strided(opacities, first, 1, active)
    color = load_vector(colors, first, active)
    depth = frame.center[2]
    inverse_depth = 1.0 / depth
    x = frame.center[0] * inverse_depth * camera[rec.CAMERA_FX] + camera[rec.CAMERA_CX]
    y = frame.center[1] * inverse_depth * camera[rec.CAMERA_FY] + camera[rec.CAMERA_CY]
    if offsets.size:
        x += load_strided(offsets, 2 * first, 2, active)
        y += load_strided(offsets, 2 * first + 1, 2, active)

    hit = where(frame.edge_on, 0.0, depth / frame.normal_dot_center)
    per_x = hit / camera[rec.CAMERA_FX]
    per_y = hit / camera[rec.CAMERA_FY]
    plane_u = scaled(cross(frame.tangent_v, frame.center), 1.0 / scale_u)
    plane_v = scaled(cross(frame.center, frame.tangent_u), 1.0 / scale_v)
    total = absolute(x) + absolute(y) + absolute(depth) + absolute(scale_u) + absolute(scale_v)
    total += absolute(color[0]) + absolute(color[1]) + absolute(color[2])
    total += (
        absolute(plane_u[0] * hit)
        + absolute(plane_v[0] * hit)
        + absolute(plane_u[1] * hit)
        + absolute(plane_v[1] * hit)
    )
    if curved:
        a, b, c = load_vector(curvatures, first, active)
        total += absolute(a) + absolute(b) + absolute(c)
        turn_u = scaled(added(scaled(frame.tangent_u, a), scaled(frame.tangent_v, b)), -frame.facing * scale_u)
        turn_v = scaled(added(scaled(frame.tangent_u, b), scaled(frame.tangent_v, c)), -frame.facing * scale_v)
        store_vector(table, first * rec.RECORD_SIZE + rec.CURVED_U, rec.RECORD_SIZE, active, turn_u)
        store_vector(table, first * rec.RECORD_SIZE + rec.CURVED_V, rec.RECORD_SIZE, active, turn_v)
    drawn = (total < INFINITY) & (scale_u > 0.0) & (scale_v > 0.0) & active
    drawn &= (depth >= camera[rec.CAMERA_NEAR]) & (opacity >= np.float32(ALPHA_MIN)) & (opacity < INFINITY)
    log2_opacity = log2(where(drawn, opacity, 1.0))
    rho = TWO_LN_2 * (log2_opacity + LOG2_INVERSE_ALPHA_MIN)

    store_field(table, first, rec.CENTER_X, active, x)
    store_field(table, first, rec.CENTER_Y, active, y)
    store_field(table, first, rec.A0, active, plane_u[0] * per_x)
    store_field(table, first, rec.B0, active, plane_u[1] * per_y)
    store_field(table, first, rec.A1, active, plane_v[0] * per_x)
    store_field(table, first, rec.B1, active, plane_v[1] * per_y)
    store_field(table, first, rec.A2, active, frame.normal[0] * per_x)
    store_field(table, first, rec.B2, active, frame.normal[1] * per_y)
    store_field(table, first, rec.DEPTH, active, depth)
    store_field(table, first, rec.HIT_CENTER, active, where(frame.edge_on, 0.0, 1.0))
    store_field(table, first, rec.LOG2_OPACITY, active, log2_opacity)
    store_field(table, first, rec.RHO_MAX, active, rho)
    store_vector(table, first * rec.RECORD_SIZE + rec.COLOR, rec.RECORD_SIZE, active, color)
    facing_normal = scaled(frame.normal, frame.facing)
    store_vector(table, first * rec.RECORD_SIZE + rec.NORMAL, rec.RECORD_SIZE, active, facing_normal)
    scaled_u = scaled(frame.tangent_u, scale_u)
    scaled_v = scaled(frame.tangent_v, scale_v)
    store_outline(table, boxes, first, active, camera, (x, y), frame, scaled_u, scaled_v, rho)
    store_lanes(depths, 0, depth)
    store_tiles(keys, tile_ranges, first, mask_bits(drawn), boxes, depths, width, height)


@njit(**LANE_CODE)
def project(counter, surfels, camera, width, height, curved, table, keys, tile_ranges, scratch):
    """Fill records, sorting keys and tile ranges; several threads may run this on one `counter`.

    `surfels` is (means, quats, scales, opacities, colors, curvatures, screen offsets), float32 and contiguous; the last
    may be empty. `scratch` has five rows of lanes for each thread.
    """
    rows = scratch[thread_slot(counter)]
    boxes = rows[:4]
    depths = rows[4]
    while True:
        begin = fetch_add(counter, GROUPS_PER_CLAIM * LANES)
        if begin >= keys.size:
            return
        for first in range(begin, min(begin + GROUPS_PER_CLAIM * LANES, keys.size), LANES):
            project_group(first, surfels, camera, width, height, curved, table, keys, tile_ranges, boxes, depths)
