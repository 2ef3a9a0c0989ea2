"""Surfels to records: the part of the rasterizer that does not depend on pixels."""

import math
from typing import Any, NamedTuple

import triton
import triton.language as tl

from panoless.splats.kernels import constants
from panoless.splats.kernels.gpu.records import (
    A0,
    A1,
    A2,
    B0,
    B1,
    B2,
    CENTER_X,
    CENTER_Y,
    COLOR,
    CURVED_U,
    CURVED_V,
    DEPTH,
    ELLIPSE_X,
    ELLIPSE_Y,
    FORM_XX,
    FORM_XY,
    FORM_YY,
    HIT_CENTER,
    LOG2_OPACITY,
    NORMAL,
    RECORD_SIZE,
    RHO_MAX,
)
from panoless.splats.kernels.gpu.vectors import (
    added,
    cross,
    dot,
    load_rotation,
    load_translation,
    load_vector,
    rotate,
    scaled,
    store_vector,
)

ALPHA_MIN = tl.constexpr(constants.ALPHA_MIN)
CAMERA_PLANE_MARGIN = tl.constexpr(constants.CAMERA_PLANE_MARGIN)
EDGE_ON_COSINE_MIN = tl.constexpr(constants.EDGE_ON_COSINE_MIN)
LOG2_INVERSE_ALPHA_MIN = tl.constexpr(math.log2(1 / constants.ALPHA_MIN))
TWO_LN_2 = tl.constexpr(2 * math.log(2))
LOW_PASS_VARIANCE = tl.constexpr(constants.LOW_PASS_SIGMA**2)
THIN_ELLIPSE = tl.constexpr(1e-4)
ELLIPSE_SLACK = tl.constexpr(0.98)
FARTHEST_PIXEL = tl.constexpr(1e6)
"""Edges beyond this are cut before they become integers, which hold no infinity."""


class Frame(NamedTuple):
    """Surfels in camera coordinates."""

    center: Any
    tangent_u: Any
    tangent_v: Any
    normal: Any
    """tangent_u × tangent_v, whichever way it faces."""
    facing: Any
    """±1, the sign that turns the normal toward the camera."""
    toward: Any
    """normal · center, which divides; 1 where a surfel is edge-on."""
    edge_on: Any


@triton.jit
def load_quat(quats, k, active):
    """Unit quaternions (w, x, y, z) and the inverse of the norms that they had."""
    w = tl.load(quats + 4 * k, mask=active, other=1.0)
    x = tl.load(quats + 4 * k + 1, mask=active, other=0.0)
    y = tl.load(quats + 4 * k + 2, mask=active, other=0.0)
    z = tl.load(quats + 4 * k + 3, mask=active, other=0.0)
    inverse_norm = 1.0 / tl.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse_norm, x * inverse_norm, y * inverse_norm, z * inverse_norm, inverse_norm


@triton.jit
def surfel_frame(mean, quat, world_to_camera):
    """Bring surfels to camera coordinates; the tangents and the normal are the columns of the rotation."""
    rows = load_rotation(world_to_camera)
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    tangent_u = rotate(rows, (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)))
    tangent_v = rotate(rows, (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)))
    normal = rotate(rows, (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)))
    center = added(rotate(rows, mean), load_translation(world_to_camera))
    toward = dot(normal, center)
    edge_on = tl.abs(toward) < tl.sqrt(dot(center, center)) * EDGE_ON_COSINE_MIN
    facing = tl.where(toward > 0.0, -1.0, 1.0)
    return Frame(center, tangent_u, tangent_v, normal, facing, tl.where(edge_on, 1.0, toward), edge_on)


@triton.jit
def extent_along(slope, scaled_u, scaled_v, along_u, along_v, rho, inverse_plane):
    """(middle, half², lean of u, lean of v): where u² + v² ≤ rho lies along one image axis, in units of the focal
    length, relative to the projected center. Slopes against the viewing ray keep the formula free of cancellation.
    """
    lean_u = along_u - slope * scaled_u[2]
    lean_v = along_v - slope * scaled_v[2]
    middle = rho * (lean_u * scaled_u[2] + lean_v * scaled_v[2]) * inverse_plane
    half_squared = middle * middle - rho * (lean_u * lean_u + lean_v * lean_v) * inverse_plane
    return middle, half_squared, lean_u, lean_v


@triton.jit
def outline(center, scaled_u, scaled_v, x, y, rho, edge_on, fx, fy):
    """The culling ellipse (center, form) and the exact bounding box (left, right, top, bottom) in pixels."""
    depth = center[2]
    plane = rho * (scaled_u[2] * scaled_u[2] + scaled_v[2] * scaled_v[2]) - depth * depth
    bounded = plane < -depth * depth * CAMERA_PLANE_MARGIN
    inverse_plane = 1.0 / tl.where(bounded, plane, -1.0)
    middle_x, half_x, x_u, x_v = extent_along(
        center[0] / depth, scaled_u, scaled_v, scaled_u[0], scaled_v[0], rho, inverse_plane
    )
    middle_y, half_y, y_u, y_v = extent_along(
        center[1] / depth, scaled_u, scaled_v, scaled_u[1], scaled_v[1], rho, inverse_plane
    )
    ellipse_x = x + middle_x * fx
    ellipse_y = y + middle_y * fy
    xx = half_x * (fx * fx)
    yy = half_y * (fy * fy)
    xy = (middle_x * middle_y - rho * (x_u * y_u + x_v * y_v) * inverse_plane) * (fx * fy)
    determinant = xx * yy - xy * xy
    thick = determinant > xx * yy * THIN_ELLIPSE
    inverse = 1.0 / tl.where(thick, determinant, 1.0) * ELLIPSE_SLACK
    outlined = bounded & (edge_on == 0)
    form_xx = tl.where(outlined, tl.where(thick, yy * inverse, 0.5 / tl.maximum(xx, 1e-6)), 0.0)
    form_yy = tl.where(outlined, tl.where(thick, xx * inverse, 0.5 / tl.maximum(yy, 1e-6)), 0.0)
    form_xy = tl.where(outlined & thick, -xy * inverse, 0.0)
    disk = tl.sqrt(rho * LOW_PASS_VARIANCE)
    reach_x = tl.sqrt(tl.maximum(xx, 0.0))
    reach_y = tl.sqrt(tl.maximum(yy, 0.0))
    left = tl.where(bounded, tl.minimum(ellipse_x - reach_x, x - disk), -FARTHEST_PIXEL)
    right = tl.where(bounded, tl.maximum(ellipse_x + reach_x, x + disk), FARTHEST_PIXEL)
    top = tl.where(bounded, tl.minimum(ellipse_y - reach_y, y - disk), -FARTHEST_PIXEL)
    bottom = tl.where(bounded, tl.maximum(ellipse_y + reach_y, y + disk), FARTHEST_PIXEL)
    return (ellipse_x, ellipse_y, form_xx, form_xy, form_yy), (left, right, top, bottom)


@triton.jit
def first_pixel(edge):
    """The first pixel whose center is not left of `edge`, 0 at least."""
    return tl.maximum(tl.ceil(tl.maximum(tl.minimum(edge, FARTHEST_PIXEL), -1.0) - 0.5), 0.0).to(tl.int32)


@triton.jit
def last_pixel(edge, size):
    """The last pixel whose center is not right of `edge`, size − 1 at most."""
    pixel = tl.floor(tl.maximum(tl.minimum(edge, FARTHEST_PIXEL), -1.0) - 0.5).to(tl.int32)
    return tl.minimum(pixel, size - 1)


@triton.jit(do_not_specialize=["count", "width", "height"])
def project(
    means,
    quats,
    scales,
    opacities,
    colors,
    curvatures,
    offsets,
    world_to_camera,
    table,
    tile_boxes,
    candidates,
    count,
    width,
    height,
    fx,
    fy,
    cx,
    cy,
    near,
    CURVED: tl.constexpr,
    MOVED: tl.constexpr,
    TILE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write each surfel's record, the box (left, top, columns, depth bits) of tiles that it may touch, and how many
    these are: 0 if it is culled.
    """
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = k < count
    quat = load_quat(quats, k, active)
    frame = surfel_frame(load_vector(means + 3 * k, active), quat, world_to_camera)
    center, tangent_u, tangent_v, facing = frame.center, frame.tangent_u, frame.tangent_v, frame.facing
    scale_u = tl.load(scales + 2 * k, mask=active, other=1.0)
    scale_v = tl.load(scales + 2 * k + 1, mask=active, other=1.0)
    opacity = tl.load(opacities + k, mask=active, other=0.0)
    color = load_vector(colors + 3 * k, active)
    depth = center[2]
    x = center[0] / depth * fx + cx
    y = center[1] / depth * fy + cy
    if MOVED:
        x += tl.load(offsets + 2 * k, mask=active, other=0.0)
        y += tl.load(offsets + 2 * k + 1, mask=active, other=0.0)

    hit = tl.where(frame.edge_on, 0.0, depth / frame.toward)
    plane_u = scaled(cross(tangent_v, center), 1.0 / scale_u)
    plane_v = scaled(cross(center, tangent_u), 1.0 / scale_v)
    total = tl.abs(x) + tl.abs(y) + tl.abs(depth) + tl.abs(scale_u) + tl.abs(scale_v)
    total += tl.abs(color[0]) + tl.abs(color[1]) + tl.abs(color[2])
    total += tl.abs(plane_u[0] * hit) + tl.abs(plane_u[1] * hit)
    total += tl.abs(plane_v[0] * hit) + tl.abs(plane_v[1] * hit)
    record = table + k * RECORD_SIZE
    if CURVED:
        a, b, c = load_vector(curvatures + 3 * k, active)
        total += tl.abs(a) + tl.abs(b) + tl.abs(c)
        turn_u = scaled(added(scaled(tangent_u, a), scaled(tangent_v, b)), -facing * scale_u)
        turn_v = scaled(added(scaled(tangent_u, b), scaled(tangent_v, c)), -facing * scale_v)
        store_vector(record + CURVED_U, active, turn_u)
        store_vector(record + CURVED_V, active, turn_v)
    drawn = active & (total < float("inf")) & (scale_u > 0.0) & (scale_v > 0.0)
    drawn = drawn & (depth >= near) & (opacity >= ALPHA_MIN) & (opacity < float("inf"))
    log2_opacity = tl.log2(tl.where(drawn, opacity, 1.0))
    rho = tl.maximum((log2_opacity + LOG2_INVERSE_ALPHA_MIN) * TWO_LN_2, 0.0)

    tl.store(record + CENTER_X, x, mask=active)
    tl.store(record + CENTER_Y, y, mask=active)
    tl.store(record + A0, plane_u[0] * hit / fx, mask=active)
    tl.store(record + B0, plane_u[1] * hit / fy, mask=active)
    tl.store(record + A1, plane_v[0] * hit / fx, mask=active)
    tl.store(record + B1, plane_v[1] * hit / fy, mask=active)
    tl.store(record + A2, frame.normal[0] * hit / fx, mask=active)
    tl.store(record + B2, frame.normal[1] * hit / fy, mask=active)
    tl.store(record + DEPTH, depth, mask=active)
    tl.store(record + HIT_CENTER, tl.where(frame.edge_on, 0.0, 1.0), mask=active)
    tl.store(record + LOG2_OPACITY, log2_opacity, mask=active)
    tl.store(record + RHO_MAX, rho, mask=active)
    store_vector(record + COLOR, active, color)
    store_vector(record + NORMAL, active, scaled(frame.normal, facing))

    scaled_u, scaled_v = scaled(tangent_u, scale_u), scaled(tangent_v, scale_v)
    ellipse, box = outline(center, scaled_u, scaled_v, x, y, rho, frame.edge_on, fx, fy)
    tl.store(record + ELLIPSE_X, ellipse[0], mask=active)
    tl.store(record + ELLIPSE_Y, ellipse[1], mask=active)
    tl.store(record + FORM_XX, ellipse[2], mask=active)
    tl.store(record + FORM_XY, ellipse[3], mask=active)
    tl.store(record + FORM_YY, ellipse[4], mask=active)

    left, right = first_pixel(box[0]), last_pixel(box[1], width)
    top, bottom = first_pixel(box[2]), last_pixel(box[3], height)
    drawn = drawn & (left <= right) & (top <= bottom)
    first_column, first_row = left // TILE, top // TILE
    columns, rows = right // TILE - first_column + 1, bottom // TILE - first_row + 1
    tl.store(tile_boxes + 4 * k, first_column, mask=active)
    tl.store(tile_boxes + 4 * k + 1, first_row, mask=active)
    tl.store(tile_boxes + 4 * k + 2, columns, mask=active)
    tl.store(tile_boxes + 4 * k + 3, depth.to(tl.int32, bitcast=True), mask=active)
    tl.store(candidates + k, tl.where(drawn, columns * rows, 0), mask=active)
