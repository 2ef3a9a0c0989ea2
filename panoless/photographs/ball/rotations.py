"""Rotations between cameras, by what a ball mirrors of surroundings that are far: pairs, then all at once.

A rotation R takes directions of one camera's frame to another's. Whether matches agree on one by chance is judged by
the number of false alarms (Moisan and Stival 2004): with n matches, of which k lie within an angle that chance hits
with probability p, after T trials, NFA = T · C(n, k) · p^(k−2). No threshold on angles or counts is needed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from scipy.special import gammaln

from panoless.numeric.robust import robust_weight
from panoless.photographs.ball.panorama import Features

TRIALS = 800
WIDEST_DEG = 8.0
"""Angle up to which matches may agree: a near room shifts what two sides of a ball mirror."""
LEAST_RATIO = 0.9
"""Of the distance of a match's descriptors to that of the second best, which lies at least so far away (deg):"""
APART_DEG = 4.0
SURE = np.log(1e-6)
"""Of the number of false alarms."""


@dataclass(frozen=True)
class Pair:
    """Two photographs whose reflections agree."""

    rotation: Float[np.ndarray, "3 3"]
    """From the frame of the first camera to that of the second."""
    log_nfa: float
    first: Int[np.ndarray, "K"]
    """Features of the first photograph, and…"""
    second: Int[np.ndarray, "K"]
    """…those of the second that show the same."""


def match(one: Features, two: Features) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """Features that are mutually the most alike, and clearly more so than others elsewhere."""
    if not len(one) or not len(two):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    alike = one.descriptors @ two.descriptors.T
    best, back = alike.argmax(1), alike.argmax(0)
    mutual = np.flatnonzero(back[best] == np.arange(len(best)))
    other = best[mutual]
    near = two.seen.directions[other] @ two.seen.directions.T > np.cos(np.radians(APART_DEG))
    second = np.where(near, -1, alike[mutual]).max(1)
    clear = np.sqrt(np.maximum(1 - alike[mutual, other], 0)) < LEAST_RATIO * np.sqrt(np.maximum(1 - second, 1e-9))
    return mutual[clear], other[clear]


def pair_of(one: Features, two: Features, generator: np.random.Generator) -> Pair | None:
    """The rotation on which most matches agree; None where they may do so by chance."""
    first, second = match(one, two)
    x, y = one.seen.directions[first], two.seen.directions[second]
    count = len(x)
    if count < 6:
        return None
    a, b = generator.integers(0, count, (2, TRIALS))
    apart = [np.clip((each[a] * each[b]).sum(1), -1, 1) for each in (x, y)]
    tried = (np.abs(apart[0]) < 0.95) & (np.abs(np.arccos(apart[0]) - np.arccos(apart[1])) < np.radians(APART_DEG))
    if not tried.any():
        return None
    a, b = a[tried], b[tried]
    rotations = np.einsum("tij,tkj->tik", _frames(y[a], y[b]), _frames(x[a], x[b]))
    k = np.arange(1, count + 1)
    ways = np.log(TRIALS) + gammaln(count + 1) - gammaln(k + 1) - gammaln(count - k + 1)

    def judged(tried: Float[np.ndarray, "T 3 3"]) -> tuple[float, int, Float[np.ndarray, "N"], float]:
        away = 1 - np.einsum("tij,nj,ni->tn", tried, x, y, optimize=True)
        ordered = np.sort(away, 1)
        alarms = ways + (k - 2) * np.log(np.clip(ordered / 2, 1e-6, 1))
        alarms[:, :3] = np.inf
        alarms[ordered > 1 - np.cos(np.radians(WIDEST_DEG))] = np.inf
        trial, number = np.unravel_index(alarms.argmin(), alarms.shape)
        return float(alarms[trial, number]), int(trial), away[trial], float(ordered[trial, number])

    alarm, trial, away, limit = judged(rotations)
    best = rotations[trial]
    for _ in range(4):
        within = away <= limit
        refined = best_rotation(x[within], y[within])
        again = judged(refined[None])
        if again[0] >= alarm:
            break
        best, (alarm, _, away, limit) = refined, again
    if not alarm < SURE:
        return None
    within = away <= limit
    return Pair(best, alarm, first[within], second[within])


def best_rotation(x: Float[np.ndarray, "P 3"], y: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "3 3"]:
    """The R that minimizes Σ ‖y − R x‖² (Kabsch 1976)."""
    left, _, right = np.linalg.svd(y.T @ x)
    found: np.ndarray = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return found


def _frames(p: Float[np.ndarray, "T 3"], q: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3 3"]:
    """Orthonormal frames of pairs of directions, as columns."""
    first, third = p + q, np.cross(p, q)
    first, third = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (first, third))
    return np.stack([first, np.cross(third, first), third], -1)


def largest_group(count: int, pairs: Mapping[tuple[int, int], Pair]) -> list[int]:
    """The photographs that most others are connected with, by pairs."""
    group = list(range(count))

    def root(i: int) -> int:
        while group[i] != i:
            i = group[i]
        return i

    for i, j in pairs:
        group[root(i)] = root(j)
    roots = [root(i) for i in range(count)]
    return [i for i in range(count) if roots[i] == max(set(roots), key=roots.count)]


def average(members: Sequence[int], pairs: Mapping[tuple[int, int], Pair]) -> dict[int, Float[np.ndarray, "3 3"]]:
    """World-to-camera rotations that agree best with those of pairs: along the surest pairs first, then robustly.

    Minimizes Σ √(−log NFA) ρ(‖log(R_jᵀ R_ij R_i)‖) by Gauss–Newton steps (Chatterjee and Govindu 2013).
    """
    inside = {key: pair for key, pair in pairs.items() if key[0] in members and key[1] in members}
    rotations = _along_the_surest(members, inside)
    place = {member: number for number, member in enumerate(sorted(members))}
    weight = {key: np.sqrt(-pair.log_nfa) for key, pair in inside.items()}
    for _ in range(50):
        off = {
            (i, j): Rotation.from_matrix(rotations[j].T @ pair.rotation @ rotations[i]).as_rotvec()
            for (i, j), pair in inside.items()
        }
        scale = max(float(np.median([np.linalg.norm(each) for each in off.values()])), 0.003) if off else 1.0
        laplacian, right = np.zeros((len(place), len(place))), np.zeros((len(place), 3))
        for (i, j), each in off.items():
            robust = weight[i, j] * float(robust_weight(each[None], scale)[0])
            p, q = place[i], place[j]
            laplacian[[p, q], [p, q]] += robust
            laplacian[[p, q], [q, p]] -= robust
            right[p] -= robust * each
            right[q] += robust * each
        step = np.linalg.lstsq(laplacian + 1e-9 * np.eye(len(place)), right, rcond=None)[0]
        for member, number in place.items():
            rotations[member] = rotations[member] @ Rotation.from_rotvec(step[number]).as_matrix()
        if np.abs(step).max() < 1e-7:
            break
    return rotations


def _along_the_surest(
    members: Sequence[int], pairs: Mapping[tuple[int, int], Pair]
) -> dict[int, Float[np.ndarray, "3 3"]]:
    """Rotations along a tree of pairs, the surest first."""
    rotations = {members[0]: np.eye(3)}
    while len(rotations) < len(members):
        reached = [key for key in pairs if (key[0] in rotations) != (key[1] in rotations)]
        i, j = min(reached, key=lambda key: pairs[key].log_nfa)
        if i in rotations:
            rotations[j] = pairs[i, j].rotation @ rotations[i]
        else:
            rotations[i] = pairs[i, j].rotation.T @ rotations[j]
    return rotations
