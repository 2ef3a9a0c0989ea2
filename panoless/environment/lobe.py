"""What a slightly rough mirror shows of a map.

The facets of a rough surface are tilted by the distribution of Trowbridge and Reitz (GGX; Walter et al. 2007) with
α = roughness², as Blender's principled shader has it. Seen from the front, it mirrors the share

    α² / (α² + tan²(ψ/2))

of the light from more than ψ beside the mirrored direction: a core of a degree with tails so long that lamps veil all
around them. Here that lobe is B = Σ wⱼ Gⱼ, blurs of the sphere whose widths double, and a pixel shows A B E, with A the
mean over its area. Grazing light is spread less across the plane of incidence; the lobe is round here all the same.
"""

import math
import warnings
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from panoless.environment.options import COARSEST, halves_whole
from panoless.kernels.cubemap import cubemap_directions, cubemap_solid_angles, sample_cubemap, scatter_cubemap

WIDTHS_RAD = tuple(0.005 * 2.0**level for level in range(9))
"""Standard deviations of the blurs. Their sum meets lobes of any α up to 0.25 to 1 % of the light within any angle."""
TEXELS_PER_WIDTH = 0.88
"""A blur works on the coarsest map whose mean texels are no wider than its standard deviation over this."""
CUT = 3.0
"""Standard deviations where a blur ends."""
_Pair = tuple[Any, ...]


def lobe_weights(roughness: float, by_cosine: bool = False) -> Float[np.ndarray, "K"]:
    """The weights wⱼ of the blurs for a roughness in (0, 0.5], nonnegative with the sum 1.

    By least squares of the light in rings about the mirrored direction, each in units of the root of what it holds.
    With `by_cosine` light counts by cos ψ where that is positive, as the first sum of Karis (2013) has it, and a
    roughness may be up to 1: the light within any angle is met to 0.02 up to 0.5, and to 0.1 at 1.
    """
    from scipy.optimize import nnls

    alpha = roughness**2
    angles = np.concatenate([[0], np.geomspace(alpha / 8, 0.999 * math.pi, 60)])
    rings = -np.diff(alpha**2 / (alpha**2 + np.tan(angles / 2) ** 2))
    if by_cosine:
        rings = rings * np.cos((angles[1:] + angles[:-1]) / 2).clip(0)
        rings /= rings.sum()
    # Rings below the horizon hold nothing then; blurs can't avoid them.
    least = 1e-2 if by_cosine else 1e-4
    precision = 1 / np.array(WIDTHS_RAD) ** 2
    blurs = -np.diff(np.exp((np.cos(angles)[:, None] - 1) * precision), axis=0) / -np.expm1(-2 * precision)
    unit = 1 / np.sqrt(rings + least)
    weights = nnls(unit[:, None] * blurs, unit * rings)[0]
    found: np.ndarray = weights / weights.sum()
    return found


@dataclass(frozen=True)
class _Blur:
    """G: a map averaged to coarser texels, blurred there, and looked up at the centers of the fine ones again."""

    fine: int
    coarse: int
    matrix: Any
    """Sparse, over the coarse texels; None where these blur as much themselves."""

    def blurred(self, image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C L L"]:
        """G E."""
        coarse = self._averaged(image)
        if self.matrix is not None:
            coarse = _as_map(self.matrix @ _as_rows(coarse), image)
        if self.coarse == self.fine:
            return coarse
        return _as_map(sample_cubemap(coarse, _centers(self.fine).to(image)), image)

    def shrunk(self, image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C M M"]:
        """G E on the coarser texels. Gradient: to the map."""
        coarse = self._averaged(image)
        if self.matrix is not None:
            rows = coarse.permute(0, 2, 3, 1)
            pair = self._matrix_pair(image.device)
            coarse = _Product.apply(pair, rows.flatten(0, 2)).view(rows.shape).permute(0, 3, 1, 2).contiguous()
        return coarse

    def _matrix_pair(self, device: torch.device) -> _Pair:
        """The matrix and its transpose, scipy's on the CPU and torch's elsewhere."""
        if device not in self._pairs:
            pair = self.matrix, self.matrix.T
            self._pairs[device] = pair if device.type == "cpu" else tuple(_torch_matrix(each, device) for each in pair)
        return self._pairs[device]

    @cached_property
    def _pairs(self) -> dict[torch.device, _Pair]:
        return {}

    def gathered(self, image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C L L"]:
        """Gᵀ E."""
        coarse, ratio = image, self.fine // self.coarse
        if ratio > 1:
            rows = image.permute(0, 2, 3, 1).flatten(0, 2).contiguous()
            coarse = scatter_cubemap(rows, _centers(self.fine).to(image), self.coarse)
        if self.matrix is not None:
            coarse = _as_map(self.matrix.T @ _as_rows(coarse), image)
        if ratio == 1:
            return coarse
        area = self._area(image)
        share = coarse / (avg_pool2d(area, ratio) * ratio**2)
        return share.repeat_interleave(ratio, 2).repeat_interleave(ratio, 3) * area

    def _averaged(self, image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C M M"]:
        """Means over the coarser texels, by solid angle."""
        ratio = self.fine // self.coarse
        if ratio == 1:
            return image
        area = self._area(image)
        return avg_pool2d(image * area, ratio) / avg_pool2d(area, ratio)

    def _area(self, image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "1 1 L L"]:
        area = cubemap_solid_angles(self.fine).to(image)
        return (area / area.mean())[None, None]


@dataclass(frozen=True)
class Lobe:
    """B: what a mirror of some roughness shows of maps of one size. It keeps what is the same everywhere."""

    blurs: tuple[_Blur, ...]
    weights: tuple[float, ...]

    @classmethod
    def of(cls, roughness: float | None, resolution: int) -> "Lobe":
        """Of a roughness in (0, 0.5] and maps with so many texels along a face side, which `halves_whole`; None is a
        smooth mirror, whose lobe is a point.
        """
        if roughness is None:
            return cls((_Blur(resolution, resolution, None),), (1.0,))
        found = [(index, float(each)) for index, each in enumerate(lobe_weights(roughness)) if each > 0]
        return cls(
            tuple(_blur(WIDTHS_RAD[index], resolution) for index, _ in found), tuple(weight for _, weight in found)
        )

    def blurred(self, image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C L L"]:
        """B E: the light that arrives at the eye by each mirrored direction."""
        return torch.stack([w * each.blurred(image) for w, each in zip(self.weights, self.blurs, strict=True)]).sum(0)

    def gathered(self, image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C L L"]:
        """Bᵀ E, the adjoint."""
        return torch.stack([w * each.gathered(image) for w, each in zip(self.weights, self.blurs, strict=True)]).sum(0)


@dataclass(frozen=True)
class Lobes:
    """What mirrors of several roughnesses show of maps of one size: their lobes weigh the same blurs."""

    blurs: tuple[_Blur, ...]
    weights: Float[np.ndarray, "N K"]
    """Of every blur, the last of them none, in each of the lobes."""

    @classmethod
    def by_cosine(cls, roughnesses: tuple[float, ...], resolution: int) -> "Lobes":
        """Of roughnesses in [0, 1] and maps as in `Lobe.of`, light counted by the cosine (see `lobe_weights`)."""
        smooth = np.eye(1 + len(WIDTHS_RAD))[-1]
        rows = [smooth if each == 0 else np.append(lobe_weights(each, by_cosine=True), 0.0) for each in roughnesses]
        blurs = (*(_blur(width, resolution) for width in WIDTHS_RAD), _Blur(resolution, resolution, None))
        weights = np.stack(rows)
        used = weights.any(0)
        return cls(tuple(blur for blur, use in zip(blurs, used, strict=True) if use), weights[:, used])

    def pyramid(self, image: Float[Tensor, "6 C L L"]) -> list[Float[Tensor, "6 C M M"]]:
        """The map by each blur, with as few texels as that leaves. Gradient: to the map."""
        return [blur.shrunk(image) for blur in self.blurs]


class _Product(torch.autograd.Function):
    """The first of two sparse matrices times rows; the second is its transpose, and both are scipy's or torch's."""

    @staticmethod
    def forward(ctx, pair, rows):
        ctx.pair = pair
        return _times(pair[0], rows.detach())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, cotangent):
        return None, _times(ctx.pair[1], cotangent)


def _times(matrix: Any, rows: Float[Tensor, "P C"]) -> Float[Tensor, "Q C"]:
    return matrix @ rows if isinstance(matrix, Tensor) else torch.as_tensor(matrix @ rows.numpy()).to(rows)


def _torch_matrix(matrix: Any, device: torch.device) -> Tensor:
    rows = matrix.tocsr()
    starts, columns, values = (torch.from_numpy(each).to(device) for each in (rows.indptr, rows.indices, rows.data))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta state")
        return torch.sparse_csr_tensor(starts, columns, values, size=rows.shape, check_invariants=True)


def _as_rows(image: Float[Tensor, "6 C M M"]) -> Float[np.ndarray, "P C"]:
    rows: np.ndarray = image.permute(0, 2, 3, 1).flatten(0, 2).cpu().numpy()
    return rows


def _as_map(rows: Any, like: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C M M"]:
    side = math.isqrt(len(rows) // 6)
    return torch.as_tensor(rows).to(like).view(6, side, side, -1).permute(0, 3, 1, 2).contiguous()


@lru_cache(maxsize=4)
def _centers(resolution: int) -> Float[Tensor, "P 3"]:
    return cubemap_directions(resolution).reshape(-1, 3)


@lru_cache(maxsize=32)
def _blur(width_rad: float, resolution: int) -> _Blur:
    """A Gaussian of that standard deviation, less what averaging to coarser texels and bilinear look-ups blur."""
    from scipy import sparse
    from scipy.spatial import cKDTree

    assert halves_whole(resolution), "blurs work on halves, quarters and so on of the texels"
    coarse = resolution
    while coarse > COARSEST and width_rad > TEXELS_PER_WIDTH * _texel_rad(coarse // 2):
        coarse //= 2
    texel = _texel_rad(coarse)
    averaged = 0.0 if coarse == resolution else texel**2 / 12 + _texel_rad(resolution) ** 2 / 6
    variance = width_rad**2 - texel**2 / 6 - averaged
    if variance < (texel / 3) ** 2:
        return _Blur(resolution, coarse, None)
    centers = cubemap_directions(coarse, dtype=torch.float64).reshape(-1, 3).numpy()
    reach = 2 * math.sin(min(CUT * math.sqrt(variance), math.pi) / 2)
    pairs = cKDTree(centers).query_pairs(reach, output_type="ndarray")
    each = np.arange(len(centers))
    rows, columns = (np.concatenate([pairs[:, side], pairs[:, 1 - side], each]) for side in (0, 1))
    apart = ((centers[rows] - centers[columns]) ** 2).sum(1)
    area = np.tile(cubemap_solid_angles(coarse, dtype=torch.float64).numpy().ravel(), 6)
    values = np.exp(-apart / (2 * variance)) * area[columns]
    values /= np.bincount(rows, values)[rows]
    return _Blur(resolution, coarse, sparse.csr_matrix((values.astype(np.float32), (rows, columns))))


def _texel_rad(resolution: int) -> float:
    """The side of a square of the mean solid angle of a texel."""
    return math.sqrt(4 * math.pi / 6) / resolution
