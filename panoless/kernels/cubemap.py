"""Cubemap lookup on the whole sphere, without seams, and what belongs to it.

Faces are ordered (+X, −X, +Y, −Y, +Z, −Z) and oriented as OpenGL 4.6 table 8.19, in unswizzled world axes. A cubemap is
stored as (face, channel, row, column): column i lies at s = 2(i + ½)/L − 1, row j at t = 2(j + ½)/L − 1.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.kernels.backend import Backend, choose_backend
from panoless.kernels.reference import cubemap as reference


def sample_cubemap(
    cubemap: Float[Tensor, "6 C L L"], directions: Float[Tensor, "P *K 3"], *, backend: Backend = "auto"
) -> Float[Tensor, "P C"]:
    """Look up a cubemap in the given directions, bilinearly and continuously across edges and corners; means over K
    directions where there are so many for each value.

    value = Σ_k w_k(s, t)·texel_k over the four texel centers around (s, t) = (s_c, t_c)/|m|, the central projection of
    the direction to its dominant face (ties: x before y before z; table 8.19). A texel beyond the border of a face is
    the texel straight across the edge; beyond a corner it is the mean of the three texels that meet there, so that
    the value at the corner itself is that mean as well.

    Directions are in world axes and need not be unit. A direction that is zero (every component below 1e-30) or not
    finite looks nowhere: its value is zero and so are its gradients.

    Gradients: to `cubemap`, which is `scatter_cubemap` of the cotangent (its summation order depends on the number of
    threads only), and to `directions`, exact within a texel cell; on the lines between cells, where the derivative
    jumps, one side's. The CPU kernel can be differentiated once.

    Raises ValueError for wrong shapes, mixed dtypes or devices, or a backend that can't take these tensors.
    Source: OpenGL 4.6 core profile, section 8.13; seams as in ARB_seamless_cube_map.
    """
    _check_cubemap(cubemap)
    _check_directions(directions)
    chosen = choose_backend(backend, cubemap=cubemap, directions=directions)
    if chosen == "cpu":
        from panoless.kernels.cpu.cubemap import SampleCubemap

        return SampleCubemap.apply(cubemap, directions)
    each = directions.reshape(-1, 3)
    if chosen == "reference":
        values = reference.sample_cubemap(cubemap, each)
    else:
        from panoless.kernels.gpu.cubemap import SampleCubemap as SampleCubemapGpu

        values = SampleCubemapGpu.apply(cubemap, each)
    return values if directions.ndim == 2 else values.unflatten(0, directions.shape[:2]).mean(1)


@torch.no_grad()
def scatter_cubemap(
    values: Float[Tensor, "P C"],
    directions: Float[Tensor, "P *K 3"],
    resolution: int,
    *,
    backend: Backend = "auto",
) -> Float[Tensor, "6 C L L"]:
    """Add values to the texels that `sample_cubemap` would read, with the same weights: its adjoint.

    ⟨sample_cubemap(E, d), w⟩ = ⟨E, scatter_cubemap(w, d, L)⟩ for every cubemap E of `resolution` L; so scattering ones
    gives the total weight that a set of rays puts on each texel. Directions as in `sample_cubemap`; those that look
    nowhere add nothing. The result carries no gradient.

    Raises ValueError for wrong shapes, mixed dtypes or devices, or a backend that can't take these tensors.
    """
    _check_directions(directions)
    _check_resolution(resolution)
    if values.ndim != 2 or len(values) != len(directions):
        raise ValueError(
            f"expected values (P, C), one row for each of the {len(directions)} directions; "
            f"found {tuple(values.shape)}."
        )
    chosen = choose_backend(backend, values=values, directions=directions)
    if chosen == "cpu":
        from panoless.kernels.cpu.cubemap import scatter_cubemap as scatter_means

        return scatter_means(values, directions, resolution)
    if directions.ndim == 3:
        count = directions.shape[1]
        values, directions = (values / count).repeat_interleave(count, 0), directions.reshape(-1, 3)
    if chosen == "reference":
        return reference.scatter_cubemap(values, directions, resolution)
    from panoless.kernels.gpu.cubemap import scatter_cubemap as scatter

    return scatter(values, directions, resolution)


@torch.no_grad()
def weigh_cubemap(
    cubemap: Float[Tensor, "6 C L L"],
    directions: Float[Tensor, "P *K 3"],
    weights: Float[Tensor, "P W"],
    *,
    backend: Backend = "auto",
) -> Float[Tensor, "6 C L L"]:
    """AᵀWA E, with A the lookup of `sample_cubemap` and W the weights, of all channels or of each: the product of the
    normal equations of a cubemap.

    It is `scatter_cubemap(weights · sample_cubemap(E, d), d, L)`, and carries no gradient. Raises as those do.
    """
    _check_cubemap(cubemap)
    _check_directions(directions)
    if weights.ndim != 2 or len(weights) != len(directions) or weights.shape[1] not in (1, cubemap.shape[1]):
        raise ValueError(
            f"expected weights (P, 1) or (P, {cubemap.shape[1]}), one row for each of the {len(directions)} "
            f"directions; found {tuple(weights.shape)}."
        )
    if choose_backend(backend, cubemap=cubemap, directions=directions, weights=weights) == "cpu":
        from panoless.kernels.cpu.cubemap import weigh_cubemap as weigh

        return weigh(cubemap, directions, weights)
    seen = sample_cubemap(cubemap, directions, backend=backend)
    return scatter_cubemap(weights * seen, directions, cubemap.shape[-1], backend=backend)


@torch.no_grad()
def lookup_gram(
    directions: Float[Tensor, "P 3"], weights: Float[Tensor, "P"], resolution: int, *, backend: Backend = "auto"
) -> Float[Tensor, "6 padded padded 5"]:
    """AᵀWA of the lookups of `sample_cubemap` in one direction a value, for products that cost nothing for a ray.

    The four texels that a lookup reads are neighbors on a padded face. So of each padded texel the matrix has five
    numbers: Σ w a², and Σ w a b with the neighbors b to the right, below, below to the right and below to the left.
    Those of directions that look nowhere are zero. Carries no gradient. Raises as `scatter_cubemap` does.
    """
    _check_directions(directions)
    _check_resolution(resolution)
    if directions.ndim != 2 or weights.shape != directions.shape[:1]:
        raise ValueError(
            f"expected one direction (P, 3) and one weight (P) a ray; found {tuple(directions.shape)} and "
            f"{tuple(weights.shape)}."
        )
    if choose_backend(backend, directions=directions, weights=weights) == "cpu":
        from panoless.kernels.cpu.cubemap_gram import lookup_gram as gram_of

        return gram_of(directions, weights, resolution)
    return reference.lookup_gram(directions, weights, resolution)


@torch.no_grad()
def apply_gram(
    gram: Float[Tensor, "6 padded padded 5"], cubemap: Float[Tensor, "6 C L L"], *, backend: Backend = "auto"
) -> Float[Tensor, "6 C L L"]:
    """The matrix of `lookup_gram` times a cubemap: what `weigh_cubemap` gives for the same rays, but for rounding."""
    _check_cubemap(cubemap)
    padded = cubemap.shape[-1] + 2
    if gram.shape != (6, padded, padded, 5):
        raise ValueError(f"expected a matrix of shape {(6, padded, padded, 5)} for this cubemap; found {gram.shape}.")
    if choose_backend(backend, gram=gram, cubemap=cubemap) == "cpu":
        from panoless.kernels.cpu.cubemap_gram import apply_gram as apply

        return apply(gram, cubemap)
    return reference.apply_gram(gram, cubemap)


def cubemap_directions(
    resolution: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Float[Tensor, "6 L L 3"]:
    """Unit world directions of all texel centers, as (face, row, column).

    d ∝ m + s·e_s + t·e_t with the outward axis m and the directions e_s, e_t of growing s and t of each face.
    Raises ValueError if `resolution` is not positive.
    """
    _check_resolution(resolution)
    return reference.cubemap_directions(resolution, dtype, torch.device(device))


def cubemap_solid_angles(
    resolution: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Float[Tensor, "L L"]:
    """Solid angle (sr) of every texel of a face; the same for all six, whose sum is 4π.

    Ω = F(s₁, t₁) − F(s₀, t₁) − F(s₁, t₀) + F(s₀, t₀), with F(s, t) = atan2(s·t, √(s² + t² + 1)) at the texel's corners.
    Computed in float64 and rounded to `dtype`. Raises ValueError if `resolution` is not positive.
    """
    _check_resolution(resolution)
    return reference.cubemap_solid_angles(resolution, dtype, torch.device(device))


def _check_cubemap(cubemap: Tensor) -> None:
    shape = tuple(cubemap.shape)
    if len(shape) != 4 or shape[0] != 6 or shape[2] != shape[3] or shape[2] < 1:
        raise ValueError(f"expected a cubemap (6, C, L, L) of square faces; found {shape}.")


def _check_directions(directions: Tensor) -> None:
    if directions.ndim not in (2, 3) or directions.shape[-1] != 3:
        raise ValueError(
            f"expected directions (P, 3) or (P, K, 3); found {tuple(directions.shape)}. Flatten image axes first."
        )


def _check_resolution(resolution: int) -> None:
    if resolution < 1:
        raise ValueError(f"expected at least one texel along a face; found a resolution of {resolution}.")
