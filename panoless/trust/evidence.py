"""What training views say about a finished fit: held-out light, silhouettes, and how much was there to be seen.

Every fifth view is held out from a map that is solved again for the final geometry, of pixels as areas where the kind
knows them: what a pixel blurs is no error of the shape. What the map leaves unexplained is compared with what two
models leave that know no mirror: one color a view, and one color a place on the surface, as a matte object has. Where
most of what the object shows is dark, errors are those of the logarithms of radiance.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.contrast import Contrast
from panoless.capture.corrections import NO_CORRECTIONS, Corrections
from panoless.capture.encoding import SATURATED, encoding_of
from panoless.capture.masks import MASK_LEVEL
from panoless.capture.silhouettes import mask_distance_px, silhouette_distance_px
from panoless.capture.views import TrainView, Views, at_most_pixels, split_held_out
from panoless.config import FitConfig
from panoless.environment.footprints import Footprints, PixelFootprints, thinned
from panoless.environment.reflectance import Reflectance
from panoless.environment.resolution import ERROR_SCALE, densest_resolution
from panoless.environment.sharpening import HARD, MIDDLE, SMOOTHNESS, TRIAL_STEPS, deblur_map
from panoless.environment.solve import solve_environment
from panoless.geometry.base import Geometry, SurfaceBuffers, observe_views, overlap, pixel_areas, usable_views
from panoless.geometry.places import Cells, Mean, WithoutMirror, surfaces_of
from panoless.geometry.registry import FAMILIES
from panoless.kernels.cubemap import sample_cubemap
from panoless.numeric.robust import NORMAL_MEDIAN, bounded_error, robust_scale, robust_weight
from shinypartial.dataset.schema import BallEvidence

LEAST_NOISE = 1e-3
"""Standard deviation of noise that no sensor goes below."""
PART_CELLS = 24
"""Along a side of the grid whose cells are places that are explained or not."""
PART_UNEXPLAINED = 0.6
"""A place is not explained from this share of the light on that a matte object would leave unexplained."""
SHIFT_SCALE_PX = 0.5
"""Distance of silhouettes after a shift (px) beyond which they lose their say in it, or…"""
SHIFT_MEDIANS = 3.0
"""…so many times the median distance."""
SHIFT_ROUNDS = 5
"""Rounds of such weights."""
WELL_INSIDE_PX = 4.0
"""Pixels as far inside and outside the masks determine whether the surface covers them."""
VIEWED_WITHIN_RAD = math.radians(15.0)
"""What is as near to the direction of a camera was seen from it."""
VIEWED_DIRECTIONS = 4000
"""Of the sphere, among which these are counted."""

LIGHT_FIGURES = ("unexplained", "one_color", "matte", "unexplained_part", "noise", "error_in_noise", "rank_correlation")
"""What comes from held-out light."""


VIEWS = 20
"""Most views of either part, kept and held out, whose silhouettes and places count."""
RAYS = 300_000
"""Most rays that the map without held-out views is solved from, and most that test it."""
RESOLUTION = 128
"""Most texels along a face side of that map."""
RANKED = 100_000
"""Rays at most whose ranks are compared: their correlation is then known to 0.003."""
SURE = 0.5
"""Confidence from which a direction counts in a capture of a ball."""


@dataclass(frozen=True)
class Evidence:
    """Figures of a fit. Errors are means of ‖e‖²/(‖e‖² + s²) over held-out rays; what can't be determined is None."""

    unexplained: float | None
    """Of the light that held-out views show, under the mirror and the map of the other views, in [0, 1]."""
    one_color: float | None
    """The same under the mean color of each view."""
    matte: float | None
    """The same under one color for each place on the surface, found from the other views."""
    unexplained_part: float | None
    """Share of the light in held-out views that comes from places on the surface of which most is unexplained."""
    noise: float | None
    """Standard deviation of the pixels' noise, from their second differences: of radiance, or of its contrast."""
    error_in_noise: float | None
    """Median error of a held-out ray's channel in standard deviations of the noise."""
    silhouette_px: float
    """Median distance of the fitted silhouette from that of the mask, over all views."""
    view_shift_px: float
    """How far the silhouettes of single views are shifted against the fit: root mean square over views."""
    view_shift_deg: float
    """The same as a turn of the camera."""
    overlap: float
    """Intersection over union of fit and mask: median over views."""
    missed: float
    """Share of the pixels well inside the masks that the fitted surface does not cover: mean over views."""
    left_out: float
    """Share of the object's pixels that show the object again and are left out of the map."""
    saturated: float
    """Share of the object's pixels that end at the largest value."""
    coverage: float
    """Share of all directions that some pixel saw."""
    rank_correlation: float | None
    """Spearman's, of confidence and the error of held-out rays: negative where errors fall with confidence."""
    camera_turn_deg: float
    """By which the fit turned the cameras: median over views."""
    views: int
    """Number of views in which the object is seen."""
    viewed: float
    """Share of all directions from which, or from near which, one of them sees it."""
    surplus: float = 0.0
    """Pixels well outside the masks that the fitted surface covers, over those of the masks: mean over views."""
    mask_offset_px: float = 0.0
    """By which the fit moved the silhouettes of all masks outward."""
    exposure_stops: float = 0.0
    """Standard deviation of the exposures of the views, as far as the fit took it back."""
    white_balance_stops: float = 0.0
    """That of the channels from the exposure of their view."""
    focal_factor: float = 1.0
    """The focal length that the fit found over what is said of it."""
    k1: float = 0.0
    """The radial distortion that the fit found."""
    roughness: float = 0.0
    """Of the object, as the fit found it."""
    blur_px: float = 0.0
    """Of the pictures, as the fit found it: standard deviation of a Gaussian."""
    repaired_views: int = 0
    """Number of views whose masks had holes or stray pieces that the others contradict."""
    rim_px: float | None = None
    """Of a captured ball, and of one of which no view is held out: median distance of its rim from a cone…"""
    agreement: float | None = None
    """…and correlation of what lies beside the ball with what it mirrors."""


def gather_evidence(
    views: Views,
    geometry: Geometry,
    visibility: Float[Tensor, "6 L L"],
    config: FitConfig,
    corrections: Corrections = NO_CORRECTIONS,
    roughness: float | None = None,
    ball: BallEvidence | None = None,
    reflectance: Reflectance | None = None,
) -> Evidence:
    """The evidence for a geometry in the views that it was fitted to, after their corrections, which are listed along
    as the roughness is; `visibility` is that of the final map. Where the `reflectance` differs from place to place,
    what a perfect mirror would have shown errs by more than the photograph: by that over the mirrored share.

    The shape and the cameras of a `ball` that was captured are known before. So held-out light counts where the map is
    rather sure than not: what stands near the ball, and who photographs it, is left to the visibility.
    """
    found = usable_views(views, geometry).train
    used = [index for index, view in enumerate(views.train) if len(view.solid)]
    seen = tuple(views.train[index] for index in used)
    views, usable = replace(views, train=seen), replace(views, train=tuple(found[index] for index in used))
    solid, kept = (max(each.num_solid, 1) for each in (views, usable))
    surfaces = surfaces_of(usable, geometry, VIEWS)
    uneven = reflectance if reflectance is not None and reflectance.field is not None else None
    light = _light(usable, surfaces, geometry, visibility, config, uneven, by_confidence=ball is not None)
    silhouettes = [_silhouette(*each) for part in surfaces for each in part]
    distance, shift, overlap, missed, surplus = np.array(silhouettes).reshape(-1, 5).T
    focal = np.array([view.camera.fx for part in surfaces for view, _ in part])
    return Evidence(
        **light,
        silhouette_px=_median(distance),
        view_shift_px=float(np.sqrt(np.mean(shift**2))) if len(shift) else 0.0,
        view_shift_deg=float(np.degrees(np.sqrt(np.mean((shift / focal) ** 2)))) if len(shift) else 0.0,
        overlap=_median(overlap),
        missed=float(missed.mean()) if len(missed) else 0.0,
        surplus=float(surplus.mean()) if len(surplus) else 0.0,
        left_out=1 - kept / solid,
        saturated=_saturated(seen, encoding_of(config).saturation),
        coverage=float((visibility > 0).float().mean()),
        camera_turn_deg=_median(np.array([_turn_deg(*each) for each in zip(seen, usable.train, strict=True)])),
        views=len(seen),
        viewed=_viewed(seen),
        mask_offset_px=corrections.mask_offset_px,
        exposure_stops=corrections.exposure_stops or 0.0,
        white_balance_stops=corrections.white_balance_stops or 0.0,
        focal_factor=corrections.focal_factor,
        k1=corrections.k1,
        roughness=roughness or 0.0,
        blur_px=views.blur_px,
        repaired_views=views.repairs.views,
        rim_px=_rim_px(ball, geometry, _median(distance), light),
        agreement=None if ball is None else ball.agreement,
    )


def _rim_px(
    ball: BallEvidence | None, geometry: Geometry, silhouette_px: float, light: dict[str, float | None]
) -> float | None:
    """That of a capture; of a kind that silhouettes determine and without held-out views, how far these are off."""
    if ball is not None:
        return ball.rim_px
    family = FAMILIES.get(geometry.kind)
    by_silhouettes = family is not None and family.silhouettes_suffice
    return silhouette_px if by_silhouettes and light["unexplained"] is None else None


def _median(values: Float[np.ndarray, "V"]) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _viewed(views: Sequence[TrainView]) -> float:
    """Share of all directions that lie near that of a camera, as seen from the object."""
    if not views:
        return 0.0
    height = (2 * np.arange(VIEWED_DIRECTIONS) + 1) / VIEWED_DIRECTIONS - 1
    turn, across = np.pi * (1 + 5**0.5) * np.arange(VIEWED_DIRECTIONS), np.sqrt(1 - height**2)
    directions = np.stack([across * np.cos(turn), across * np.sin(turn), height], 1)
    cameras = np.stack([view.position / np.linalg.norm(view.position) for view in views])
    return float(((directions @ cameras.T).max(1) > math.cos(VIEWED_WITHIN_RAD)).mean())


def _turn_deg(said: TrainView, found: TrainView) -> float:
    """Between two rotations of a camera: ‖A − B‖ = 2√2 sin(α/2)."""
    apart = torch.linalg.norm(said.camera.world_to_camera[:3, :3] - found.camera.world_to_camera[:3, :3])
    return 2 * math.degrees(math.asin(min(float(apart) / 8**0.5, 1.0)))


def _light(
    views: Views,
    surfaces: Sequence[Sequence[tuple[TrainView, SurfaceBuffers]]],
    geometry: Geometry,
    visibility: Float[Tensor, "6 L L"],
    config: FitConfig,
    uneven: Reflectance | None,
    *,
    by_confidence: bool,
) -> dict[str, float | None]:
    """The figures that come from held-out light; None where there are too few views."""
    nothing = dict.fromkeys(LIGHT_FIGURES)
    kept, held_out = surfaces
    if not kept or not held_out:
        return nothing
    solved = replace(views, train=tuple(split_held_out(views.train)[0]))
    tested = replace(views, train=tuple(view for view, _ in held_out))
    environment = _predicting_map(_seen_areas(solved, geometry, config), config)
    contrast = Contrast.of(views)
    parts = Cells.empty(PART_CELLS, 1, views.train[0].mask.device)
    plain = WithoutMirror.of(views, kept, held_out, contrast, RAYS)
    errors, confidence, explained, of_places = [], [], Mean(), Mean()
    saturation = encoding_of(config).saturation.to(environment)
    for areas in _seen_areas(tested, geometry, config):
        rays, seen = areas.rays(), areas.seen(environment).minimum(saturation)
        error = contrast.shown(seen) - contrast.shown(areas.radiance)
        confidence.append(sample_cubemap(visibility[:, None], rays.directions)[:, 0])
        weight = rays.initial_weight() * (confidence[-1] > SURE if by_confidence else 1)
        explained.add(bounded_error(error, ERROR_SCALE), weight)
        errors.append(error)
    for (view, surface), (_, pixels) in zip(held_out, at_most_pixels(tested, RAYS), strict=True):
        radiance = contrast.shown(view.radiance_at(pixels))
        normals = surface.normals_camera.flatten(1)[:, pixels]
        shaded = geometry.shade(environment, view.camera, pixels, normals).minimum(saturation)
        shown = contrast.shown(shaded) - radiance
        if uneven is not None:
            shown *= surface.shown(uneven, view.camera, pixels)[0]
            of_places.add(bounded_error(shown, ERROR_SCALE), torch.ones_like(shown[:, 0]))
        parts.add(view, surface, pixels, bounded_error(shown, ERROR_SCALE)[:, None])
    if explained.weight <= 0:
        return nothing
    every, sure = torch.cat(errors), torch.cat(confidence)
    noise = float(np.median([_noise(view) for view in contrast.applied(views).train]))
    return {
        "unexplained": explained.value if uneven is None else of_places.value,
        "one_color": plain.one_color,
        "matte": plain.matte,
        "unexplained_part": parts.share_above(PART_UNEXPLAINED * plain.matte),
        "noise": noise if contrast.knee is not None else noise / encoding_of(config).exposure,
        "error_in_noise": float(every.abs().median()) / max(noise, LEAST_NOISE),
        "rank_correlation": _rank_correlation(sure, every.square().sum(1)),
    }


def _seen_areas(views: Views, geometry: Geometry, config: FitConfig) -> list[PixelFootprints]:
    """What pixels saw as means over their areas; encoded radiance, which has no such means, at their centers."""
    most = RAYS
    if encoding_of(config).high_dynamic_range:
        return [PixelFootprints.centers(rays) for rays in observe_views(views, geometry, most)]
    return thinned(pixel_areas(views, geometry, most), most)


def _predicting_map(areas: Sequence[PixelFootprints], config: FitConfig) -> Float[Tensor, "6 3 L L"]:
    """The map of these pixels, as fine as they are dense. Saturated ones count like others, because they are to be
    explained as much, and scales are narrow, because many may be wrong.
    """
    rays = [each.rays() for each in areas]
    environment = solve_environment(
        rays, min(config.environment.trial_resolution(RESOLUTION), densest_resolution(rays))
    )
    saturation, lamps = encoding_of(config).saturation, replace(HARD, saturated_weight=1.0)
    return deblur_map(Footprints(list(areas)), environment, saturation, SMOOTHNESS[MIDDLE], lamps, steps=TRIAL_STEPS)


class _Silhouette(NamedTuple):
    """How far the silhouettes of fit and mask differ in a view."""

    distance_px: float
    """Median of the contours' distances."""
    shift_px: float
    """That explains most of it."""
    overlap: float
    """Intersection over union."""
    missed: float = 0.0
    """Share of the pixels well inside the mask that are not covered."""
    surplus: float = 0.0
    """Covered pixels well outside, over those of the mask."""


def _silhouette(view: TrainView, surface: SurfaceBuffers) -> _Silhouette:
    """What the silhouettes of fit and mask have in common.

    A pixel near the fitted contour has the mask's signed distance less the fitted one; a shift t changes it by n·t.
    Where both fill the picture there is no contour to compare; where one fills it, or is not in it, all is wrong.
    """
    mask, alpha, shared = view.mask.cpu().numpy(), surface.alpha.cpu().numpy(), overlap(surface.alpha, view.mask)
    if min(mask.min(), alpha.min()) > MASK_LEVEL:
        return _Silhouette(0.0, 0.0, shared)
    farthest = float(max(mask.shape))
    if min(mask.max(), alpha.max()) < MASK_LEVEL or max(mask.min(), alpha.min()) > MASK_LEVEL:
        solid = mask > MASK_LEVEL
        missed = float((alpha[solid] < MASK_LEVEL).mean()) if solid.any() else 0.0
        return _Silhouette(farthest, farthest, shared, missed)
    of_mask, of_fit = silhouette_distance_px(view.mask).cpu().numpy(), mask_distance_px(alpha)
    inside, outside = of_mask < -WELL_INSIDE_PX, of_mask > WELL_INSIDE_PX
    missed = float((alpha[inside] < MASK_LEVEL).mean()) if inside.any() else 0.0
    surplus = float((alpha[outside] >= MASK_LEVEL).sum() / (mask >= MASK_LEVEL).sum())
    rows, columns = np.gradient(of_fit)
    near = np.abs(of_fit) < 1
    near[[0, -1]], near[:, [0, -1]] = False, False
    if not near.any():
        return _Silhouette(farthest, farthest, shared, missed, surplus)
    normals, away = np.stack([columns[near], rows[near]], 1), (of_mask - of_fit)[near]
    distance, shift = float(np.median(np.abs(away))), float(np.linalg.norm(_shift(normals, away)))
    return _Silhouette(distance, shift, shared, missed, surplus)


def _shift(normals: Float[np.ndarray, "P 2"], away: Float[np.ndarray, "P"]) -> Float[np.ndarray, "2"]:
    """min Σ ρ(a − n·t) over shifts t (px): a dent that a wrong mask has in a part of its silhouette is no shift."""
    weight, shift = np.ones_like(away), np.zeros(2)
    for _ in range(SHIFT_ROUNDS):
        root = np.sqrt(weight)
        shift = np.linalg.lstsq(root[:, None] * normals, root * away, rcond=None)[0]
        left = away - normals @ shift
        weight = robust_weight(left, robust_scale(left, SHIFT_SCALE_PX, SHIFT_MEDIANS))
    return shift


def _noise(view: TrainView) -> float:
    """Standard deviation of the noise from second differences over rows: their median absolute value over 0.6745 √6."""
    solid = torch.zeros_like(view.mask, dtype=torch.bool).flatten()
    solid[view.solid] = True
    solid = solid.reshape(view.mask.shape)
    inside = solid[:, 2:] & solid[:, 1:-1] & solid[:, :-2]
    second = view.radiance[:, :, 2:] - 2 * view.radiance[:, :, 1:-1] + view.radiance[:, :, :-2]
    values = second[:, inside]
    return float(values.abs().median()) / (NORMAL_MEDIAN * 6**0.5) if values.numel() else 0.0


def _saturated(views: Sequence[TrainView], saturation: Float[Tensor, "3"]) -> float:
    """Share of the object's pixels that end at the largest value in some channel."""
    count, total = 0, 0
    for view in views:
        radiance = view.radiance_at(view.solid)
        ends = (radiance >= SATURATED * saturation.to(radiance)).any(1)
        count, total = count + int(ends.sum()), total + len(ends)
    return count / max(total, 1)


def _rank_correlation(first: Float[Tensor, "P"], second: Float[Tensor, "P"]) -> float | None:
    """Spearman's ρ: the correlation of ranks, equal values having their mean rank."""
    if min(float(each.max() - each.min()) if len(each) else 0.0 for each in (first, second)) == 0:
        return None
    ranks = []
    for each in (first, second):
        some = each[:: -(-len(each) // RANKED)].cpu().numpy()
        _, place, count = np.unique(some, return_inverse=True, return_counts=True)
        ranks.append((np.cumsum(count) - (count - 1) / 2)[place])
    return float(np.corrcoef(*ranks)[0, 1])
