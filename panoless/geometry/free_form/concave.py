"""Concave starts: concavities under patches of the first surface that make pixels agree on what they mirror.

Silhouettes do not show the inside of a dish. It is searched by a few numbers: each candidate is traced, and its score
is the spread of colors among the rays that leave in the same direction, so no map is needed.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from panoless.capture.views import Views
from panoless.geometry.free_form.concavities import HALF_SIDE, SIDE, Chart, Concavity, Relief
from panoless.geometry.free_form.spread import FinalRays, disagreement
from panoless.geometry.free_form.surface import LevelSet
from panoless.journal import remembered
from panoless.numeric.evolution import evolve
from panoless.numeric.robust import bounded_error
from panoless.problem.observations import Pixels, solid_pixels
from panoless.problem.rays import PixelRays
from shinypartial.io.progress import Progress

RAYS = 40_000
"""About so many pixels of all views are traced against the surface that is searched."""
PIXELS = 2_500
"""Most of them under one concavity that score a candidate."""
LEAST_PIXELS = 300
"""Patches that fewer pixels see are left alone."""
CELLS = 40
"""Cells along the longest side of the box on which candidates are traced."""
BOUNCES = 3
"""Reflections through which a ray is traced: many pixels of a deep bowl need two or more."""
SCALE = 0.3
"""Color (linear radiance) beyond which disagreement counts no more: wide, so that the score falls early."""
LEAST_VARIETY = 1e-6
"""Disagreement with the mean color below which pixels show one color, which determines nothing."""
NEIGHBORHOOD = 0.12
"""Radius, in the normalized frame, over which the disagreement of pixels is averaged…"""
LEAST_DISAGREEMENT = 0.95
"""…and from which they are unexplained, in what pixels of any direction have."""
SETTLED_DISAGREEMENT = 0.35
"""Mean disagreement of a patch, after the coarse rounds, from which it may be a cap though no part of it is
unexplained: under a bright sky, pixels of a shallow dish agree with most others."""
LEAST_PART = 60
"""Parts of fewer unexplained pixels are left alone."""
WHOLE_SHARE = 0.6
"""A patch of which at least this share is unexplained is the cap of one concavity; else each part of it may be."""
SEEDS = 8
"""Points from which patches are grown."""
LID_ANGLE_DEG = 40.0
"""A patch is what lies within so much of its mean normal."""
LEAST_FACING = 0.1
"""Cosine between a patch's mean normal and that of a pixel in it."""
INSETS = (1.1, 1.0, 0.93, 0.86, 0.79)
"""Sizes of the first guesses, in those of the patch: a lip may lie beyond it."""
DEPTHS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.15, 1.3)
"""Their depths, in mean radii of the patch: the score is sharp within a tenth."""
EXPONENTS = (1.3, 1.7, 2.0, 2.5, 4.0)
"""Exponents p of their profiles ρᵖ + δᵖ = 1: from nearly a cone to nearly a box."""
FARTHEST_GUESS = 1.2
"""First guesses that disagree by more than so many times what the patch does lead to no descent."""
RESOLUTIONS = (6, 8, 12)
"""Cells along a face side in which directions are compared, from coarse to fine…"""
EVALUATIONS = (160, 200, 260)
"""…and candidates of a descent at each of them."""
DESCENTS = 3
"""From so many of the best first guesses at the first resolution."""
FIRST_STEPS = Concavity(np.full(2, 0.08), 0.06, np.full(4, 0.05), 0.08, np.full(3, 0.08), np.full(2, 0.08)).vector
"""First standard deviations of a concavity's numbers in a descent."""
LEAST_GAIN = 0.1
"""A concavity is kept if it lowers the disagreement under it by this share…"""
STANDARD_ERRORS = 4.0
"""…and by so many standard errors of the views' differences."""


@dataclass(frozen=True)
class Scored:
    """Pixels under a patch, and how badly they agree under a surface: 1 is as badly as pixels of any direction."""

    rays: PixelRays
    radiance: Float[np.ndarray, "P 3"]

    def by_pixel(self, surface: LevelSet, resolution: int) -> Float[np.ndarray, "P"]:
        """Disagreement of each pixel over the mean of what it has with the mean color."""
        final = FinalRays.of(surface, self.rays, BOUNCES)
        found = disagreement(final.directions, final.left, self.radiance, self.rays.view, resolution, SCALE)
        return found / max(float(bounded_error(self.radiance - self.radiance.mean(0), SCALE).mean()), LEAST_VARIETY)

    def __call__(self, surface: LevelSet, resolution: int) -> float:
        """The mean over pixels."""
        return float(self.by_pixel(surface, resolution).mean())


@dataclass(frozen=True)
class Patch:
    """A part of a surface under which a concavity may lie: its relief, its rim, and the pixels that see it."""

    relief: Relief
    size: float
    waves: Float[np.ndarray, "4"]
    scored: Scored
    in_the_mean: bool = False
    """Whether pixels disagree under it only in the mean, on no part of it by themselves."""


def concave_start(views: Views, surface: LevelSet, settled: LevelSet) -> LevelSet | None:
    """The surface with the concavities that make pixels agree better; None where there is none, or where the same
    surface explains all pixels once it is `settled` by steps.

    Concavities are searched under one patch after the other, on the surface that those before it left. Where pixels
    disagree under the settled surface only in the mean, concavities have to explain more than that one, too.
    """
    pixels = solid_pixels(views, RAYS)
    settled = settled.resampled(CELLS)

    def unexplained(chart: Chart, surface: LevelSet) -> Iterator[Patch]:
        return unexplained_patches(chart, surface, settled, pixels)

    patches = [patch for chart in charts(settled, pixels.rays) for patch in unexplained(chart, settled)]
    if not patches:
        return None
    in_the_mean = all(patch.in_the_mean for patch in patches)
    coarse, found = surface.resampled(CELLS), False
    for chart in charts(coarse, pixels.rays):
        for patch in unexplained(chart, coarse):
            concavity = searched(patch)
            carved = coarse if concavity is None else patch.relief.carved(concavity)
            rivals = [settled, coarse] if in_the_mean else [coarse]
            if concavity is not None and all(explains_better(carved, each, patch.scored) for each in rivals):
                coarse, found = carved, True
    return coarse if found else None


def explains_better(carved: LevelSet, before: LevelSet, scored: Scored) -> bool:
    """Whether pixels agree better by the least gain, and by more than chance would have it among views."""
    new, old = (scored.by_pixel(each, RESOLUTIONS[-1]) for each in (carved, before))
    gains = [float((old - new)[scored.rays.view == view].mean()) for view in np.unique(scored.rays.view)]
    noise = STANDARD_ERRORS * float(np.std(gains)) / max(len(gains), 1) ** 0.5
    return bool((old - new).mean() > max(LEAST_GAIN * old.mean(), noise))


def charts(surface: LevelSet, rays: PixelRays) -> Iterator[Chart]:
    """Over the patches that pixels see, each of them once: the largest first."""
    final = FinalRays.of(surface, rays, 0)
    met = np.flatnonzero((final.normals**2).sum(1) > 0.5)
    if len(met) < LEAST_PIXELS:
        return
    points, normals = final.points[met], final.normals[met]
    least, found = np.cos(np.radians(LID_ANGLE_DEG)), list[tuple[int, Chart]]()
    for seed in _far_apart(points, SEEDS):
        normal, members = normals[seed], np.arange(0)
        for _ in range(6):
            members = np.flatnonzero(normals @ normal > least)
            if not len(members):
                break
            normal = normals[members].mean(0)
            normal /= np.linalg.norm(normal)
        if len(members) < LEAST_PIXELS or any(known.axes[2] @ normal > least for _, known in found):
            continue
        middle = (points[members].min(0) + points[members].max(0)) / 2
        across = np.linalg.norm(np.cross(points[members] - middle, normal), axis=1)
        found.append((len(members), Chart.about(middle, normal, float(np.quantile(across, 0.9)))))
    for _, chart in sorted(found, key=lambda each: -each[0]):
        yield chart


def _far_apart(points: Float[np.ndarray, "P 3"], count: int) -> list[int]:
    """Indices of points, the first in the middle, each as far from those before it as can be."""
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmin())]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    for _ in range(count - 1):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def unexplained_patches(chart: Chart, surface: LevelSet, settled: LevelSet, pixels: Pixels) -> Iterator[Patch]:
    """The part of a surface that faces a chart where pixels disagree on most of it; else each part where they do. Where
    they do nowhere, the whole again if they still disagree in the mean under a surface that is `settled`.
    """
    relief = Relief(surface, chart)
    size, waves = rim_of(relief)
    whole = patch_inside(relief, size, waves, pixels)
    if whole is None:
        return
    final = FinalRays.of(surface, whole.scored.rays, 0)
    parts = unexplained_parts(final.points, whole.scored.by_pixel(surface, RESOLUTIONS[-1]))
    disagreed = not parts and whole.scored(settled, RESOLUTIONS[-1]) > SETTLED_DISAGREEMENT
    if disagreed or sum(map(len, parts)) > WHOLE_SHARE * len(final.points):
        yield replace(whole, in_the_mean=disagreed)
        return
    for part in parts:
        about, ratio = chart_about(final.points[part], final.normals[part])
        waves = np.array([np.log(ratio) / 2, 0.0, 0.0, 0.0])
        patch = patch_inside(Relief(surface, about), 0.0, waves, pixels)
        if patch is not None:
            yield patch


def unexplained_parts(
    points: Float[np.ndarray, "P 3"], disagreed: Float[np.ndarray, "P"], neighborhood: float = NEIGHBORHOOD
) -> list[Int[np.ndarray, "M"]]:
    """Indices of points where they disagree around, by connected parts: the largest first."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    tree, count = cKDTree(points), len(points)
    near = tree.query_pairs(neighborhood, output_type="ndarray")
    total, number = disagreed.copy(), np.ones(count)
    for one, other in (near.T, near.T[::-1]):
        total += np.bincount(one, disagreed[other], count)
        number += np.bincount(one, minlength=count)
    bad = total / number > LEAST_DISAGREEMENT
    joined = near[bad[near].all(1)]
    links = coo_matrix((np.ones(len(joined)), joined.T), shape=(count, count))
    label = connected_components(links, directed=False)[1]
    parts = [np.flatnonzero(bad & (label == each)) for each in np.unique(label[bad])]
    return sorted((part for part in parts if len(part) >= LEAST_PART), key=len, reverse=True)


def chart_about(points: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"]) -> tuple[Chart, float]:
    """A chart over points along the axes of the ellipse that they fill, and the ratio of these."""
    normal = normals.mean(0) / max(float(np.linalg.norm(normals.mean(0))), 1e-12)
    flat = points - points.mean(0)
    flat = flat - (flat @ normal)[:, None] * normal
    _, axes = np.linalg.eigh(flat.T @ flat / len(flat) - np.outer(normal, normal))
    wide, narrow = axes[:, 2], np.cross(normal, axes[:, 2])
    along, across = (2 * float(np.sqrt(np.mean((flat @ axis) ** 2))) for axis in (wide, narrow))
    radius = max(np.sqrt(along * across), 1e-3)
    return Chart(points.mean(0), np.stack([wide, narrow, normal]), radius), along / max(across, 1e-3)


def patch_inside(relief: Relief, size: float, waves: Float[np.ndarray, "4"], pixels: Pixels) -> Patch | None:
    """The part inside a rim that faces the chart; None where too few pixels see it."""
    final = FinalRays.of(relief.surface, pixels.rays, 0)
    place = relief.chart.coordinates(final.points)
    share = Concavity.bowl(size, waves, 1.0).share(place[:, 0], place[:, 1])
    facing = final.normals @ relief.chart.axes[2] > LEAST_FACING
    inside = np.flatnonzero((share < 1) & facing & (np.abs(place[:, 2]) < HALF_SIDE))
    if len(inside) < LEAST_PIXELS:
        return None
    chosen = inside[:: -(-len(inside) // PIXELS)]
    return Patch(relief, size, waves, Scored(pixels.rays.chosen(chosen), pixels.radiance[chosen]))


def rim_of(relief: Relief) -> tuple[float, Float[np.ndarray, "4"]]:
    """Size and waves of the part about the middle whose normals stay within `LID_ANGLE_DEG` of the chart's."""
    step = 2 * HALF_SIDE / (SIDE - 1)
    slope = np.hypot(*np.gradient(np.where(np.isfinite(relief.heights), relief.heights, -1e3), step))
    flat = slope < np.tan(np.radians(LID_ANGLE_DEG))
    turns = np.arange(72) * (2 * np.pi / 72)
    reach = np.arange(step, HALF_SIDE, step / 2)
    index = [
        np.round((np.outer(each(turns), reach) + HALF_SIDE) / step).astype(int).clip(0, SIDE - 1)
        for each in (np.cos, np.sin)
    ]
    inside = np.logical_and.accumulate(flat[index[0], index[1]], axis=1)
    radius = np.log(np.maximum(inside.sum(1), 1) * (step / 2) + step / 2)
    terms = np.stack([each(order * turns) for order in (2, 3) for each in (np.cos, np.sin)], 1)
    return float(radius.mean()), 2 * terms.T @ (radius - radius.mean()) / len(turns)


@remembered()
def searched(patch: Patch) -> Concavity | None:
    """The concavity under which pixels agree best: first guesses of many depths, then descents from the best of them.

    None where no guess makes them agree better, or the first descents gain too little.
    """
    first, before = RESOLUTIONS[0], patch.scored(patch.relief.surface, RESOLUTIONS[0])
    guesses = first_guesses(patch)
    evaluations = DESCENTS * EVALUATIONS[0] + sum(EVALUATIONS[1:])
    progress = Progress("searching a concavity", len(guesses) + evaluations)

    def cost(values: Float[np.ndarray, "13"], resolution: int) -> float:
        if progress.done < progress.total - 1:
            progress.advance()
        return patch.scored(patch.relief.carved(Concavity.from_vector(values)), resolution)

    def ended(found: Concavity | None) -> Concavity | None:
        progress.advance(steps=progress.total - progress.done)
        return found

    costs = np.array([cost(guess, first) for guess in guesses])
    if costs.min() >= FARTHEST_GUESS * before:
        return ended(None)
    best, least = min(
        (
            evolve(lambda x: cost(x, first), guesses[k], FIRST_STEPS, EVALUATIONS[0])
            for k in np.argsort(costs, kind="stable")[:DESCENTS]
        ),
        key=lambda each: each[1],
    )
    if least >= (1 - LEAST_GAIN / 2) * before:
        return ended(None)
    later = zip(RESOLUTIONS[1:], EVALUATIONS[1:], strict=True)
    for number, (resolution, evaluations) in enumerate(later, 1):
        steps = FIRST_STEPS * 0.5**number
        best, _ = evolve(lambda x, r=resolution: cost(x, r), best, steps, evaluations, number)  # type: ignore[misc]
    return ended(Concavity.from_vector(best))


def first_guesses(patch: Patch) -> list[Float[np.ndarray, "13"]]:
    """Concavities of several sizes, depths and exponents under a patch."""
    return [
        Concavity.bowl(patch.size + np.log(inset), patch.waves, depth * np.exp(patch.size), exponent).vector
        for inset in INSETS
        for depth in DEPTHS
        for exponent in EXPONENTS
    ]
