"""Which lines cut a plane into panes: photographs show slopes over tiles, which jump across joints."""

import itertools
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.views import Views
from panoless.environment.mirrored import MirroredRays
from panoless.geometry.height_field.fit import refined
from panoless.geometry.height_field.model import HeightField, flat_height_field
from panoless.geometry.height_field.unknowns import HeightFieldUnknowns
from panoless.geometry.panes.model import CutPlane, Panes, flat_panes
from panoless.geometry.plane.fit import VOTING_VIEWS, spread, votes_on
from panoless.geometry.plane.model import Plane
from panoless.numeric.robust import bounded_error
from panoless.problem.equations import Data, Photographs, Round, State, Traced
from panoless.problem.nuisance import NO_NUISANCE
from panoless.problem.solve import FINISH

TILES = 24
"""Tiles along the longer side of the boundary's box."""
TILE_ROUNDS = (Round(16, 0.5, 40_000, 4), Round(32, 0.3, 60_000, 3))
"""By which the slopes of tiles are estimated."""
PANE_ROUNDS = (Round(32, 0.3, 60_000, 3), Round(64, 0.15, 120_000, 3))
"""By which panes are fitted before joints are located to parts of a pixel."""
BAR_REACH, BAR_SAMPLES = 0.25, 64
"""Bars are looked for so far from joints, in shares of the narrowest pane, at so many places."""
BESIDE_CORNERS = np.linspace(0.3, 0.7, 8)
"""Places along a pane, as shares, at which other bars are far."""
LEAST_TILES = 3
"""A pane is so many tiles wide at least."""
LARGEST_LEFT = 0.7
"""Share of the squared error of slopes that a further joint leaves at most."""
EXPLAINED = 0.02
"""Share of the squared error of one line that counts as explained."""
LARGEST_SHARE = 0.5
"""Panes leave at most this share of the variance of the tiles' slopes that a spline of as many numbers leaves."""


def panes_over(views: Views, plane: Plane) -> Panes | None:
    """Panes of a plane, with heights of the second degree; None where a smooth surface explains the slopes as well."""
    plane = along_sides(plane, _pixel(views))
    tiles = flat_panes(_tiled(plane), 1)
    with torch.no_grad():
        for each in TILE_ROUNDS:
            tiles = refined(views, tiles, each)
        panes = _panes_of(tiles, plane)
        if panes is None:
            return None
        for each in PANE_ROUNDS:
            panes = refined(views, panes, each)
        return located(views, panes, PANE_ROUNDS[-1], tiles.narrowest)


def one_pane(views: Views, plane: Plane) -> Panes:
    """The whole of a plane."""
    plane = along_sides(plane, _pixel(views))
    box = np.stack([plane.boundary.min(0), plane.boundary.max(0)], 1)
    return flat_panes(_cut(plane, box[0], box[1], 0.0))


def along_sides(plane: Plane, pixel: float) -> Plane:
    """The plane with axes along the sides of its boundary, turned by φ: 4 φ = arg Σ ℓ exp(4 i φ_side).

    A frame that is lower than a pixel is none.
    """
    sides = np.roll(plane.boundary, -1, 0) - plane.boundary
    lengths, turns = np.hypot(*sides.T), np.arctan2(sides[:, 1], sides[:, 0])
    turn = float(np.angle(lengths @ np.exp(4j * turns))) / 4
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    tangents = rotation @ np.stack([plane.tangent_u, plane.tangent_v])
    return replace(
        plane,
        tangent_u=tangents[0],
        tangent_v=tangents[1],
        boundary=plane.boundary @ rotation.T,
        frame_height=plane.frame_height if plane.frame_height > pixel else 0.0,
    )


def _pixel(views: Views) -> float:
    """Size of a pixel at the origin of the normalized frame, median over views."""
    return float(np.median([np.linalg.norm(view.position) / view.camera.fx for view in views.train]))


def _cut(plane: Plane, cuts_u: Float[np.ndarray, "A"], cuts_v: Float[np.ndarray, "B"], width: float) -> CutPlane:
    return CutPlane(**vars(plane), cuts_u=cuts_u, cuts_v=cuts_v, width=width)


def _tiled(plane: Plane) -> CutPlane:
    """In squares, or nearly; no pixel is left out at their sides."""
    low, high = plane.boundary.min(0), plane.boundary.max(0)
    counts = np.maximum(np.rint(TILES * (high - low) / (high - low).max()), 1).astype(int)
    cuts_u, cuts_v = (np.linspace(low[axis], high[axis], counts[axis] + 1) for axis in (0, 1))
    return _cut(plane, cuts_u, cuts_v, -np.inf)


def _panes_of(tiles: Panes, plane: Plane) -> Panes | None:
    """Panes by the slopes of tiles; None of one pane, or where a spline explains the slopes as well.

    Of the panes the least squares solution of the slopes is taken. Half a tile on both sides of joints is left out.
    """
    lines = tiles.plane.cuts
    middles = [(each[1:] + each[:-1]) / 2 for each in lines]
    places = np.stack(np.meshgrid(*middles, indexing="ij"), -1).reshape(-1, 2)
    slopes = tiles.heights(places, 1)[1:].T
    grid = slopes.reshape(len(middles[0]), len(middles[1]), 2)
    cuts_u, cuts_v = (
        each[[0, *jumps(values.reshape(len(values), -1)), len(each) - 1]]
        for each, values in zip(lines, (grid, grid.transpose(1, 0, 2)), strict=True)
    )
    panes = flat_panes(_cut(plane, cuts_u, cuts_v, float(np.diff(lines[0]).mean())))
    if len(panes.coefficients) == 1:
        return None
    of_panes, left = _fitted(panes, places, slopes)
    numbers, cells = panes.coefficients.size - len(panes.coefficients), 1
    while flat_height_field(plane, cells + 1).coefficients.size <= numbers:
        cells += 1
    smooth = flat_height_field(plane, cells)
    if left > LARGEST_SHARE * _fitted(smooth, places, slopes)[1]:
        return None
    return replace(panes, coefficients=of_panes)


def _fitted(
    surface: HeightField, places: Float[np.ndarray, "P 2"], slopes: Float[np.ndarray, "P 2"]
) -> tuple[Float[np.ndarray, "M N"], float]:
    """Coefficients by which slopes are nearest to given ones, and the sum of squares that is left."""
    index, weights = surface.basis(places, 1)
    rows = np.zeros((2, len(places), surface.coefficients.size))
    np.put_along_axis(rows, np.broadcast_to(index, weights[1:].shape), weights[1:], 2)
    matrix, target = rows.reshape(-1, surface.coefficients.size), slopes.T.ravel()
    found = np.linalg.lstsq(matrix, target, rcond=1e-9)[0]
    return found.reshape(surface.coefficients.shape), float(((matrix @ found - target) ** 2).sum())


def jumps(values: Float[np.ndarray, "K C"]) -> list[int]:
    """Where K values in a row, of C channels, jump: ends of the segments on which they are linear.

    Segments have the least squared error R among those of their number S (dynamic programming). S has the least
    (R + ε R₁) / cˢ, R₁ that of one line: a jump leaves the share c at most, and less than ε R₁ is explained.
    """
    count = len(values)
    costs = np.full((count + 1, count + 1), np.inf)
    for first in range(count):
        for last in range(first + LEAST_TILES, count + 1):
            line = np.stack([np.ones(last - first), np.arange(first, last)], 1)
            projected = line @ np.linalg.pinv(line)
            part = values[first:last]
            costs[first, last] = ((part - projected @ part) ** 2).sum()
    least, before = costs[0], list[np.ndarray]()
    explained = EXPLAINED * float(least[count])
    best, found = float(least[count]) + explained, list[int]()
    for number in range(2, count // LEAST_TILES + 1):
        through = least[:, None] + costs
        before.append(through.argmin(0))
        least = through.min(0)
        score = (float(least[count]) + explained) / LARGEST_LEFT ** (number - 1)
        if score < best:
            best, found, end = score, [], count
            for ends in reversed(before):
                end = int(ends[end])
                found.insert(0, end)
    return found


def located(views: Views, panes: Panes, settings: Round, reach: float) -> Panes:
    """With joints where errors change from those of one pane to those of the next.

    Of pixels with errors f by the first and g by the second, a joint lies at the t with the least
    Σ_{u<t} f + Σ_{u>t} g. Only pixels within `reach` of the joint count.
    """
    state = State(HeightFieldUnknowns(panes), NO_NUISANCE)
    data = Data.of(views, settings, FINISH.resolution)
    traced = Traced.of(data, state)
    seen = None if traced is None else Photographs.at(data, state, traced, estimated=False)
    if traced is None or seen is None or data.pixels is None:
        return panes
    rays, radiance = traced.rays, data.pixels.radiance
    places = panes.hits(rays.origins, rays.directions).places
    found = [each.copy() for each in panes.plane.cuts]
    for axis, cuts in enumerate(panes.plane.cuts):
        for joint in range(1, len(cuts) - 1):
            near = np.flatnonzero(np.abs(places[:, axis] - cuts[joint]) < reach)
            errors, at = [], []
            for side in (joint - 1, joint):
                pane = panes.pane_at(places[near])
                pane[:, axis] = side
                hits = panes.hits(rays.origins[near], rays.directions[near], pane)
                points = rays.origins[near] + hits.distance[:, None] * rays.directions[near]
                mirrored = MirroredRays(rays.directions[near], hits.normals @ panes.frame, points, state.around)
                errors.append(bounded_error(mirrored.light(seen.environment) - radiance[near], settings.robust_scale))
                at.append(hits.places[:, axis])
            line = np.mean(at, 0)
            found[axis][joint] = _change(line, errors[0] - errors[1], cuts[joint] - reach, cuts[joint] + reach)
    plane = replace(panes.plane, cuts_u=found[0], cuts_v=found[1], width=0.0)
    return replace(panes, plane=plane)


def _change(line: Float[np.ndarray, "P"], difference: Float[np.ndarray, "P"], low: float, high: float) -> float:
    """The t between two ends with the least Σ_{u<t} of a difference, in the middle between two places."""
    order = np.argsort(line)
    split = int(np.append(0.0, np.cumsum(difference[order])).argmin())
    places = np.concatenate([[low], line[order], [high]])
    return float(places[split] + places[split + 1]) / 2


def with_bars(views: Views, panes: Panes) -> Panes:
    """With bars between panes, as wide as what masks lack across joints: the median of ∫ (1 − mean mask) dt."""
    plane, reach, widths = panes.plane, BAR_REACH * panes.narrowest, list[float]()
    line = np.linspace(-reach, reach, BAR_SAMPLES)
    for axis, cuts in enumerate(plane.cuts):
        across = plane.cuts[1 - axis]
        beside = np.concatenate([low + (high - low) * BESIDE_CORNERS for low, high in itertools.pairwise(across)])
        for cut in cuts[1:-1]:
            u, v = (cut + line, beside) if axis == 0 else (beside, cut + line)
            lacking = 1 - votes_on(plane, u, v, spread(views.train, VOTING_VIEWS)).mean((0, 2 - axis))
            widths.append(2 * reach * float(lacking.mean()))
    return replace(panes, plane=replace(plane, width=float(np.median(widths)))) if widths else panes
