"""Where the cameras of balls are: pairs of reflections that agree, their average, and the adjustment of all."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

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

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the others."""
        return tuple(ball.name for number, ball in enumerate(self.balls) if number not in self.members)

    def rim_px(self) -> float:
        """Median distance of rims from their cones: median over views."""
        off = [np.median(np.abs(cone_of(self.balls[i].rim.points, self.lenses[i])[1])) for i in self.members]
        return float(np.median(off))


def posed_balls(found: Sequence[FoundBall], lenses: Sequence[Lens]) -> PosedBalls:
    """Photographs with their rims, whose cones and rotations are adjusted to all that is mirrored.

    One whose reflections agree with no other is tried with other circles of it.
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
    adjusted = adjust(seen, average(group, pairs), pairs)
    moved = False
    for i in group:
        rim = _refound(balls[i], lenses[i], adjusted.cones[i])
        if rim is not None:
            balls[i], moved = replace(balls[i], rim=rim), True
            seen[i] = _seen(balls[i], lenses[i], features[i])
    if moved:
        adjusted = adjust(seen, adjusted.rotations, pairs)
    return PosedBalls(tuple(balls), tuple(lenses), tuple(sorted(group)), adjusted)


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
