"""What a level set mirrors: directions over a pixel, radiance with its slopes, and rows of derivatives, in Numba."""

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from panoless.kernels.constants import LEAST_SLANT, SHORTEST_DIRECTION, SUB_PIXELS
from panoless.kernels.cpu.compilation import VECTORIZED_LOOPS
from panoless.kernels.cpu.simd_memory import fetch_add
from panoless.kernels.cpu.workers import run_shared

RAYS_PER_CLAIM = 4096


def mirrored(
    derivatives: Float[np.ndarray, "P 10"],
    directions: Float[np.ndarray, "P 3"],
    distance: Float[np.ndarray, "P"],
    pixel_steps: Float[np.ndarray, "P 2 3"],
    samples: int,
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P K 3"], Float[np.ndarray, "P"]]:
    """See `panoless.kernels.level_set`."""
    count = len(directions)
    normals, outgoing, turn = np.empty((count, 3)), np.empty((count, samples, 3)), np.empty(count)
    shifts = np.array(SUB_PIXELS[samples])
    run_shared(_mirrored, derivatives, directions, distance, pixel_steps, shifts, normals, outgoing, turn)
    return normals, outgoing, turn


def seen_with_slopes(
    padded: Float[np.ndarray, "6 M M 3"], directions: Float[np.ndarray, "P K 3"]
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3 3"], Int[np.ndarray, "P"]]:
    """See `panoless.kernels.level_set`."""
    count = len(directions)
    seen, slopes, texels = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.empty(count, dtype=np.int64)
    run_shared(_seen, np.ascontiguousarray(padded, dtype=np.float64), directions, seen, slopes, texels)
    return seen, slopes, texels


def mirror_rows(
    derivatives: Float[np.ndarray, "P 10"],
    directions: Float[np.ndarray, "P 3"],
    slopes: Float[np.ndarray, "P 3 3"],
) -> Float[np.ndarray, "P 3 4"]:
    """See `panoless.kernels.level_set`."""
    rows = np.empty((len(directions), 3, 4))
    run_shared(_mirror_rows, derivatives, directions, slopes, rows)
    return rows


@njit(**VECTORIZED_LOOPS)
def _by_hessian(derivatives, x, y, z):
    return (
        derivatives[4] * x + derivatives[5] * y + derivatives[6] * z,
        derivatives[5] * x + derivatives[7] * y + derivatives[8] * z,
        derivatives[6] * x + derivatives[8] * y + derivatives[9] * z,
    )


@njit(**VECTORIZED_LOOPS)
def _mirrored(counter, derivatives, directions, distance, pixel_steps, shifts, normals, outgoing, turn):
    while True:
        begin = fetch_add(counter, RAYS_PER_CLAIM)
        if begin >= len(directions):
            return
        changes = np.empty((2, 3))
        for ray in range(begin, min(begin + RAYS_PER_CLAIM, len(directions))):
            found, (dx, dy, dz) = derivatives[ray], directions[ray]
            length = np.sqrt(found[1] ** 2 + found[2] ** 2 + found[3] ** 2) + 1e-30
            nx, ny, nz = found[1] / length, found[2] / length, found[3] / length
            normals[ray, 0], normals[ray, 1], normals[ray, 2] = nx, ny, nz
            slant = min(dx * nx + dy * ny + dz * nz, -LEAST_SLANT)
            facing = dx * nx + dy * ny + dz * nz
            largest = 0.0
            for axis in range(2):
                qx, qy, qz = pixel_steps[ray, axis]
                slide = -distance[ray] * (qx * nx + qy * ny + qz * nz) / slant
                mx = distance[ray] * qx + slide * dx
                my = distance[ray] * qy + slide * dy
                mz = distance[ray] * qz + slide * dz
                hx, hy, hz = _by_hessian(found, mx, my, mz)
                across = hx * nx + hy * ny + hz * nz
                hx, hy, hz = (hx - across * nx) / length, (hy - across * ny) / length, (hz - across * nz) / length
                rate = qx * nx + qy * ny + qz * nz + dx * hx + dy * hy + dz * hz
                changes[axis, 0] = qx - 2 * (rate * nx + facing * hx)
                changes[axis, 1] = qy - 2 * (rate * ny + facing * hy)
                changes[axis, 2] = qz - 2 * (rate * nz + facing * hz)
                largest = max(largest, changes[axis, 0] ** 2 + changes[axis, 1] ** 2 + changes[axis, 2] ** 2)
            turn[ray] = np.sqrt(largest)
            for sample in range(len(shifts)):
                u, v = shifts[sample, 0], shifts[sample, 1]
                outgoing[ray, sample, 0] = dx - 2 * facing * nx + u * changes[0, 0] + v * changes[1, 0]
                outgoing[ray, sample, 1] = dy - 2 * facing * ny + u * changes[0, 1] + v * changes[1, 1]
                outgoing[ray, sample, 2] = dz - 2 * facing * nz + u * changes[0, 2] + v * changes[1, 2]


@njit(**VECTORIZED_LOOPS)
def _face_of(x, y, z):
    """Face, and the components along its s, its t and its outward axis; signs s_sign … are those of `FACE_FRAMES`."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        return (0, -z, -y, x) if x >= 0 else (1, z, -y, -x)
    if ay >= az:
        return (2, x, z, y) if y >= 0 else (3, x, -z, -y)
    return (4, x, -y, z) if z >= 0 else (5, -x, -y, -z)


@njit(**VECTORIZED_LOOPS)
def _seen(counter, padded, directions, seen, slopes, texels):
    resolution, samples = padded.shape[1] - 2, directions.shape[1]
    while True:
        begin = fetch_add(counter, RAYS_PER_CLAIM)
        if begin >= len(directions):
            return
        for ray in range(begin, min(begin + RAYS_PER_CLAIM, len(directions))):
            mx = my = mz = 0.0
            for sample in range(samples):
                x, y, z = directions[ray, sample]
                mx, my, mz = mx + x, my + y, mz + z
                face, s, t, major = _face_of(x, y, z)
                if not major >= SHORTEST_DIRECTION:
                    continue
                share, scale = 1.0 / samples, 0.5 * resolution / major
                s, t = s / major, t / major
                u, v = (s + 1) * 0.5 * resolution + 0.5, (t + 1) * 0.5 * resolution + 0.5
                column, row = min(max(int(u), 0), resolution), min(max(int(v), 0), resolution)
                u, v = u - column, v - row
                for channel in range(3):
                    a, b = padded[face, row, column, channel], padded[face, row, column + 1, channel]
                    c, d = padded[face, row + 1, column, channel], padded[face, row + 1, column + 1, channel]
                    seen[ray, channel] += share * ((a * (1 - u) + b * u) * (1 - v) + (c * (1 - u) + d * u) * v)
                    by_s = share * scale * ((b - a) * (1 - v) + (d - c) * v)
                    by_t = share * scale * ((c - a) * (1 - u) + (d - b) * u)
                    out = -(by_s * s + by_t * t)
                    if face == 0:
                        gx, gy, gz = out, -by_t, -by_s
                    elif face == 1:
                        gx, gy, gz = -out, -by_t, by_s
                    elif face == 2:
                        gx, gy, gz = by_s, out, by_t
                    elif face == 3:
                        gx, gy, gz = by_s, -out, -by_t
                    elif face == 4:
                        gx, gy, gz = by_s, -by_t, out
                    else:
                        gx, gy, gz = -by_s, -by_t, -out
                    slopes[ray, channel, 0] += gx
                    slopes[ray, channel, 1] += gy
                    slopes[ray, channel, 2] += gz
            face, s, t, major = _face_of(mx, my, mz)
            major = max(major, SHORTEST_DIRECTION)
            column = min(max(int((s / major + 1) * 0.5 * resolution), 0), resolution - 1)
            row = min(max(int((t / major + 1) * 0.5 * resolution), 0), resolution - 1)
            texels[ray] = (face * resolution + row) * resolution + column


@njit(**VECTORIZED_LOOPS)
def _mirror_rows(counter, derivatives, directions, slopes, rows):
    while True:
        begin = fetch_add(counter, RAYS_PER_CLAIM)
        if begin >= len(directions):
            return
        for ray in range(begin, min(begin + RAYS_PER_CLAIM, len(directions))):
            found, (dx, dy, dz) = derivatives[ray], directions[ray]
            length = np.sqrt(found[1] ** 2 + found[2] ** 2 + found[3] ** 2) + 1e-30
            nx, ny, nz = found[1] / length, found[2] / length, found[3] / length
            facing = dx * nx + dy * ny + dz * nz
            hx, hy, hz = _by_hessian(found, dx, dy, dz)
            rate = length * min(facing, -LEAST_SLANT)
            for channel in range(3):
                ax, ay, az = slopes[ray, channel]
                along = ax * nx + ay * ny + az * nz
                ux, uy, uz = (
                    -2 * (along * dx + facing * ax),
                    -2 * (along * dy + facing * ay),
                    -2 * (along * dz + facing * az),
                )
                across = ux * nx + uy * ny + uz * nz
                ux, uy, uz = (ux - across * nx) / length, (uy - across * ny) / length, (uz - across * nz) / length
                rows[ray, channel, 0] = -(ux * hx + uy * hy + uz * hz) / rate
                rows[ray, channel, 1] = ux
                rows[ray, channel, 2] = uy
                rows[ray, channel, 3] = uz
