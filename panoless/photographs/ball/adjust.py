"""All cameras, the cones of their balls and the points that balls mirror, in one least-squares adjustment.

A point X of the surroundings lies in the direction u from the ball's center at the inverse distance w, u/w = X. The
observation k of a camera with the rotation R leaves the ball at p = Rᵀ n in the direction y = Rᵀ ω, both of which move
with the cone. Its residual is y − (u − w p)/‖u − w p‖ across y, in units of its pixel's angle. Points are eliminated
(Schur complement), cones have their rims as a prior, and residuals a Geman–McClure loss, whose scale they set.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from panoless.numeric.cones import nearest_cone
from panoless.numeric.gauss_newton import damped_step
from panoless.numeric.robust import robust_weight
from panoless.photographs.ball.cone import BallCone
from panoless.photographs.ball.panorama import Features
from panoless.photographs.ball.rotations import Pair
from panoless.photographs.lens import Lens
from shinypartial.core.sphere import tangents

CONE_ROUNDS, WIDEST_COSINE = 10, 0.99999
"""Rounds of a rim's cone, and of half its angle (0.26°) the largest cosine."""
ROUNDS = 20
OF_VIEW = 6
RAYLEIGH_MEDIAN = 1.18
"""The median of ‖x‖ of two independent normal numbers, in standard deviations."""
INVERSE_DISTANCE = 0.1
"""Standard deviation of w before anything is seen, in inverse radii of the ball; at most NEAREST."""
NEAREST = 0.5
LEAST_SIGMA_RAD = 0.003
"""Of a feature's direction."""
SCALE = 2.0
"""Of the loss, in median residuals."""
CORRELATED = 9.0
"""By which variances are larger than those of independent features: cameras of traced balls are off by 2 to 4 times as
much."""


@dataclass(frozen=True)
class SeenBall:
    """A photograph's ball: the cone of its rim, and what it mirrors."""

    cone: BallCone
    sigma_rad: float
    """Standard deviation of the cone's axis, along each vector across it, and of its half angle."""
    features: Features


def cone_of(points_px: Float[np.ndarray, "K 2"], lens: Lens) -> tuple[BallCone, Float[np.ndarray, "K"]]:
    """The circular cone nearest to the rays of points, and how far (px) each is outside it."""
    found = nearest_cone(
        lens.rays(points_px), lens.fx, rounds=CONE_ROUNDS, scale_px=0.15, medians=2.0, widest_cosine=WIDEST_COSINE
    )
    return BallCone(found.axis, 1 / found.sine), found.off_px


@dataclass(frozen=True)
class Tracks:
    """Which features show the same point."""

    view: Int[np.ndarray, "P"]
    feature: Int[np.ndarray, "P"]
    track: Int[np.ndarray, "P"]
    count: int

    @classmethod
    def of(cls, pairs: Mapping[tuple[int, int], Pair]) -> "Tracks":
        """By joining matches, the surest pairs first, as long as no track has two features of one view."""
        parent: dict[tuple[int, int], tuple[int, int]] = {}
        views: dict[tuple[int, int], set[int]] = {}

        def root(node: tuple[int, int]) -> tuple[int, int]:
            while parent.setdefault(node, node) != node:
                node = parent[node]
            return node

        for (i, j), pair in sorted(pairs.items(), key=lambda item: item[1].log_nfa):
            for a, b in zip(pair.first.tolist(), pair.second.tolist(), strict=True):
                p, q = root((i, a)), root((j, b))
                of_p, of_q = views.setdefault(p, {p[0]}), views.setdefault(q, {q[0]})
                if p != q and not of_p & of_q:
                    parent[q] = p
                    of_p |= of_q
        number: dict[tuple[int, int], int] = {}
        rows = sorted((number.setdefault(root(node), len(number)), *node) for node in list(parent))
        track, view, feature = np.array(rows, np.int64).reshape(-1, 3).T
        long = np.bincount(track, minlength=len(number)) > 1 if len(track) else np.zeros(0, bool)
        kept = long[track]
        renumbered = np.cumsum(long) - 1
        return cls(view[kept], feature[kept], renumbered[track[kept]], int(long.sum()))


@dataclass(frozen=True)
class Adjusted:
    """Where cameras are, by all that balls mirror."""

    rotations: dict[int, Float[np.ndarray, "3 3"]]
    """World to camera."""
    cones: dict[int, BallCone]
    covariance: dict[int, Float[np.ndarray, "6 6"]]
    """Of a camera's turn (rad, world axes) and of the shift of its center (radii of the ball)."""
    residual_deg: float
    """Median angle between what is mirrored and where its point lies."""


@dataclass
class _State:
    rotations: Float[np.ndarray, "V 3 3"]
    steps: Float[np.ndarray, "V 3"]
    """Of the cones from their rims."""
    directions: Float[np.ndarray, "T 3"]
    inverse: Float[np.ndarray, "T"]


def adjust(
    balls: Sequence[SeenBall],
    rotations: Mapping[int, Float[np.ndarray, "3 3"]],
    pairs: Mapping[tuple[int, int], Pair],
) -> Adjusted:
    """Adjust the photographs that have a rotation."""
    members = sorted(rotations)
    place = {member: number for number, member in enumerate(members)}
    tracks = Tracks.of({key: pair for key, pair in pairs.items() if key[0] in place and key[1] in place})
    return _Adjustment([balls[i] for i in members], members, tracks).solved(np.stack([rotations[i] for i in members]))


class _Adjustment:
    def __init__(self, balls: Sequence[SeenBall], members: Sequence[int], tracks: Tracks) -> None:
        self.balls, self.members = balls, members
        place = {member: number for number, member in enumerate(members)}
        self.view = np.array([place[i] for i in tracks.view.tolist()], np.int64)
        self.track, self.count = tracks.track, tracks.count
        self.rows = [np.flatnonzero(self.view == v) for v in range(len(balls))]
        of_view = [tracks.feature[rows] for rows in self.rows]
        self.rays = [ball.features.seen.rays[chosen] for ball, chosen in zip(balls, of_view, strict=True)]
        self.sigma = np.zeros(len(self.view))
        for ball, rows, chosen in zip(balls, self.rows, of_view, strict=True):
            self.sigma[rows] = np.hypot(ball.features.sigma[chosen], LEAST_SIGMA_RAD)

    def _sighted(self, v: int, step: Float[np.ndarray, "3"]) -> Float[np.ndarray, "K 2 3"]:
        """ω and n of a view's observations."""
        seen = self.balls[v].cone.moved(step).along(self.rays[v])
        return np.stack([seen.directions, seen.normals], 1)

    def _observed(self, state: _State) -> tuple[Float[np.ndarray, "P 2 3"], Float[np.ndarray, "P 2 3 6"]]:
        """y and p in the world, and their derivatives by the six numbers of their view."""
        values, rows_of = np.zeros((len(self.view), 2, 3)), np.zeros((len(self.view), 2, 3, OF_VIEW))
        small = 1e-5
        for v, rows in enumerate(self.rows):
            if not len(rows):
                continue
            inverse, step = state.rotations[v].T, state.steps[v]
            at = self._sighted(v, step)
            values[rows] = at @ inverse.T
            # y = Rᵀ exp(−[τ]) ω for a turn τ of the camera's frame: dy = Rᵀ (ω × τ).
            for k in range(3):
                rows_of[rows, :, :, k] = np.cross(at, np.eye(3)[k]) @ inverse.T
                moved = self._sighted(v, step + small * np.eye(3)[k])
                rows_of[rows, :, :, 3 + k] = (moved - at) / small @ inverse.T
        return values, rows_of

    def _residuals(
        self, state: _State, values: Float[np.ndarray, "P 2 3"]
    ) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, "P 2 3"], Float[np.ndarray, "P 3"], Float[np.ndarray, "P"]]:
        """Residuals (in sigmas), the two vectors across y, the predicted directions, and ‖u − w p‖."""
        way = state.directions[self.track] - state.inverse[self.track, None] * values[:, 1]
        length = np.linalg.norm(way, axis=1)
        predicted = way / length[:, None]
        across = np.stack(tangents(values[:, 0]), 1)
        off = np.einsum("oki,oi->ok", across, values[:, 0] - predicted)
        behind = (values[:, 0] * predicted).sum(1) < 0
        off[behind] = 2.0
        return off / self.sigma[:, None], across, predicted, length

    def solved(self, rotations: Float[np.ndarray, "V 3 3"]) -> Adjusted:
        """In damped Gauss–Newton steps, whose scale follows the residuals."""
        views = len(self.balls)
        state = _State(rotations.copy(), np.zeros((views, 3)), np.zeros((self.count, 3)), np.zeros(self.count))
        values, _ = self._observed(state)
        np.add.at(state.directions, self.track, values[:, 0] / self.sigma[:, None] ** 2)
        state.directions /= np.maximum(np.linalg.norm(state.directions, axis=1, keepdims=True), 1e-9)
        prior = np.zeros(OF_VIEW * views)
        for v, ball in enumerate(self.balls):
            prior[OF_VIEW * v + 3 : OF_VIEW * v + 6] = 1 / ball.sigma_rad**2
        matrix = np.eye(len(prior))
        for _ in range(ROUNDS if len(self.view) else 0):
            gradient, matrix, back = self._reduced(state, prior)
            step = damped_step(gradient, matrix, 1e-6)
            self._move(state, step, back)
            if np.abs(step).max() < 1e-6:
                break
        return self._result(state, matrix)

    def _reduced(
        self, state: _State, prior: Float[np.ndarray, "D"]
    ) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"], Float[np.ndarray, "T 3 E"]]:
        """Gradient and matrix over views with points eliminated, in units of the residuals' own variance, and what
        gives the points' steps back.
        """
        values, rows_of = self._observed(state)
        off, across, predicted, length = self._residuals(state, values)
        size = np.linalg.norm(off, axis=1)
        unit = max(float(np.median(size)) / RAYLEIGH_MEDIAN, 0.05)
        weight = robust_weight(size, SCALE * RAYLEIGH_MEDIAN * unit) / unit**2
        inverse = state.inverse[self.track]
        # d(predicted) = (1 − d dᵀ)/‖v‖ (du − p dw − w dp)
        project = (np.eye(3) - predicted[:, :, None] * predicted[:, None]) / length[:, None, None]
        by_view = rows_of[:, 0] + inverse[:, None, None] * (project @ rows_of[:, 1])
        by_view = across @ by_view / self.sigma[:, None, None]
        sides = np.stack(tangents(state.directions), 2)[self.track]
        by_point = -project @ np.concatenate([sides, -values[:, 1][:, :, None]], 2)
        by_point = across @ by_point / self.sigma[:, None, None]
        size_all, weighted = len(prior), weight[:, None, None] * by_point
        of_points = np.zeros((self.count, 3, 3))
        np.add.at(of_points, self.track, weighted.transpose(0, 2, 1) @ by_point)
        of_points[:, 2, 2] += 1 / INVERSE_DISTANCE**2
        of_points += 1e-9 * np.eye(3)
        pull = np.zeros((self.count, 3))
        np.add.at(pull, self.track, np.einsum("oki,ok->oi", weighted, off))
        pull[:, 2] += state.inverse / INVERSE_DISTANCE**2
        columns = OF_VIEW * self.view[:, None] + np.arange(OF_VIEW)
        matrix, gradient = np.zeros((size_all, size_all)), np.zeros(size_all)
        squares = np.einsum("okd,o,oke->ode", by_view, weight, by_view)
        np.add.at(matrix, (columns[:, :, None], columns[:, None]), squares)
        np.add.at(gradient, columns, np.einsum("okd,o,ok->od", by_view, weight, off))
        mixed = np.zeros((self.count, 3, size_all))
        np.add.at(
            mixed,
            (self.track[:, None, None], np.arange(3)[None, :, None], columns[:, None]),
            weighted.transpose(0, 2, 1) @ by_view,
        )
        solved = np.linalg.solve(of_points, np.concatenate([mixed, pull[:, :, None]], 2))
        flat = mixed.reshape(-1, size_all)
        matrix -= flat.T @ solved[:, :, :-1].reshape(-1, size_all)
        gradient -= flat.T @ solved[:, :, -1].ravel()
        matrix[np.diag_indices(size_all)] += prior
        gradient += prior * np.concatenate([np.zeros((len(self.balls), 3)), state.steps], 1).ravel()
        return gradient, matrix, solved

    def _move(self, state: _State, step: Float[np.ndarray, "D"], back: Float[np.ndarray, "T 3 E"]) -> None:
        by_view = step.reshape(-1, OF_VIEW)
        moved = -back[:, :, -1] - back[:, :, :-1] @ step
        sides = np.stack(tangents(state.directions), 2)
        state.directions += np.einsum("tik,tk->ti", sides, np.clip(moved[:, :2], -0.2, 0.2))
        state.directions /= np.linalg.norm(state.directions, axis=1, keepdims=True)
        state.inverse = np.clip(state.inverse + moved[:, 2], 0.0, NEAREST)
        turns = Rotation.from_rotvec(by_view[:, :3]).as_matrix()
        state.rotations = turns @ state.rotations
        state.steps = state.steps + by_view[:, 3:]

    def _result(self, state: _State, matrix: Float[np.ndarray, "D D"]) -> Adjusted:
        values, _ = self._observed(state)
        off, *_ = self._residuals(state, values)
        angle = np.linalg.norm(off, axis=1) * self.sigma
        # Turns of all cameras together are no error: they are held at their mean.
        views = len(self.balls)
        fixed = matrix.copy()
        turn = np.zeros((len(matrix), 3))
        for v in range(views):
            turn[OF_VIEW * v : OF_VIEW * v + 3] = state.rotations[v]
        fixed += turn @ turn.T * np.trace(matrix) / len(matrix) / views
        spread = np.linalg.pinv(fixed, hermitian=True)
        cones = [ball.cone.moved(step) for ball, step in zip(self.balls, state.steps, strict=True)]
        covariance = {}
        for v, (member, cone) in enumerate(zip(self.members, cones, strict=True)):
            rotation = state.rotations[v]
            # The camera is at −Rᵀ d a: a turn τ of its frame moves it by −Rᵀ (a × τ) d, a step of the cone by its own.
            by = np.zeros((6, 6))
            by[:3, :3] = -rotation.T
            small = 1e-6
            for k in range(3):
                by[3:, k] = -rotation.T @ np.cross(cone.center, np.eye(3)[k])
                by[3:, 3 + k] = -rotation.T @ (cone.moved(small * np.eye(3)[k]).center - cone.center) / small
            block = slice(OF_VIEW * v, OF_VIEW * (v + 1))
            covariance[member] = CORRELATED * by @ spread[block, block] @ by.T
        return Adjusted(
            rotations=dict(zip(self.members, state.rotations, strict=True)),
            cones=dict(zip(self.members, cones, strict=True)),
            covariance=covariance,
            residual_deg=float(np.degrees(np.median(angle))) if len(angle) else 0.0,
        )
