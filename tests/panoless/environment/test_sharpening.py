"""Maps of pixels as areas: how smooth and how fine they are is determined by pixels that took no part."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import normalize

from panoless.environment.footprints import Footprints, PixelFootprints, in_patches, splat
from panoless.environment.rays import Rays
from panoless.environment.sharpening import (
    HARD,
    HELD_OUT,
    ROBUST_SCALE,
    SMOOTHNESS,
    SOFT,
    Lamps,
    Sharpness,
    _Smoothness,
    _Trial,
    _Tried,
    chosen_sharpness,
    deblur_map,
    sharpest_map,
)
from panoless.environment.solve import solve_environment
from panoless.kernels.cubemap import cubemap_directions
from panoless.numeric.robust import bounded_error

ONE = torch.ones(3)
WIDTH = 0.06
"""Of a pixel, in radians."""
SIZES = (16, 32)
"""Texels along a face side."""


def light(directions: torch.Tensor, waves: float, window: float = 0.3) -> torch.Tensor:
    """Waves across the sky, and a window with sharp edges, so much brighter."""
    smooth = 0.4 + 0.2 * torch.sin(waves * directions)
    inside = (directions[..., :1] > 0.5) & (directions[..., 1:2].abs() < 0.3)
    return smooth + window * inside


def photographed(count: int, noise: float, waves: float = 6.0, window: float = 0.3) -> PixelFootprints:
    """Square pixels at random places, each the mean of 4×4 rays over its area, with the four directions of a fit."""
    generator = torch.Generator().manual_seed(1)
    middle = normalize(torch.randn(count, 3, generator=generator), dim=1)
    across = normalize(torch.linalg.cross(middle, torch.randn(count, 3, generator=generator)), dim=1)
    down = torch.linalg.cross(middle, across)

    def rays(side: int) -> torch.Tensor:
        places = ((torch.arange(side) + 0.5) / side - 0.5) * WIDTH
        right, below = (each.flatten()[:, None] for each in torch.meshgrid(places, places, indexing="ij"))
        return normalize(middle[:, None] + right * across[:, None] + below * down[:, None], dim=2)

    radiance = light(rays(4), waves, window).mean(1) + noise * torch.randn(count, 3, generator=generator)
    return PixelFootprints(rays(2).contiguous(), radiance.clamp(0, 1))


def error(environment: torch.Tensor, waves: float = 6.0) -> float:
    """Mean squared error of a map."""
    truth = light(cubemap_directions(environment.shape[-1]), waves).permute(0, 3, 1, 2)
    return float((environment - truth).square().mean())


def test_noise_makes_held_out_pixels_ask_for_smoothness() -> None:
    """They take the most that is offered, and not without noise. That map is the nearest to the truth by far."""
    least, most = SMOOTHNESS[0], SMOOTHNESS[-1]
    assert chosen_sharpness([photographed(10_000, 0.0)], SIZES[-1:], ONE).smoothness < most
    noisy = photographed(10_000, 0.05)
    assert chosen_sharpness([noisy], SIZES[-1:], ONE).smoothness == most
    start = solve_environment([noisy.rays()], SIZES[-1])
    errors = [error(deblur_map(Footprints.of([noisy]), start, ONE, each)) for each in (least, most)]
    assert errors[1] < errors[0] / 2


def test_a_map_is_as_fine_as_held_out_pixels_want_it() -> None:
    """Noisy pixels of slow waves need few texels, clean ones of fast waves many."""
    slow, fast = photographed(5_000, 0.05, waves=2.0, window=0.0), photographed(20_000, 0.0, waves=20.0)
    assert chosen_sharpness([slow], SIZES, ONE).resolution == SIZES[0]
    assert sharpest_map(Footprints.of([fast]), [fast.rays()], SIZES, ONE).shape[-1] == SIZES[-1]


def test_rays_tell_the_map_where_no_footprint_falls() -> None:
    """Though what is filled in from the footprints beside it is far from what these rays saw."""
    areas = photographed(10_000, 0.0)
    part = areas.directions.mean(1)[:, 0] < 0
    dark = PixelFootprints(areas.directions[part].contiguous(), 0.1 * torch.ones(int(part.sum()), 3))
    directions = areas.rays().directions
    rays = replace(areas.rays(), radiance=torch.where(directions[:, :1] < 0, 0.1, 0.9).expand(-1, 3).contiguous())
    environment = sharpest_map(Footprints.of([dark]), [rays], SIZES, ONE)
    beyond = cubemap_directions(environment.shape[-1])[..., 0] > 0.3
    assert (environment.permute(0, 2, 3, 1)[beyond] - 0.9).abs().max() < 0.02


def test_a_refused_resolution_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even where a sharper map of the coarser one was better."""
    tried, (_, usual, _) = [], SMOOTHNESS

    def made(trial: _Trial, sharpness: Sharpness) -> _Tried:
        resolution, smoothness = sharpness.resolution, sharpness.smoothness
        tried.append((resolution, smoothness))
        return _Tried(resolution + smoothness, 0.0)

    monkeypatch.setattr(_Trial, "made", made)
    chosen = chosen_sharpness([photographed(10, 0.0)], SIZES, ONE)
    assert (chosen.resolution, chosen.smoothness) == (SIZES[0], SMOOTHNESS[0])
    assert [each for each in tried if each[0] == SIZES[1]] == [(SIZES[1], usual)]


def test_a_finer_map_explains_more_of_all_pixels_or_of_unsaturated_ones() -> None:
    """By a share of 0.002 of all, or of 0.005 of the unsaturated ones where all are explained no worse."""
    coarse = _Tried(1.0, 0.8)
    assert _Tried(0.997, 0.9).is_better(coarse)
    assert _Tried(1.0, 0.79).is_better(coarse)
    assert not _Tried(0.999, 0.799).is_better(coarse)
    assert not _Tried(1.001, 0.5).is_better(coarse)


def test_bright_lamps_are_not_shown_too_large() -> None:
    """Of a window thirty times as bright as what saturates, the map has less than half of the error of one in which
    saturated pixels count like others, and that is lit where it should not be. A window that is little brighter is
    distinguished from it.
    """
    areas = photographed(20_000, 0.0, window=30.0)
    start = solve_environment([areas.rays()], SIZES[-1])
    truth = light(cubemap_directions(SIZES[-1]), 6.0, 30.0).permute(0, 3, 1, 2).clamp(0, 1)
    alike = Lamps(1.0, HARD.robust_scales)
    others = deblur_map(Footprints.of([areas]), start, ONE, SMOOTHNESS[0], alike)
    found = sharpest_map(Footprints.of([areas]), [areas.rays()], SIZES[-1:], ONE)
    wrong, right = (each.clamp(0, 1) - truth for each in (others, found))
    assert right.square().mean() < wrong.square().mean() / 2
    assert wrong.clamp(min=0).square().sum() > 2 * wrong.clamp(max=0).square().sum()
    dimmer = photographed(20_000, 0.0, window=1.0)
    lamps = [chosen_sharpness([each], SIZES[-1:], ONE).lamps for each in (areas, dimmer)]
    assert lamps == [HARD, SOFT]


def test_saturated_pixels_without_footprints_keep_their_say() -> None:
    """Three quarters of the rays beyond all footprints are saturated, the others dimmer: that part is bright, though a
    quarter of the weight would make it dim, which rays get that footprints explain beside hard lamps.
    """
    areas = photographed(10_000, 0.0, window=30.0)
    lower = areas.directions.mean(1)[:, 2] < 0
    below = PixelFootprints(areas.directions[lower].contiguous(), areas.radiance[lower])
    rays = areas.rays()
    bright = (torch.arange(len(lower)) % 4 > 0)[:, None].float().expand(-1, 3)
    mixed = replace(rays, radiance=torch.where(lower[:, None], rays.radiance, 0.5 + 0.5 * bright).contiguous())
    found = sharpest_map(Footprints.of([below]), [mixed], SIZES[:1], ONE)
    beyond = cubemap_directions(SIZES[0])[..., 2] > 0.4
    assert float(found.permute(0, 2, 3, 1)[beyond].mean()) > 0.95


def test_footprints_tell_a_fine_map_although_few_fall_on_a_texel() -> None:
    """There is one on two texels. Rays without footprints, of which half saw something else, spoil nothing."""
    areas = photographed(12_000, 0.0, waves=20.0, window=0.0)
    directions = normalize(torch.randn(36_000, 3, generator=torch.Generator().manual_seed(2)), dim=1)
    others = Rays(directions, light(directions, 20.0, 0.0))
    others.radiance[::2] = 0.1
    resolutions = SIZES[0], 4 * SIZES[0]
    truth = light(cubemap_directions(resolutions[1]), 20.0, 0.0).permute(0, 3, 1, 2)
    errors = []
    for rays in ([areas.rays()], [areas.rays(), others]):
        found = sharpest_map(Footprints.of([areas]), rays, resolutions, ONE)
        errors.append(float((found - truth).square().mean()))
    assert errors[1] < 1.1 * errors[0]


def test_held_out_saturated_pixels_count_as_they_do_in_the_map() -> None:
    """Of a map that is right but for a dark window, they are all of the error."""
    areas = photographed(10_000, 0.0, window=30.0)
    trial = _Trial([areas], ONE)
    tested = areas.every(HELD_OUT, 0)
    saturated = tested.reaches(trial.level)
    dark = light(cubemap_directions(128), 6.0, 0.0).permute(0, 3, 1, 2).contiguous()
    for lamps in (SOFT, HARD):
        weight = torch.where(saturated, lamps.saturated_weight, 1.0)
        badly = bounded_error(tested.seen(dark) - tested.radiance, ROBUST_SCALE)
        every, _ = trial._errors(dark, lamps)
        assert every == pytest.approx(float((weight * badly).sum() / weight.sum()), rel=1e-5)


def test_edges_stay_under_the_largest_smoothness() -> None:
    """Across the window's edge a map of noisy pixels keeps nine tenths of the step."""
    areas = photographed(10_000, 0.05)
    found = sharpest_map(Footprints.of([areas]), [areas.rays()], SIZES[-1:], ONE)
    directions = cubemap_directions(32)
    beside = (directions[..., 1].abs() < 0.2) & (directions[..., 2] > 0)
    within, without = ((directions[..., 0] - x).abs() < 0.04 for x in (0.57, 0.43))
    truth = light(directions, 6.0)[..., 1]
    steps = [float(each[within & beside].mean() - each[without & beside].mean()) for each in (found[:, 1], truth)]
    assert steps[0] > 0.9 * steps[1]


def test_smoothing_is_symmetric_and_leaves_constants() -> None:
    """⟨u, S v⟩ = ⟨S u, v⟩, S 1 = 0, and its diagonal is what unit images give."""
    generator = torch.Generator().manual_seed(0)
    map_, first, second = torch.rand(3, 6, 3, 8, 8, generator=generator)
    total = (torch.rand(6, 3, 8, 8, generator=generator) > 0.2).float()
    smoothness = _Smoothness.at(map_, total, 0.3, 0.16)
    left, right = (first * smoothness.product(second)).sum(), (smoothness.product(first) * second).sum()
    torch.testing.assert_close(left, right)
    assert float(smoothness.product(torch.ones_like(map_)).abs().max()) < 1e-6
    units = torch.eye(8)[:, None, None, None, :] * torch.eye(8)[3][:, None]
    for k, unit in enumerate(units):
        image = unit.expand(6, 3, 8, 8) * (torch.arange(6) == 2)[:, None, None, None]
        torch.testing.assert_close(smoothness.product(image)[2, 0, 3, k], smoothness.diagonal[2, 0, 3, k])


def test_texels_that_no_pixel_touches_stay() -> None:
    """They are what the start says, even beside others, under any smoothness."""
    areas = photographed(5_000, 0.0)
    upper = areas.directions[..., 2].amin(1) > 0.1
    areas = PixelFootprints(areas.directions[upper].contiguous(), areas.radiance[upper])
    start = torch.rand(6, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    found = deblur_map(Footprints.of([areas]), start, ONE, 0.25)
    below = (cubemap_directions(32)[..., 2] < 0)[:, None].expand_as(start)
    assert torch.equal(found[below], start[below])


def test_a_held_out_pixel_has_no_say() -> None:
    """Whatever it saw, the map of the others is the same."""
    areas = photographed(5_000, 0.0)
    other = areas.radiance.clone()
    other[2::5] = 0.9
    start = solve_environment([areas.rays()], 32)
    maps = [
        deblur_map(Footprints.of([replace(areas, radiance=each).without(5, 2)]), start, ONE, 0.05)
        for each in (areas.radiance, other)
    ]
    assert torch.equal(*maps)


def test_patches_of_the_sky_are_as_dense_as_the_whole() -> None:
    """A fifth of the pixels: on a texel fall all of them or none, but for those beside borders of patches. Patches
    with no more pixels than that stay as they are.
    """
    areas = [photographed(30_000, 0.0), photographed(10_000, 0.0)]
    parts = in_patches(areas, 8_000, 4)
    assert sum(len(each.radiance) for each in parts) == pytest.approx(8_000, rel=0.2)
    whole, part = (sum(splat(e.rays(), e.initial_weight(), 40)[:, 3] for e in batches) for batches in (areas, parts))
    share = part / whole.clamp(min=1e-9)
    assert ((share < 1e-3) | (share > 1 - 1e-3)).float().mean() > 0.6
    assert in_patches(areas, 40_000, 4) == areas


def test_patches_choose_the_sharpness_of_the_whole() -> None:
    """Noise requires smoothness, slow waves for few texels and fast ones for many, by a quarter of the pixels, too."""
    cases = [(0.05, 2.0, 0.0), (0.0, 20.0, 0.3), (0.05, 6.0, 0.3), (0.0, 6.0, 30.0)]
    for noise, waves, window in cases:
        areas = photographed(40_000, noise, waves, window)
        assert chosen_sharpness([areas], SIZES, ONE, trial_pixels=10_000) == chosen_sharpness([areas], SIZES, ONE)
