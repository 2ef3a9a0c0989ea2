"""How sure poses are: the covariance that a bundle adjustment leaves.

A view at c with the rotation R to the world sees the point X at q(x), x = Rᵀ (X − c). When its camera is turned by ω
(rad, world axes) and shifted by τ, and the point moves by δX,

δq = ∂q/∂x Rᵀ ((X − c) × ω − τ + δX).

With all δq stacked as J, and the variance σ² of what is left of the places, the covariance is σ² (JᵀJ)⁻¹: that of
poses, focal lengths, k1 and points together, of which the blocks of the poses are taken.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import bsr_matrix, csr_matrix

from panoless.photographs.lens import Lens, opencv

#: Unknowns of a lens: its one focal length and k1.
LENS_UNKNOWNS = 2
#: What moves all cameras and points alike changes no picture: turns, shifts and the scale.
GAUGE = 7


@dataclass(frozen=True)
class SeenPoints:
    """Points that a view shows."""

    lens: Lens
    camera_to_world: Float[np.ndarray, "4 4"]
    numbers: Int[np.ndarray, "P"]
    """Which ones they are, from 0 on."""
    points_world: Float[np.ndarray, "P 3"]
    places_px: Float[np.ndarray, "P 2"]
    """Where they are seen, in OpenCV's pixels."""


def pose_covariances(views: Sequence[SeenPoints], *, known_points: bool) -> Float[np.ndarray, "V 6 6"] | None:
    """Of each camera's turn (rad, world axes) and shift (units of the world); None where there are too few places.

    Points that are not known are unknowns, too. Then what all cameras share is not determined, and it is taken out:
    the covariance is that of errors that turn, shift and scale the cameras as a whole as little as can be.
    """
    lenses = list(dict.fromkeys(view.lens for view in views))
    count = 6 * len(views) + LENS_UNKNOWNS * len(lenses)
    parts = [_derivatives(view) for view in views]
    residual = np.concatenate([part.residual for part in parts])
    cameras = _scattered(
        [np.concatenate([part.by_pose, part.by_lens], 1) for part in parts],
        [
            np.tile(
                [*range(6 * i, 6 * i + 6), *_lens_columns(len(views), lenses.index(view.lens))], (len(part.by_pose), 1)
            )
            for i, (view, part) in enumerate(zip(views, parts, strict=True))
        ],
        count,
    )
    matrix = (cameras.T @ cameras).toarray()
    unknowns = count
    gauge = np.zeros((count, 0))
    if not known_points:
        total = 1 + max(int(view.numbers.max(initial=-1)) for view in views)
        columns = [np.repeat(3 * view.numbers[:, None] + np.arange(3), 2, 0) for view in views]
        points = _scattered([part.by_point for part in parts], columns, 3 * total)
        matrix -= _explained_by_points(cameras, points, total)
        gauge = _gauge(views, count)
        unknowns += 3 * len(np.unique(np.concatenate([view.numbers for view in views]))) - GAUGE
    spare = len(residual) - unknowns
    if spare <= 0:
        return None
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))  # Radians, pixels and meters differ by decades.
    free = np.linalg.qr(gauge / scale[:, None])[0] if gauge.shape[1] else gauge
    scaled = matrix * np.outer(scale, scale) + free @ free.T
    covariance = (np.linalg.pinv(scaled, hermitian=True) - free @ free.T) * np.outer(scale, scale)
    blocks = [covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(len(views))]
    return np.array(blocks) * float(residual @ residual) / spare


@dataclass(frozen=True)
class _Derivatives:
    """Of the places of a view's points, x and y in turn."""

    residual: Float[np.ndarray, "N"]
    by_pose: Float[np.ndarray, "N 6"]
    by_lens: Float[np.ndarray, "N 2"]
    by_point: Float[np.ndarray, "N 3"]


def _derivatives(view: SeenPoints) -> _Derivatives:
    cv2, rotation, center = opencv(), view.camera_to_world[:3, :3], view.camera_to_world[:3, 3]
    turn = cv2.Rodrigues(rotation.T)[0]
    distortion = np.array(view.lens.distortion)
    places, jacobian = cv2.projectPoints(view.points_world, turn, -rotation.T @ center, view.lens.matrix, distortion)
    by_point = jacobian[:, 3:6] @ rotation.T
    away = np.repeat(view.points_world - center, 2, 0)
    # b · ((X − c) × ω) = ω · (b × (X − c))
    by_pose = np.concatenate([np.cross(by_point, away), -by_point], 1)
    by_lens = np.stack([jacobian[:, 6] + jacobian[:, 7], jacobian[:, 10]], 1)
    return _Derivatives((places[:, 0] - view.places_px).ravel(), by_pose, by_lens, by_point)


def _lens_columns(views: int, lens: int) -> list[int]:
    first = 6 * views + LENS_UNKNOWNS * lens
    return list(range(first, first + LENS_UNKNOWNS))


def _scattered(
    values: Sequence[Float[np.ndarray, "_ C"]], columns: Sequence[Int[np.ndarray, "_ C"]], width: int
) -> csr_matrix:
    """Rows of a sparse matrix from their values and the columns of these."""
    dense, places = np.concatenate(values), np.concatenate(columns)
    starts = np.arange(0, dense.size + 1, dense.shape[1])
    return csr_matrix((dense.ravel(), places.ravel(), starts), (len(dense), width))


def _explained_by_points(cameras: csr_matrix, points: csr_matrix, total: int) -> Float[np.ndarray, "N N"]:
    """W V⁻¹ Wᵀ: what moving points explain of what cameras do (Schur complement)."""
    own = (points.T @ points).tobsr((3, 3))
    blocks = np.zeros((total, 3, 3))
    row = np.repeat(np.arange(total), np.diff(own.indptr))
    blocks[row[row == own.indices]] = own.data[row == own.indices]
    inverses = np.linalg.pinv(blocks, hermitian=True)
    inverse = bsr_matrix((inverses, np.arange(total), np.arange(total + 1)), (3 * total, 3 * total))
    shared = cameras.T @ points
    explained: np.ndarray = (shared @ inverse @ shared.T).toarray()
    return explained


def _gauge(views: Sequence[SeenPoints], count: int) -> Float[np.ndarray, "N 7"]:
    """Turns about the world's axes, shifts along them and the scale, as changes of the unknowns."""
    centers = np.array([view.camera_to_world[:3, 3] for view in views])
    found = np.zeros((count, GAUGE))
    poses = found[: 6 * len(views)].reshape(len(views), 6, GAUGE)
    poses[:, :3, :3] = poses[:, 3:, 3:6] = np.eye(3)
    poses[:, 3:, :3] = np.cross(np.eye(3), centers[:, None]).transpose(0, 2, 1)
    poses[:, 3:, 6] = centers - centers.mean(0)
    return found
