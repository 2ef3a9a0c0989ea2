"""Matrices of least squares, made fit for a solution: symmetric, positive semidefinite, singular where data determine
too little.

What is regular stays as it is, to the bit. A matrix H that is singular up to rounding becomes H + d·diag(H): a
solution is then near zero in what is open.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from shinypartial.core.errors import InputError

if TYPE_CHECKING:
    from scipy.sparse import spmatrix

LEAST_DAMPING = 1e-9
"""As little as keeps a matrix regular where nothing determines a parameter; not tuned."""
LARGEST_ERROR = 1e-2
"""Of a solution that is known: with more, a sparse matrix counts as singular. Plates of ordinary hulls, whose rounding
grows with the pixels a voxel is smaller than, are below 3e-4."""


def require_finite(values: Float[np.ndarray, "*S"], what: str) -> Float[np.ndarray, "*S"]:
    """The same values; InputError where one is NaN or infinite. `what` names what they were to determine."""
    if not np.isfinite(values).all():
        raise InputError(
            expected=f"finite equations for {what}",
            found="NaN or infinity in them",
            remedy="Look for extreme numbers in the poses, their covariances, the focal lengths and the pictures.",
        )
    return values


def regularize(matrices: Float[np.ndarray, "*B D D"], what: str) -> Float[np.ndarray, "*B D D"]:
    """H, or H + (d + max(−λ, 0))·diag(H) where λ is not above D·ε times the largest eigenvalue: positive definite.

    λ is the least eigenvalue of H scaled to a diagonal of ones, so that units don't count, and ε the machine's
    precision. A diagonal that is not positive counts as one. Raises InputError for NaN and infinity.
    """
    size = matrices.shape[-1]
    diagonal = np.einsum("...ii->...i", require_finite(matrices, what))
    diagonal = np.where(diagonal > 0, diagonal, 1.0)
    roots = np.sqrt(diagonal)
    spectra = np.linalg.eigvalsh(matrices / roots[..., :, None] / roots[..., None, :])
    least, largest = spectra[..., 0], spectra[..., -1]
    is_singular = least <= size * np.finfo(np.float64).eps * largest
    damping = np.where(is_singular, LEAST_DAMPING + np.maximum(-least, 0), 0.0)
    return matrices + damping[..., None, None] * diagonal[..., None] * np.eye(size)


def factorize(matrix: "spmatrix", what: str) -> Callable[[Float[np.ndarray, "D"]], Float[np.ndarray, "D"]]:
    """The function b → x with H x = b, for a sparse H; with H + d·diag(H) where H is found singular.

    It is where a pivot is zero, and where the solution x of H x = H z has an error √h |x − z| above `LARGEST_ERROR`, h
    the diagonal and z = ±1/√h. A diagonal of zero counts as one. Raises InputError for NaN and infinity.
    """
    from scipy.sparse import diags

    compressed = matrix.tocsc()
    require_finite(compressed.data, what)
    diagonal = compressed.diagonal()
    diagonal = np.where(diagonal > 0, diagonal, 1.0)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(diagonal))
    known = signs / np.sqrt(diagonal)
    try:
        factors = _factors(compressed)
        error = np.abs(np.sqrt(diagonal) * factors.solve(compressed @ known) - signs).max(initial=0.0)
    except RuntimeError:  # SuperLU's word for a pivot of zero.
        error = np.inf
    if not error <= LARGEST_ERROR:
        factors = _factors((compressed + LEAST_DAMPING * diags(diagonal)).tocsc())
    solve: Callable[[Float[np.ndarray, "D"]], Float[np.ndarray, "D"]] = factors.solve
    return solve


def _factors(matrix: Any) -> Any:
    """An ordering for symmetric matrices, and pivots on the diagonal, fill in less than SuperLU's usual ones."""
    from scipy.sparse.linalg import splu

    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
