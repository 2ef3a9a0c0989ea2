"""Directions ⇄ lat-long ⇄ cubemap, their solid angles, bilinear lookups, and a blur of the sphere (numpy).

Lat-long: u = ½ − atan2(y, x)/2π grows to the right, v = acos(z)/π grows downward (Cycles, kernel/camera/projection.h);
texel centers lie at (i + ½)/N. Cubemap: texel centers at 2(i + ½)/L − 1 on faces oriented as OpenGL 4.6 table 8.19.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from shinypartial.core.conventions import FACE_AXES

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

#: Side (rad) of what a pixel sees when no neighbor shows it: such a lone pixel is given hardly any weight.
UNKNOWN_SPREAD = 1.0
#: A blur ends at this many standard deviations, where its kernel has fallen to 4e-6.
BLUR_REACH = 5.0


def latlong_to_directions(uv: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "... 3"]:
    """Unit world directions of lat-long coordinates in [0, 1]²."""
    azimuth = (0.5 - uv[..., 0]) * 2 * np.pi
    polar = uv[..., 1] * np.pi
    sin_polar = np.sin(polar)
    return np.stack([sin_polar * np.cos(azimuth), sin_polar * np.sin(azimuth), np.cos(polar)], -1)


def directions_to_latlong(directions: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 2"]:
    """Inverse of `latlong_to_directions`; directions need not be unit. At the poles u is ½."""
    # Of strided arrays, numpy rounds the last bit by where they lie in memory.
    x, y, z = np.ascontiguousarray(np.moveaxis(directions, -1, 0))
    u = 0.5 - np.arctan2(y, x) / (2 * np.pi)
    v = np.arctan2(np.hypot(x, y), z) / np.pi
    return np.stack([u, v], -1)


def latlong_directions(height: int) -> Float[np.ndarray, "H 2*H 3"]:
    """Unit directions of all texel centers of a lat-long map of that height."""
    u, v = np.meshgrid((np.arange(2 * height) + 0.5) / (2 * height), (np.arange(height) + 0.5) / height)
    return latlong_to_directions(np.stack([u, v], -1))


def latlong_solid_angles(height: int) -> Float[np.ndarray, "H 2*H"]:
    """Solid angle (sr) of every texel: (π/H)·(cos θ₀ − cos θ₁), exact; the sum is 4π."""
    edges = np.cos(np.linspace(0, np.pi, height + 1))
    row = (edges[:-1] - edges[1:]) * (np.pi / height)
    return np.repeat(row[:, None], 2 * height, 1)


def latlong_laplacian(height: int) -> "csr_matrix":
    """The matrix L of ∫‖∇E‖² ≈ Σ E·(L E) over the texels of a lat-long map, row by row: a graph Laplacian.

    On a grid of equal steps the neighbors of a texel weigh 1/sin θ to either side, with θ of its row, and sin θ at the
    edge above and below, so that nothing passes through the poles.
    """
    from scipy.sparse import coo_matrix, diags

    texel = np.arange(2 * height**2).reshape(height, 2 * height)
    beside = np.repeat(1 / np.sin(np.pi * (np.arange(height) + 0.5) / height), 2 * height)
    below = np.repeat(np.sin(np.pi * np.arange(1, height) / height), 2 * height)
    first = np.concatenate([texel.ravel(), texel[:-1].ravel()])
    second = np.concatenate([np.roll(texel, -1, 1).ravel(), texel[1:].ravel()])
    weights = coo_matrix((np.concatenate([beside, below]), (first, second)), (texel.size,) * 2).tocsr()
    both = weights + weights.T
    return (diags(np.asarray(both.sum(1)).ravel()) - both).tocsr()


def cube_to_directions(face: Int[np.ndarray, "..."], st: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "... 3"]:
    """Unit directions of face coordinates (s, t) in [−1, 1]²."""
    axes = FACE_AXES[face]
    directions = axes[..., 2, :] + st[..., :1] * axes[..., 0, :] + st[..., 1:] * axes[..., 1, :]
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def directions_to_cube(
    directions: Float[np.ndarray, "... 3"],
) -> tuple[Int[np.ndarray, "..."], Float[np.ndarray, "... 2"]]:
    """Inverse of `cube_to_directions`: dominant face (ties: x before y before z) and (s, t)."""
    magnitude = np.abs(directions)
    axis = np.argmax(magnitude, -1)
    major = np.take_along_axis(directions, axis[..., None], -1)[..., 0]
    face = np.asarray(2 * axis + (major < 0))
    axes = FACE_AXES[face]
    scale = np.maximum(np.abs(major), 1e-30)
    s = np.sum(directions * axes[..., 0, :], -1) / scale
    t = np.sum(directions * axes[..., 1, :], -1) / scale
    return face, np.stack([s, t], -1)


def cube_directions(resolution: int) -> Float[np.ndarray, "6 L L 3"]:
    """Unit directions of all texel centers of a cubemap, rows along t, columns along s."""
    centers = 2 * (np.arange(resolution) + 0.5) / resolution - 1
    s, t = np.meshgrid(centers, centers)
    st = np.broadcast_to(np.stack([s, t], -1), (6, resolution, resolution, 2))
    face = np.broadcast_to(np.arange(6)[:, None, None], (6, resolution, resolution))
    return cube_to_directions(face, st)


def cube_solid_angles(resolution: int) -> Float[np.ndarray, "L L"]:
    """Solid angle (sr) of every texel of one face, exact by corner differences; six faces sum to 4π."""
    edges = 2 * np.arange(resolution + 1) / resolution - 1
    x, y = np.meshgrid(edges, edges)
    corner = np.arctan2(x * y, np.sqrt(x**2 + y**2 + 1))
    return corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1]


def tangents(directions: Float[np.ndarray, "*P 3"]) -> tuple[Float[np.ndarray, "*P 3"], Float[np.ndarray, "*P 3"]]:
    """Unit directions e₁ and e₂ = d × e₁ at right angles to each unit direction d, and to the axis farthest from it."""
    first = np.cross(directions, np.eye(3)[np.abs(directions).argmin(-1)])
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return first, np.cross(directions, first)


def fibonacci_directions(count: int) -> Float[np.ndarray, "N 3"]:
    """So many unit directions evenly over the sphere, from +Z to −Z: each is turned on by the golden angle."""
    index = np.arange(count) + 0.5
    height, azimuth = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], 1)


def sample_latlong(
    latlong: Float[np.ndarray, "H W C"], directions: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "... C"]:
    """Bilinear lookup; wraps around in azimuth and clamps at the poles."""
    height, width = latlong.shape[:2]
    uv = directions_to_latlong(directions)
    x, y = (np.asarray(uv[..., axis] * count - 0.5) for axis, count in enumerate((width, height)))
    return interpolate_wrapped(latlong, x, y)


def interpolate_wrapped(
    picture: Float[np.ndarray, "H W C"], x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "... C"]:
    """Bilinear lookup at columns x and rows y, integers at texel centers; columns wrap around, rows are clamped."""
    height, width = picture.shape[:2]
    y = np.clip(y, 0, height - 1)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    y1 = np.minimum(y0 + 1, height - 1)
    left, right = x0 % width, (x0 + 1) % width
    top = picture[y0, left] * (1 - fx) + picture[y0, right] * fx
    bottom = picture[y1, left] * (1 - fx) + picture[y1, right] * fx
    return top * (1 - fy) + bottom * fy


def sample_cube(
    cube: Float[np.ndarray, "6 L L C"], directions: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "... C"]:
    """Bilinear lookup within the dominant face (clamped at its border, so no blend across faces)."""
    resolution = cube.shape[1]
    face, st = directions_to_cube(directions)
    position = np.clip((st + 1) * resolution / 2 - 0.5, 0, resolution - 1)
    x0, y0 = np.moveaxis(np.minimum(np.floor(position).astype(int), max(resolution - 2, 0)), -1, 0)
    fx, fy = np.moveaxis(position, -1, 0) - np.stack([x0, y0])
    x1, y1 = np.minimum(x0 + 1, resolution - 1), np.minimum(y0 + 1, resolution - 1)
    fx, fy = fx[..., None], fy[..., None]
    top = cube[face, y0, x0] * (1 - fx) + cube[face, y0, x1] * fx
    bottom = cube[face, y1, x0] * (1 - fx) + cube[face, y1, x1] * fx
    return top * (1 - fy) + bottom * fy


def latlong_to_cube(latlong: Float[np.ndarray, "H W C"], resolution: int) -> Float[np.ndarray, "6 L L C"]:
    """Resample a lat-long map onto cubemap texel centers (2×2 points a texel, averaged)."""
    fine = sample_latlong(latlong, cube_directions(2 * resolution))
    return fine.reshape(6, resolution, 2, resolution, 2, -1).mean((2, 4)).astype(latlong.dtype)


def flat_texels(directions: Float[np.ndarray, "*P 3"], resolution: int) -> Int[np.ndarray, "*P"]:
    """The flat index of the texel that each direction falls into."""
    return texels_at(*directions_to_cube(directions), resolution)


def texels_at(face: Int[np.ndarray, "*P"], st: Float[np.ndarray, "*P 2"], resolution: int) -> Int[np.ndarray, "*P"]:
    """The flat index of the texel at each place of a face."""
    column, row = np.moveaxis(np.clip((st + 1) * resolution / 2, 0, resolution - 1).astype(np.int64), -1, 0)
    return (face * resolution + row) * resolution + column


def cube_to_latlong(cube: Float[np.ndarray, "6 L L C"], height: int) -> Float[np.ndarray, "H 2*H C"]:
    """Resample a cubemap onto lat-long texel centers."""
    return sample_cube(cube, latlong_directions(height)).astype(cube.dtype)


def blur_latlong(latlong: Float[np.ndarray, "H W C"], std_rad: float) -> Float[np.ndarray, "H W C"]:
    """Mean of a map over a Gaussian of angle: Σ_j Ω_j k(γ_ij) x_j / Σ_j Ω_j k(γ_ij), k = exp((cos γ − 1)/σ²).

    The kernel (von Mises–Fisher) knows angles γ alone, so there is no seam and a pole is like any other direction. Two
    rows see each other through differences of azimuth, hence a circular convolution for each pair. Needs σ > 0.
    """
    height, width = latlong.shape[:2]
    polar, azimuth = np.pi * (np.arange(height) + 0.5) / height, 2 * np.pi * np.arange(width) / width
    weighted = np.concatenate([latlong.astype(np.float64), np.ones((height, width, 1))], -1)
    spectra = np.fft.rfft(weighted * latlong_solid_angles(height)[..., None], axis=1)
    blurred = np.empty((height, width, weighted.shape[-1]))
    for i in range(height):
        near = np.flatnonzero(np.abs(polar - polar[i]) <= max(BLUR_REACH * std_rad, np.pi / height))
        cosine = np.sin(polar[i]) * np.sin(polar[near])[:, None] * np.cos(azimuth)
        cosine += (np.cos(polar[i]) * np.cos(polar[near]))[:, None]
        kernel = np.fft.rfft(np.exp((np.minimum(cosine, 1) - 1) / std_rad**2), axis=1)
        blurred[i] = np.fft.irfft((kernel[..., None] * spectra[near]).sum(0), n=width, axis=0)
    return (blurred[..., :-1] / blurred[..., -1:]).astype(latlong.dtype)


def pixel_footprint_sr(
    directions: Float[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W"]:
    """Square of the larger of the two angles to the next pixel's direction, by row and by column, within the mask.

    The larger one, not the product: a pixel at the rim sees a long thin strip, which blurs along its length.
    """
    longest = np.zeros(mask.shape)
    for axis in (0, 1):
        first, second = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
        both = mask[first] & mask[second]
        step = np.where(both, np.linalg.norm(directions[first] - directions[second], axis=-1), 0.0)
        total, number = np.zeros(mask.shape), np.zeros(mask.shape)
        for side in (first, second):
            total[side] += step
            number[side] += both
        longest = np.maximum(longest, np.where(number > 0, total / np.maximum(number, 1), UNKNOWN_SPREAD))
    return (longest**2).astype(np.float32)
