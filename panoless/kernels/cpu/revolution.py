"""Where rays meet a surface of revolution, in Numba: a quadratic for each side of the profile that a tree leaves.

In the plane of radius ρ and height h along the axis a ray is ρ²(t) = a t² + 2 b t + c, h(t) = h₀ + t h₁. A box of that
plane, which a node of the tree is, is met where the slab of heights and the range of ρ² over it both are.
"""

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from panoless.kernels.cpu.compilation import PLAIN_LOOPS
from panoless.kernels.cpu.interior import slope_votes
from panoless.kernels.cpu.profile import closest_approach, distance_grid, envelope
from panoless.kernels.cpu.simd_memory import fetch_add
from panoless.kernels.cpu.workers import run_shared

__all__ = ["closest_approach", "distance_grid", "envelope", "first_hits", "follow", "slope_votes"]

RAYS_PER_CLAIM = 2048
FLAT = 1e-7
STACK_SIZE = 64


def first_hits(
    origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], profile: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "P"], Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """See `panoless.kernels.revolution`."""
    count = len(origins)
    distance, side, along = np.empty(count), np.empty(count, dtype=np.int64), np.empty(count)
    rays = np.ascontiguousarray(origins, dtype=np.float64), np.ascontiguousarray(directions, dtype=np.float64)
    profile = np.ascontiguousarray(profile, dtype=np.float64)
    run_shared(_trace, *rays, profile, _tree(profile), distance, side, along)
    return distance, side, along


def follow(
    points: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    places: tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"]],
    profile: Float[np.ndarray, "N 2"],
    angles: Float[np.ndarray, "S 2"],
    epsilon: float,
    max_bounces: int,
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"], Int[np.ndarray, "P"]]:
    """See `panoless.kernels.revolution`."""
    (last, final), bounces = np.zeros((2, len(points), 3)), np.zeros(len(points), dtype=np.int64)
    rays = np.ascontiguousarray(points, dtype=np.float64), np.ascontiguousarray(directions, dtype=np.float64)
    profile = np.ascontiguousarray(profile, dtype=np.float64)
    run_shared(_follow, *rays, places, profile, _tree(profile), angles, epsilon, max_bounces, last, final, bounces)
    return last, final, bounces


@njit(**PLAIN_LOOPS)
def _tree(profile):
    """Boxes (ρ₀, ρ₁, h₀, h₁) of runs of sides: node k has the children 2k + 1 and 2k + 2; leaves come last."""
    sides = len(profile) - 1
    leaves = 1
    while leaves < sides:
        leaves *= 2
    boxes = np.empty((2 * leaves - 1, 4))
    for node in range(2 * leaves - 2, -1, -1):
        box = boxes[node]
        i = node - (leaves - 1)
        if i >= sides:
            box[0], box[1], box[2], box[3] = np.inf, -np.inf, np.inf, -np.inf
        elif i >= 0:
            for axis in range(2):
                first, second = profile[i, axis], profile[i + 1, axis]
                box[2 * axis], box[2 * axis + 1] = min(first, second), max(first, second)
        else:
            for axis in range(2):
                box[2 * axis] = min(boxes[2 * node + 1, 2 * axis], boxes[2 * node + 2, 2 * axis])
                box[2 * axis + 1] = max(boxes[2 * node + 1, 2 * axis + 1], boxes[2 * node + 2, 2 * axis + 1])
    return boxes


@njit(**PLAIN_LOOPS)
def _enters(box, a, b, c, h0, h1, limit):
    """Whether the part of a ray before `limit` may meet a box."""
    start, end = 0.0, limit
    if abs(h1) > 1e-12:
        first, second = (box[2] - h0) / h1, (box[3] - h0) / h1
        start, end = max(start, min(first, second)), min(end, max(first, second))
    elif h0 < box[2] or h0 > box[3]:
        return False
    if start > end or not box[0] <= box[1]:
        return False
    slack = 1e-9
    nearest = min(max(-b / a, start), end) if a > 1e-18 else start
    if (a * nearest + 2 * b) * nearest + c > box[1] ** 2 + slack:
        return False
    if not np.isfinite(end):
        return True
    farthest = max((a * start + 2 * b) * start + c, (a * end + 2 * b) * end + c)
    return farthest >= box[0] ** 2 - slack


@njit(**PLAIN_LOOPS)
def _meets(r0, z0, r1, z1, a, b, c, h0, h1, limit):
    """Distance to one side and where on it; infinite when it is missed."""
    best, where = limit, -1.0
    dr, dz = r1 - r0, z1 - z0
    squared = dr * dr + dz * dz
    if squared <= 0:
        return np.inf, where
    k, m = r0 * dz + (h0 - z0) * dr, h1 * dr
    qa, qb, qc = a * dz * dz - m * m, b * dz * dz - k * m, c * dz * dz - k * k
    if dz * dz < FLAT * FLAT * squared:
        if abs(h1) < 1e-15:
            return np.inf, where
        roots = ((z0 - h0) / h1, np.inf)
    else:
        under = qb * qb - qa * qc
        if under < 0:
            return np.inf, where
        root = np.sqrt(under)
        q = -(qb + root) if qb >= 0 else root - qb
        first = q / qa if qa != 0 else np.inf
        second = qc / q if q != 0 else np.inf
        roots = (first, second)
    for t in roots:
        if t > 0 and t < best:
            rho = np.sqrt(max((a * t + 2 * b) * t + c, 0.0))
            h = h0 + t * h1
            u = ((rho - r0) * dr + (h - z0) * dz) / squared
            across = abs((rho - r0) * dz - (h - z0) * dr)
            if u >= -1e-9 and u <= 1 + 1e-9 and across < 1e-5 * squared + 1e-9:
                best, where = t, min(max(u, 0.0), 1.0)
    return (best if where >= 0 else np.inf), where


@njit(**PLAIN_LOOPS)
def _nearest(x, y, h0, dx, dy, h1, profile, tree, stack):
    """Distance, side and place on it of the first hit of one ray."""
    leaves = (len(tree) + 1) // 2
    a, b, c = dx * dx + dy * dy, x * dx + y * dy, x * x + y * y
    best, hit, where = np.inf, -1, 0.0
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if not _enters(tree[node], a, b, c, h0, h1, best):
            continue
        if node < leaves - 1:
            stack[depth], stack[depth + 1] = 2 * node + 1, 2 * node + 2
            depth += 2
            continue
        i = node - (leaves - 1)
        t, u = _meets(profile[i, 0], profile[i, 1], profile[i + 1, 0], profile[i + 1, 1], a, b, c, h0, h1, best)
        if u >= 0 and t < best:
            best, hit, where = t, i, u
    return best, hit, where


@njit(**PLAIN_LOOPS)
def _trace(counter, origins, directions, profile, tree, distance, side, along):
    stack = np.empty(STACK_SIZE, dtype=np.int64)
    while True:
        begin = fetch_add(counter, RAYS_PER_CLAIM)
        if begin >= len(origins):
            return
        for ray in range(begin, min(begin + RAYS_PER_CLAIM, len(origins))):
            x, y, h = origins[ray]
            dx, dy, dh = directions[ray]
            distance[ray], side[ray], along[ray] = _nearest(x, y, h, dx, dy, dh, profile, tree, stack)


@njit(**PLAIN_LOOPS)
def _follow(counter, points, directions, places, profile, tree, angles, epsilon, max_bounces, last, final, bounces):
    """Mirror rays that lie on the surface on, from their first side and the place on it."""
    side, along = places
    stack = np.empty(STACK_SIZE, dtype=np.int64)
    while True:
        begin = fetch_add(counter, RAYS_PER_CLAIM)
        if begin >= len(points):
            return
        for ray in range(begin, min(begin + RAYS_PER_CLAIM, len(points))):
            i, u = side[ray], along[ray]
            x, y, h = points[ray]
            dx, dy, dh = directions[ray]
            bounce = 0
            while i >= 0 and bounce < max_bounces:
                bounce += 1
                angle = angles[i, 0] + u * (angles[i, 1] - angles[i, 0])
                radius = max(np.sqrt(x * x + y * y), 1e-12)
                nx, ny, nh = np.sin(angle) * x / radius, np.sin(angle) * y / radius, -np.cos(angle)
                twice = 2 * (dx * nx + dy * ny + dh * nh)
                dx, dy, dh = dx - twice * nx, dy - twice * ny, dh - twice * nh
                length = np.sqrt(dx * dx + dy * dy + dh * dh)
                dx, dy, dh = dx / length, dy / length, dh / length
                x, y, h = x + epsilon * dx, y + epsilon * dy, h + epsilon * dh
                t, i, u = _nearest(x, y, h, dx, dy, dh, profile, tree, stack)
                if i >= 0:
                    x, y, h = x + t * dx, y + t * dy, h + t * dh
            if i < 0:
                last[ray, 0], last[ray, 1], last[ray, 2] = x, y, h
                final[ray, 0], final[ray, 1], final[ray, 2] = dx, dy, dh
                bounces[ray] = bounce
