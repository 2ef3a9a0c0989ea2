"""Photographs of different exposure: brackets from one place become one picture, and all are brought to one exposure.

A pixel that shows c < 1 of a photograph with the exposure g has the radiance c/g, and the surer the more light it got:
L = Σ g c/Σ g² over the photographs in which it is not clipped; where all clip, the shortest says what it is at least.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float

from panoless.photographs.lens import opencv
from panoless.photographs.shot import Shot

SAME_PICTURE = 0.8
"""Of a bracket: so large a share of pixels lie on the same side of the median (Ward 2003)."""
EQUAL_STOPS = 0.07
"""Exposures that differ by less are equal."""
DARKEST = 0.004
"""Linear light below which a code is mostly noise."""


@dataclass(frozen=True)
class Exposed:
    """A view's light at the exposure that all views share."""

    radiance: Float[np.ndarray, "H W 3"] | None
    """None where all views have one exposure, and their pictures are 8-bit codes: these say it all."""
    unknown: Bool[np.ndarray, "H W"]
    """Where it is clipped though another view was exposed less."""

    @property
    def high_dynamic_range(self) -> bool:
        """Whether it is more than the codes of a picture."""
        return self.radiance is not None


def same_pose(shots: Sequence[Shot]) -> list[list[int]]:
    """Groups of photographs from one place that differ in exposure."""
    sides = cache(lambda number: _sides(shots[number]))
    groups: list[list[int]] = []

    def together(one: int, two: int) -> bool:
        return _differ(shots[one], shots[two]) and _alike(sides(one), sides(two))

    for number in range(len(shots)):
        group = next((group for group in groups if together(number, group[0])), None)
        if group is None:
            groups.append([number])
        else:
            group.append(number)
    return groups


def is_bracket(one: Shot, two: Shot) -> bool:
    """Whether two photographs show the same at different exposures."""
    return _differ(one, two) and _alike(_sides(one), _sides(two))


def _differ(one: Shot, two: Shot) -> bool:
    """Whether two photographs of one size were exposed differently."""
    return one.size == two.size and abs(_stops(one, two)) >= EQUAL_STOPS


def _sides(shot: Shot) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Which pixels are brighter than the median, and which are surely so or not."""
    gray = opencv().cvtColor(shot.codes(), opencv().COLOR_RGB2GRAY)
    bitmap, sure = opencv().createAlignMTB().computeBitmaps(gray)
    return bitmap > 0, sure > 0


def _alike(one: tuple[np.ndarray, np.ndarray], two: tuple[np.ndarray, np.ndarray]) -> bool:
    both = one[1] & two[1]
    return bool(both.any()) and float((one[0] == two[0])[both].mean()) > SAME_PICTURE


def _stops(one: Shot, two: Shot) -> float:
    """By how much the first was exposed more: as EXIF has it, else as pixels that neither clips have it."""
    if one.exposure and two.exposure:
        return float(np.log2(one.exposure / two.exposure))
    return float(np.log2(_ratio(one, two)))


def _ratio(one: Shot, two: Shot) -> float:
    first, second = (replace(shot, pixels=shot.pixels[::4, ::4]).radiance() for shot in (one, two))
    good = (first < one.clips_at) & (second < two.clips_at) & (first > DARKEST) & (second > DARKEST)
    return float(np.median(first[good] / second[good])) if good.sum() > 100 else 1.0


def exposed(groups: Sequence[Sequence[Shot]]) -> list[Exposed]:
    """The light of each group at the exposure of the median photograph."""
    shots = [shot for group in groups for shot in group]
    if all(shot.exposure for shot in shots):
        gains = {id(shot): float(shot.exposure or 1) for shot in shots}
    else:
        gains = {id(shot): _ratio(shot, group[0]) for group in groups for shot in group}
    middle = float(np.median(list(gains.values())))
    gains = {key: gain / middle for key, gain in gains.items()}
    equal = max(gains.values()) / min(gains.values()) < 2**EQUAL_STOPS
    codes = all(shot.pixels.dtype == np.uint8 for shot in shots)
    shortest = min(gains.values())
    found = []
    for group in groups:
        if equal and codes:
            found.append(Exposed(None, np.zeros(group[0].pixels.shape[:2], bool)))
            continue
        total = np.zeros(group[0].pixels.shape, np.float32)
        weight = np.zeros(total.shape[:2], np.float32)
        least = min(group, key=lambda shot: gains[id(shot)])
        for shot in group:
            gain, light = gains[id(shot)], shot.radiance()
            good = (light < shot.clips_at).all(-1) | (shot is least)
            total += np.where(good[..., None], gain * light, 0)
            weight += np.where(good, gain**2, 0)
        clipped = (least.radiance() >= least.clips_at).any(-1)
        unknown = clipped & (gains[id(least)] > shortest * 2**EQUAL_STOPS)
        found.append(Exposed(total / weight[..., None], unknown))
    return found
