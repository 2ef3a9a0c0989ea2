"""Gradients of the blended images to the records: each tile walks its list again, from its last fragment on."""

import triton
import triton.language as tl

from panoless.splats.kernels.gpu.blend import (
    CAP,
    LOW_PASS_PRECISION,
    NONE,
    first_depth,
    intersect,
    load_triple,
    tile_pixels,
)
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
    FLAT_GRADIENT_SIZE,
    GRAD_COLOR,
    GRAD_CURVED_U,
    GRAD_CURVED_V,
    GRAD_NORMAL,
    GRAD_OPACITY,
    GRADIENT_SIZE,
    NORMAL,
    RECORD_SIZE,
    RHO_MAX,
)
from panoless.splats.kernels.gpu.vectors import dot


@triton.jit
def load_planes(pointer, at, plane_size, mask):
    """One pixel each of three planes, 0 outside the mask."""
    return (
        tl.load(pointer + at, mask=mask, other=0.0),
        tl.load(pointer + plane_size + at, mask=mask, other=0.0),
        tl.load(pointer + 2 * plane_size + at, mask=mask, other=0.0),
    )


@triton.jit
def placed(row, slot, at, value):
    """The row with the sum of `value` over the tile's pixels at one place."""
    return tl.where(slot == at, tl.sum(value, axis=0), row)


@triton.jit
def placed_triple(row, slot, at, factor, triple):
    """The row with the sums of factor · triple at three places."""
    row = placed(row, slot, at, factor * triple[0])
    row = placed(row, slot, at + 1, factor * triple[1])
    return placed(row, slot, at + 2, factor * triple[2])


@triton.jit(do_not_specialize=["width", "height"])
def blend_backward(
    table,
    surfels,
    starts,
    color_gradients,
    normal_gradients,
    depth_gradients,
    alpha_gradients,
    median_gradients,
    distortion_gradients,
    saved,
    saved_places,
    sums,
    width,
    height,
    distance,
    CURVED: tl.constexpr,
    TILE: tl.constexpr,
):
    """Add one tile's gradients to the surfels' rows of `sums`: a sum over the tile, then one atomic addition a row.

    A fragment of weight w at distance m changes the distortion A·M2 − M1² by w·(M2 − 2 M1 m + A m²). With B the sum of
    weight · gradient of the weight over what lies behind, dL/dα_i = T_i·gradient_i − B_i/(1 − α_i).
    """
    tile = tl.program_id(0)
    pixels = tile_pixels(tile, width, height, TILE)
    at, inside = pixels.at, pixels.inside
    plane_size = width * height
    start, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    reference = distance / first_depth(table, surfels, start, end)
    last = tl.load(saved_places + at, mask=inside, other=NONE)
    median_place = tl.load(saved_places + plane_size + at, mask=inside, other=NONE)
    transmittance, m1, m2 = load_planes(saved, at, plane_size, inside)
    transmittance = tl.where(inside, transmittance, 1.0)
    to_color = load_planes(color_gradients, at, plane_size, inside)
    to_normal = load_planes(normal_gradients, at, plane_size, inside)
    to_depth = tl.load(depth_gradients + at, mask=inside, other=0.0)
    to_median = tl.load(median_gradients + at, mask=inside, other=0.0)
    to_distortion = tl.load(distortion_gradients + at, mask=inside, other=0.0)
    constant = tl.load(alpha_gradients + at, mask=inside, other=0.0) + to_distortion * m2
    linear = -2.0 * to_distortion * m1
    quadratic = to_distortion * (1.0 - transmittance)
    behind = tl.zeros([TILE * TILE], tl.float32)
    slot = tl.arange(0, GRADIENT_SIZE)
    farthest = tl.max(last, axis=0)
    for step in range(0, farthest + 1 - start):
        place = farthest - step
        k = tl.load(surfels + place)
        record = table + k * RECORD_SIZE
        fragment = intersect(record, pixels.x, pixels.y)
        covered = (place <= last) & (fragment.rho <= tl.load(record + RHO_MAX))
        if tl.max(covered.to(tl.int32), axis=0) > 0:
            dx, dy, u, v, by_hit = fragment.dx, fragment.dy, fragment.u, fragment.v, fragment.by_hit
            alpha = tl.where(covered, tl.minimum(fragment.uncapped, CAP), 0.0)
            let_through = 1.0 / (1.0 - alpha)
            transmittance = transmittance * let_through
            weight = alpha * transmittance
            center_depth = tl.load(record + DEPTH)
            ratio = tl.where(by_hit, fragment.inverse_w, 1.0)
            z = center_depth * ratio
            inverse_z = tl.where(by_hit, fragment.w, 1.0) / center_depth
            m = reference - distance * inverse_z
            per_weight = constant + (linear + quadratic * m) * m + to_depth * z
            per_weight += dot(to_color, load_triple(record + COLOR)) + dot(to_normal, load_triple(record + NORMAL))
            if CURVED:
                turn_u = dot(to_normal, load_triple(record + CURVED_U))
                turn_v = dot(to_normal, load_triple(record + CURVED_V))
                per_weight += tl.where(by_hit, turn_u * u + turn_v * v, 0.0)
            grad_alpha = transmittance * per_weight - behind * let_through
            behind += weight * per_weight
            log_alpha = tl.where(covered & (fragment.uncapped < CAP), grad_alpha * alpha, 0.0)
            grad_m = weight * (linear + 2.0 * quadratic * m)
            grad_z = weight * to_depth + grad_m * distance * inverse_z * inverse_z
            grad_z += tl.where(place == median_place, to_median, 0.0)

            grad_u = -log_alpha * u
            grad_v = -log_alpha * v
            if CURVED:
                grad_u += weight * turn_u
                grad_v += weight * turn_v
            from_w = tl.where(by_hit, (grad_u * u + grad_v * v + grad_z * z) * ratio, 0.0)
            grad_u = tl.where(by_hit, grad_u * ratio, 0.0)
            grad_v = tl.where(by_hit, grad_v * ratio, 0.0)
            pull = tl.where(by_hit, 0.0, log_alpha * LOW_PASS_PRECISION)
            a0, b0, a1 = tl.load(record + A0), tl.load(record + B0), tl.load(record + A1)
            b1, a2, b2 = tl.load(record + B1), tl.load(record + A2), tl.load(record + B2)
            row = tl.zeros([GRADIENT_SIZE], tl.float32)
            row = placed(row, slot, CENTER_X, pull * dx + (from_w * a2 - grad_u * a0 - grad_v * a1))
            row = placed(row, slot, CENTER_Y, pull * dy + (from_w * b2 - grad_u * b0 - grad_v * b1))
            row = placed(row, slot, A0, grad_u * dx)
            row = placed(row, slot, B0, grad_u * dy)
            row = placed(row, slot, A1, grad_v * dx)
            row = placed(row, slot, B1, grad_v * dy)
            row = placed(row, slot, A2, -from_w * dx)
            row = placed(row, slot, B2, -from_w * dy)
            row = placed(row, slot, DEPTH, grad_z * ratio)
            row = placed(row, slot, GRAD_OPACITY, log_alpha)
            row = placed_triple(row, slot, GRAD_COLOR, weight, to_color)
            row = placed_triple(row, slot, GRAD_NORMAL, weight, to_normal)
            filled = slot < FLAT_GRADIENT_SIZE
            if CURVED:
                row = placed_triple(row, slot, GRAD_CURVED_U, tl.where(by_hit, weight * u, 0.0), to_normal)
                row = placed_triple(row, slot, GRAD_CURVED_V, tl.where(by_hit, weight * v, 0.0), to_normal)
                filled = slot < GRAD_CURVED_V + 3
            tl.atomic_add(sums + k * GRADIENT_SIZE + slot, row, mask=filled, sem="relaxed")
