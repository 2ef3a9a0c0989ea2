"""Where the cameras of balls are: pairs of reflections that agree, their average, and the adjustment of all."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from panoless.numeric.robust import bounded_error
from panoless.photographs.ball.adjust import Adjusted, SeenBall, adjust, cone_of
from panoless.photographs.ball.cone import BallCone
from panoless.photographs.ball.find import FoundBall, hidden
from panoless.photographs.ball.panorama import Features, features_of
from panoless.photographs.ball.rim import Circle, Rim, find_rim
from panoless.photographs.ball.rotations import Pair, average, largest_group, pair_of
from panoless.photographs.lens import Lens
from shinypartial.io.progress import Progress
from shinypartial.io.threads import in_threads

RIM_SIGMA_PX = 0.3
"""Of a rim's cone, at least."""
AGREES_RAD = np.radians(5.0)
"""Angle from which a match disagrees, rather than not: rims that are off by pixels of small balls turn what they mirror
by degrees."""
REFOUND_PX = 1.0
"""A rim that reflections move by more is looked for once more, beside where they have it."""
REFOUND_SEEN = 0.8
"""Share of what was seen of it before that must be seen again."""


@dataclass(frozen=True)
class PosedBalls:
    """Photographs, those of them whose reflections agree, and where their cameras are."""

    balls: tuple[FoundBall, ...]
    lenses: tuple[Lens, ...]
    members: tuple[int, ...]
    adjusted: Adjusted
    stated_unexplained: float | None = None
    """Share of matches that disagree under rotations of another program; None where there are none."""
    by_stated: bool = False
    """Whether these explain more, and were kept."""

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the others."""
        return tuple(ball.name for number, ball in enumerate(self.balls) if number not in self.members)

    def rim_px(self) -> float:
        """Median distance of rims from their cones: median over views."""
        off = [np.median(np.abs(cone_of(self.balls[i].rim.points, self.lenses[i])[1])) for i in self.members]
        return float(np.median(off))


def posed_balls(
    found: Sequence[FoundBall],
    lenses: Sequence[Lens],
    stated: Mapping[int, Float[np.ndarray, "3 3"]] = MappingProxyType({}),
) -> PosedBalls:
    """Photographs with their rims, whose cones and rotations are adjusted to all that is mirrored.

    One whose reflections agree with no other is tried with other circles of it. Where another program `stated`
    rotations (world to camera) of all that agree, and these explain more, the adjustment starts from them.
    """
    balls, features = list(found), _features(found, lenses)
    pairs = _pairs(features, list(combinations(range(len(balls)), 2)))
    group = largest_group(len(balls), pairs)
    for number in set(range(len(balls))) - set(group) if len(balls) > 1 else ():
        for circle in balls[number].candidates[1:]:
            other = balls[number].with_circle(circle)
            tried = [*features[:number], _features_of(other, lenses[number]), *features[number + 1 :]]
            beside = group if len(group) > 1 else range(len(balls))
            more = _pairs(tried, [(min(number, k), max(number, k)) for k in beside if k != number])
            if more:
                balls[number], features = other, tried
                pairs |= more
                group = largest_group(len(balls), pairs)
                break
    seen = [_seen(*each) for each in zip(balls, lenses, features, strict=True)]
    adjusted, unexplained, by_stated = adjust(seen, average(group, pairs), pairs), None, False
    if len(group) > 1 and all(i in stated for i in group):
        given = {i: stated[i] for i in group}
        unexplained = disagreement(features, given, pairs)
        by_stated = unexplained < disagreement(features, adjusted.rotations, pairs)
        adjusted = adjust(seen, given, pairs) if by_stated else adjusted
    moved = False
    for i in group:
        rim = _refound(balls[i], lenses[i], adjusted.cones[i])
        if rim is not None:
            balls[i], moved = replace(balls[i], rim=rim), True
            seen[i] = _seen(balls[i], lenses[i], features[i])
    if moved:
        adjusted = adjust(seen, adjusted.rotations, pairs)
    return PosedBalls(tuple(balls), tuple(lenses), tuple(sorted(group)), adjusted, unexplained, by_stated)


def disagreement(
    features: Sequence[Features],
    rotations: Mapping[int, Float[np.ndarray, "3 3"]],
    pairs: Mapping[tuple[int, int], Pair],
) -> float:
    """Mean of θ²/(θ² + s²) over matches in far surroundings, θ the angle between both directions, s = 5°."""
    angles = []
    for (one, two), pair in pairs.items():
        if one in rotations and two in rotations:
            x = features[one].seen.directions[pair.first] @ rotations[one]
            y = features[two].seen.directions[pair.second] @ rotations[two]
            angles.append(np.arccos(np.clip((x * y).sum(1), -1, 1)))
    return float(bounded_error(np.concatenate(angles), AGREES_RAD).mean())


def _features(balls: Sequence[FoundBall], lenses: Sequence[Lens]) -> list[Features]:
    """Of all photographs; a single one is compared with none."""
    if len(balls) == 1:
        return [Features.none(cone_of(balls[0].rim.points, lenses[0])[0])]
    progress = Progress("comparing reflections", len(balls))

    def work(view: tuple[FoundBall, Lens]) -> Features:
        found = _features_of(*view)
        progress.advance()
        return found

    return list(in_threads(work, zip(balls, lenses, strict=True)))


def _features_of(ball: FoundBall, lens: Lens) -> Features:
    return features_of(ball.gray, cone_of(ball.rim.points, lens)[0], lens, hidden(ball))


def _pairs(features: Sequence[Features], keys: Sequence[tuple[int, int]]) -> dict[tuple[int, int], Pair]:
    def work(key: tuple[int, int]) -> Pair | None:
        return pair_of(features[key[0]], features[key[1]], np.random.default_rng(key))

    found = in_threads(work, keys)
    return {key: pair for key, pair in zip(keys, found, strict=True) if pair is not None}


def _seen(ball: FoundBall, lens: Lens, features: Features) -> SeenBall:
    cone, off = cone_of(ball.rim.points, lens)
    return SeenBall(cone, max(RIM_SIGMA_PX, float(np.median(np.abs(off)))) / lens.fx, features)


def _refound(ball: FoundBall, lens: Lens, cone: BallCone) -> Rim | None:
    """The rim near a cone that reflections moved; None where it stays, or where little of one is seen."""
    center = lens.project(cone.axis)
    radius = float(lens.fx * np.tan(cone.half_angle))
    circle = ball.rim.circle
    if np.hypot(center[0] - circle.x, center[1] - circle.y) + abs(radius - circle.radius) < REFOUND_PX:
        return None
    rim = find_rim(ball.gray, Circle(float(center[0]), float(center[1]), radius))
    return rim if rim.seen.mean() > REFOUND_SEEN * ball.rim.seen.mean() else None
