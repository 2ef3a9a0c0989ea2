"""What photographs say of every cell and slope below the mouth of a surface of revolution, in Numba."""

import numpy as np
from jaxtyping import Float
from numba import njit

from panoless.kernels.constants import LEAST_FACING, LEAST_RISE
from panoless.kernels.cpu.compilation import PLAIN_LOOPS


@njit(**PLAIN_LOOPS)
def slope_votes(
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    radiance: Float[np.ndarray, "P 3"],
    texels: Float[np.ndarray, "6 L L 3"],
    frame: Float[np.ndarray, "3 3"],
    grid: Float[np.ndarray, "5"],
    angles: Float[np.ndarray, "S"],
    scale: float,
) -> Float[np.ndarray, "2 cells S"]:
    """See `panoless.kernels.revolution`."""
    cell, top, mouth = grid[0], grid[1], grid[4]
    columns, rows = int(grid[2]), int(grid[3])
    radius = columns * cell
    result = np.zeros((2, rows * columns, len(angles)))
    sine, cosine = np.sin(angles), np.cos(angles)
    for ray in range(len(origins)):
        dx, dy, dz = directions[ray]
        if dz > -LEAST_RISE:
            continue
        enter = (top - origins[ray, 2]) / dz
        for step in range(8 * columns):
            distance = enter + (step + 0.5) * cell / 2
            x, y = origins[ray, 0] + distance * dx, origins[ray, 1] + distance * dy
            z = origins[ray, 2] + distance * dz
            row, rho = int(np.floor((top - z) / cell)), np.sqrt(x * x + y * y)
            column = int(np.floor(rho / cell))
            if row >= rows:
                break
            if row < 0 or column >= columns or rho <= 0.1 * cell:
                continue
            at = row * columns + column
            ux, uy = x / rho, y / rho
            for k in range(len(angles)):
                nx, ny, nz = sine[k] * ux, sine[k] * uy, -cosine[k]
                facing = nx * dx + ny * dy + nz * dz
                if facing >= -LEAST_FACING:
                    continue
                ox, oy, oz = dx - 2 * facing * nx, dy - 2 * facing * ny, dz - 2 * facing * nz
                if oz <= LEAST_RISE:
                    continue
                if z < mouth:
                    t = (mouth - z) / oz
                    if (x + t * ox) ** 2 + (y + t * oy) ** 2 >= radius * radius:
                        continue
                squared = _squared_error(texels, frame, ox, oy, oz, radiance[ray])
                result[0, at, k] += squared / (squared + scale * scale)
                result[1, at, k] += 1
    return result


@njit(**PLAIN_LOOPS)
def _squared_error(texels, frame, ox, oy, oz, color):
    """‖E(ω) − c‖² with the nearest texel of a cubemap, faces as in OpenGL's table 8.19."""
    x = ox * frame[0, 0] + oy * frame[1, 0] + oz * frame[2, 0]
    y = ox * frame[0, 1] + oy * frame[1, 1] + oz * frame[2, 1]
    z = ox * frame[0, 2] + oy * frame[1, 2] + oz * frame[2, 2]
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, s, t, m = (0, -z, -y, ax) if x > 0 else (1, z, -y, ax)
    elif ay >= az:
        face, s, t, m = (2, x, z, ay) if y > 0 else (3, x, -z, ay)
    else:
        face, s, t, m = (4, x, -y, az) if z > 0 else (5, -x, -y, az)
    side = texels.shape[1]
    column = min(int((s / m + 1) / 2 * side), side - 1)
    row = min(int((t / m + 1) / 2 * side), side - 1)
    error = 0.0
    for channel in range(3):
        error += (texels[face, row, column, channel] - color[channel]) ** 2
    return error
