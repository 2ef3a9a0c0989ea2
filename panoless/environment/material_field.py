"""What differs from place to place on the surface: labels, glaze, dirt.

On the vertices v of a lattice about the surface, the share of light that is mirrored changes by Δs(v) and the scattered
radiance by Δd(v); between them both are trilinear. Pixels at x with the light E of the mirrored direction differ from
what an even material shows by

y = E Δs(x) + Δd(x),

which is linear in both. A light that varies from view to view separates the two.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from panoless.numeric.conjugate_gradients import solve_by_products
from panoless.numeric.robust import bounded_error, robust_weight

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

SMOOTHNESS = 0.1
"""Weight of a squared difference between neighboring vertices, in pixels that see a vertex."""
PULL = 0.003
"""Weight of the square of Δs and Δd, likewise."""
ROBUST_SCALES = (1.0, 0.3)
"""Residuals (linear radiance) beyond which pixels lose their vote, round by round: under a narrow one, those of a label
lose it before any change explains them."""
JUDGED_SCALE = 0.1
"""Residual (linear radiance) that counts half as an error."""
LARGEST_SHARE_LEFT = 0.5
"""Of the error at a vertex, that a change there may leave: wrong normals look like another material, but what they show
still varies."""
STEPS = 30
"""Most, of conjugate gradients."""
TOLERANCE = 1e-3
"""Share of the preconditioned residual at which they end."""


@dataclass(frozen=True)
class MaterialField:
    """Δs and Δd on vertices of a lattice of `cells`³ cells over the cube [−1, 1]³ of the normalized frame."""

    cells: int
    vertices: Int[np.ndarray, "N"]
    """Flat indices, ascending."""
    share: Float[np.ndarray, "N 3"]
    """Δs of red, green and blue, at normal incidence."""
    scattered: Float[np.ndarray, "N 3"]
    """Δd: linear radiance."""

    @property
    def extent(self) -> float:
        """Share of the vertices at which the material differs."""
        differs = self.share.any(1) | self.scattered.any(1)
        return float(differs.mean()) if len(differs) else 0.0

    def exposed(self, factor: float) -> "MaterialField":
        """The same in light that many times as bright."""
        return replace(self, scattered=factor * self.scattered)

    def at(self, points: Float[np.ndarray, "P 3"]) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
        """Δs and Δd at points, zero beside all vertices."""
        corners, weights = lattice_corners(points, self.cells)
        place = np.searchsorted(self.vertices, corners).clip(0, max(len(self.vertices) - 1, 0))
        weights = weights * (self.vertices[place] == corners)
        weights = weights / np.maximum(weights.sum(1, keepdims=True), 1e-9)
        share, scattered = (np.einsum("pk,pkc->pc", weights, each[place]) for each in (self.share, self.scattered))
        return share, scattered


@dataclass(frozen=True)
class MaterialPixels:
    """Pixels by the vertices around them."""

    cells: int
    vertices: Int[np.ndarray, "N"]
    lookup: "csr_matrix"
    """Trilinear weights, a row a pixel…"""
    adjoint: "csr_matrix"
    """…and a row a vertex."""
    penalty: "csr_matrix"
    """λ Σ (Δ(v) − Δ(v′))² + μ Σ Δ(v)² over pairs of neighbors, and over vertices."""

    @classmethod
    def of(cls, points: Float[np.ndarray, "P 3"], cells: int) -> "MaterialPixels":
        """Of pixels that see the surface there."""
        from scipy import sparse

        corners, weights = lattice_corners(points, cells)
        vertices, inverse = np.unique(corners, return_inverse=True)
        starts = np.arange(len(points) + 1) * corners.shape[1]
        lookup = sparse.csr_matrix((weights.ravel(), inverse.ravel(), starts), shape=(len(points), len(vertices)))
        penalty = SMOOTHNESS * _laplacian(vertices, cells) + PULL * sparse.identity(len(vertices), format="csr")
        return cls(cells, vertices, lookup, lookup.T.tocsr(), penalty)

    def field(
        self,
        light: Float[np.ndarray, "P 3"],
        residual: Float[np.ndarray, "P 3"],
    ) -> MaterialField:
        """As `fitted`; where more than a share of the error is left at a vertex, both changes are zero."""
        found = self.fitted(light, residual)
        changes = np.stack([found.share, found.scattered])
        left = residual - self._shown(changes, light)
        before, after = (self.adjoint @ bounded_error(each, JUDGED_SCALE) for each in (residual, left))
        changes *= (after < LARGEST_SHARE_LEFT * before)[:, None]
        return MaterialField(self.cells, self.vertices, changes[0], changes[1])

    def fitted(self, light: Float[np.ndarray, "P 3"], residual: Float[np.ndarray, "P 3"]) -> MaterialField:
        """min Σ w ‖y − E Δs − Δd‖² + λ Σ ‖Δ(v) − Δ(v′)‖² + μ Σ ‖Δ(v)‖², with Geman–McClure weights w."""
        changes, left = np.zeros((2, len(self.vertices), 3)), residual
        for scale in ROBUST_SCALES:
            changes = changes + self._step(changes, left, light, robust_weight(left, scale)[:, None])
            left = residual - self._shown(changes, light)
        return MaterialField(self.cells, self.vertices, changes[0], changes[1])

    def _step(
        self,
        changes: Float[np.ndarray, "2 N 3"],
        left: Float[np.ndarray, "P 3"],
        light: Float[np.ndarray, "P 3"],
        trust: Float[np.ndarray, "P 1"],
    ) -> Float[np.ndarray, "2 N 3"]:
        """From changes to the least squares of these weights."""

        def pulled(value: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "2 N 3"]:
            return np.stack([self.adjoint @ (trust * light * value), self.adjoint @ (trust * value)])

        def product(value: Float[np.ndarray, "2 N 3"]) -> Float[np.ndarray, "2 N 3"]:
            return pulled(self._shown(value, light)) + self._penalized(value)

        squares = self.adjoint.power(2)
        diagonal = np.stack([squares @ (trust * light**2), np.repeat(squares @ trust, 3, 1)])
        diagonal += self.penalty.diagonal()[:, None]
        return solve_by_products(product, pulled(left) - self._penalized(changes), 1 / diagonal, STEPS, TOLERANCE)

    def _penalized(self, changes: Float[np.ndarray, "2 N 3"]) -> Float[np.ndarray, "2 N 3"]:
        return np.stack([self.penalty @ each for each in changes])

    def _shown(self, changes: Float[np.ndarray, "2 N 3"], light: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """E Δs + Δd."""
        found: np.ndarray = light * (self.lookup @ changes[0]) + self.lookup @ changes[1]
        return found


def lattice_corners(
    points: Float[np.ndarray, "P 3"], cells: int
) -> tuple[Int[np.ndarray, "P 8"], Float[np.ndarray, "P 8"]]:
    """The corners of each point's cell as flat indices, and their trilinear weights."""
    place = (np.clip(points, -1, 1) + 1) / 2 * cells
    low = np.minimum(place.astype(np.int64), cells - 1)
    part = place - low
    offsets = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)
    corners = low[:, None] + offsets
    weights = np.where(offsets == 1, part[:, None], 1 - part[:, None]).prod(2)
    side = cells + 1
    return (corners[..., 0] * side + corners[..., 1]) * side + corners[..., 2], weights


def _laplacian(vertices: Int[np.ndarray, "N"], cells: int) -> "csr_matrix":
    """Σ (v − v′)² over neighbors along the axes, as a matrix."""
    from scipy import sparse

    side, count, pairs = cells + 1, len(vertices), []
    for step in (1, side, side**2):
        place = np.searchsorted(vertices, vertices + step).clip(0, count - 1)
        first = np.flatnonzero(vertices[place] == vertices + step)
        pairs.append(np.stack([first, place[first]], 1))
    first, second = np.concatenate(pairs).T
    ones = np.ones(len(first))
    joined = sparse.coo_matrix((ones, (first, second)), shape=(count, count))
    joined = (joined + joined.T).tocsr()
    return sparse.diags(np.asarray(joined.sum(1)).ravel()) - joined
