"""The map from pixels as areas, in the resolution and smoothness that pixels which took no part in it choose.

min_E Σ w ‖mean_k E(ω_k) − c‖² + λ Σ v ‖E_i − E_j‖² + ε ‖E − E₀‖², over 2×2 directions ω_k of each pixel and over
neighboring texels that pixels see, by conjugate gradients from the map E₀ of pixel centers. With v = 1/(1 + ‖E_i −
E_j‖²/s²) edges of lamps and windows stay, and noise does not. Views are clipped at some largest radiance, c = min(S,
mean_k E(ω_k)): a saturated pixel has no error while its prediction is saturated too, and light above S is determined by
pixels that see a lamp in part.

A lamp of radiance L saturates each pixel of which it covers more than S/L. Of the pixels over a point of its border,
1 − S/L are saturated, so a map in which these and the others count alike shows bright lamps too large. A saturated
pixel that counts as w unsaturated ones sets the border where 1/(1 + w) are saturated, which is right for
L = (1 + 1/w) S.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from panoless.capture.encoding import SATURATED
from panoless.environment.cubemap import by_face, by_texel, resample
from panoless.environment.fill import texel_neighbors
from panoless.environment.footprints import Footprints, PixelFootprints, counting_saturated, in_patches, thinned
from panoless.environment.rays import Rays
from panoless.environment.solve import solve_environment
from panoless.kernels.cubemap import cubemap_directions, sample_cubemap, scatter_cubemap
from panoless.numeric.conjugate_gradients import conjugate_gradients
from panoless.numeric.robust import bounded_error


@dataclass(frozen=True)
class Lamps:
    """How far pixels that lamps saturate count."""

    saturated_weight: float
    """Of a saturated pixel, where that of another is 1."""
    robust_scales: tuple[float, ...]
    """Of radiance errors, in rounds in each of which weights are computed again."""


SOFT = Lamps(0.5, (0.3, 0.25, 0.2, 0.16))
"""Where lamps and windows are little brighter than what saturates: their borders are pixels in between, which wide
scales keep."""
HARD = Lamps(0.25, (0.16, 0.16, 0.16, 0.16))
"""Where they are much brighter, and saturate pixels that they hardly touch."""
LEAST_HARD_GAIN = 0.02
"""Share of the error of unsaturated held-out pixels that hard lamps have to lower."""
ROBUST_SCALE = 0.16
"""Of errors of held-out pixels (linear radiance), and where the scales of lamps end."""
SMOOTHNESS = (0.01, 0.05, 0.25)
"""Weights λ of differences between neighboring texels, in pixels, among which held-out pixels choose, from the middle
one on."""
MIDDLE = len(SMOOTHNESS) // 2
HELD_OUT = 5
"""Of so many pixels one is held out."""
LEAST_GAIN = 0.002
"""Share of the error of held-out pixels by which a map of twice the resolution has to lower it."""
LEAST_UNSATURATED_GAIN = 0.005
"""The same of unsaturated pixels alone, where all together are explained no worse."""
LEAST_DETERMINED = 1.0
"""Pixels on a texel of the coarsest map from which their footprints determine where the map starts."""
PULL = 0.002
"""Weight ε of the start, in pixels."""
STEPS = 6
"""Conjugate-gradient steps of a round."""
TRIAL_STEPS = 2
"""The same in maps that only choose resolution and smoothness, as many steps do."""
TRIAL_PIXELS = 500_000
"""From about so many pixels at most these maps are made: those that look at some patches of the sky."""
TRIAL_PATCHES = 8
"""Patches along a face side, of which some are chosen."""
LIT = 0.95
"""Share of the largest value from which a texel of the start is saturated."""
CEILING = 4.0
"""Largest radiance of the map, in those of views."""
COARSE_PIXELS = 200_000
"""About so many pixels at most determine how bright the inside of saturated regions is."""
COARSE_RESOLUTION = 8
"""Texels along a face side of what is added there."""
COARSE_ROUNDS = 2
"""Rounds of it."""
COARSE_STEPS = 6
"""Conjugate-gradient steps of such a round."""
COARSE_PULL = 0.2
"""Weight of what is added, in pixels."""
COARSE_SCALE = 1.0
"""Robust scale there: while a lamp is far too dark, pixels that see it in part must keep their votes."""

MOVES = ((1, 0), (0, 1), (0, -1))
"""Steps to a finer map, a smoother one and a sharper one, as they are tried."""


@dataclass(frozen=True)
class Sharpness:
    """How fine a map is, and how much its neighboring texels agree."""

    resolution: int
    """Texels along a face side."""
    smoothness: float
    """λ, in pixels."""
    lamps: Lamps
    """How saturated pixels are weighted."""


def sharpest_map(
    footprints: Footprints,
    rays: Sequence[Rays],
    resolutions: Sequence[int],
    saturation: Float[Tensor, "3"],
) -> Float[Tensor, "6 3 L L"]:
    """The map of all pixels: `rays` are their centers, also of those without footprints. The resolutions that it may
    have go from coarse to fine; the coarsest has enough pixels a texel to say where footprints determine it. E₀ is
    solved from them twice: the second time, where they do, from a map of footprints. Under that fewer rays look as if
    they were wrong.
    """
    chosen = chosen_sharpness(footprints.smooth, resolutions, saturation)
    determined = footprints.smooth[0].radiance.new_zeros(6, 1, resolutions[0], resolutions[0])
    for each in footprints.smooth:
        determined += each.spread(each.initial_weight()[:, None], resolutions[0])
    determined = (determined >= LEAST_DETERMINED).float()
    level = SATURATED * saturation
    weighted = [
        counting_saturated(
            each, chosen.lamps.saturated_weight, level, sample_cubemap(determined, each.directions)[:, 0]
        )
        for each in rays
    ]
    start = solve_environment(weighted, chosen.resolution)
    seen = deblur_map(
        Footprints(footprints.smooth), start, saturation, chosen.smoothness, chosen.lamps, steps=TRIAL_STEPS
    )
    seen = seen.minimum(saturation.to(seen)[:, None, None])
    determined = resample(determined, chosen.resolution) > 0.5
    start = solve_environment(weighted, chosen.resolution, torch.where(determined, seen, start))
    return deblur_map(footprints, start, saturation, chosen.smoothness, chosen.lamps)


def chosen_sharpness(
    areas: Sequence[PixelFootprints],
    resolutions: Sequence[int],
    saturation: Float[Tensor, "3"],
    *,
    trial_pixels: int = TRIAL_PIXELS,
) -> Sharpness:
    """What explains every fifth pixel best by the others. From the coarsest map on, a finer, a smoother and a sharper
    one are tried as long as one is better, a finer one by the share `LEAST_GAIN`, or of unsaturated pixels by
    `LEAST_UNSATURATED_GAIN`. One that is as fine as a refused one is not tried again.

    Held-out pixels that are saturated count as they do in the map; at the borders of lamps they prefer blur. Which kind
    of lamps there is, unsaturated pixels determine before that: those beside lamps that are shown too large. Saturated
    ones always prefer larger lamps.
    """

    def sharpness(place: tuple[int, int], lamps: Lamps) -> Sharpness:
        return Sharpness(resolutions[place[0]], SMOOTHNESS[place[1]], lamps)

    trial, here, lamps = _Trial(areas, saturation, trial_pixels), (0, MIDDLE), SOFT
    best = trial.made(sharpness(here, lamps))
    if trial.is_saturated:
        hard = trial.made(sharpness(here, HARD))
        if hard.unsaturated_error < (1 - LEAST_HARD_GAIN) * best.unsaturated_error:
            lamps, best = HARD, hard
    tried, moves, sizes = {here}, list(MOVES), len(resolutions)
    while moves:
        (finer, smoother), *moves = moves
        there = here[0] + finer, here[1] + smoother
        if there in tried or there[0] >= sizes or not 0 <= there[1] < len(SMOOTHNESS):
            continue
        tried.add(there)
        found = trial.made(sharpness(there, lamps))
        if found.is_better(best) if finer else found.error < best.error:
            best, here, moves = found, there, list(MOVES)
        elif finer:
            sizes = there[0]
    return sharpness(here, lamps)


@dataclass(frozen=True)
class _Tried:
    """How badly a map of four fifths of the pixels explains the others: the mean of ‖e‖²/(‖e‖² + s²), weighted by trust
    and, of saturated ones, by what they count in the map.
    """

    error: float
    unsaturated_error: float
    """Of the unsaturated ones."""

    def is_better(self, coarser: "_Tried") -> bool:
        """Whether a finer map explains more: of all pixels; or of the unsaturated ones, and no less of all."""
        if self.error < coarser.error * (1 - LEAST_GAIN):
            return True
        enough = coarser.unsaturated_error * (1 - LEAST_UNSATURATED_GAIN)
        return self.error <= coarser.error and self.unsaturated_error < enough


class _Trial:
    """What the pixels in some patches of the sky say, of which some are held out."""

    def __init__(
        self, areas: Sequence[PixelFootprints], saturation: Float[Tensor, "3"], pixels: int = TRIAL_PIXELS
    ) -> None:
        areas = in_patches(areas, pixels, TRIAL_PATCHES)
        self.kept = [each.without(HELD_OUT, index % HELD_OUT) for index, each in enumerate(areas)]
        self.tested = [each.every(HELD_OUT, index % HELD_OUT) for index, each in enumerate(areas)]
        self.saturation, self.level = saturation, SATURATED * saturation
        self.is_saturated = any(bool(each.reaches(self.level).any()) for each in areas)
        self._starts: dict[tuple[int, Lamps], Tensor] = {}

    def made(self, sharpness: Sharpness) -> _Tried:
        """Of the map that is so sharp."""
        lamps, key = sharpness.lamps, (sharpness.resolution, sharpness.lamps)
        if key not in self._starts:
            rays = [counting_saturated(each.rays(), lamps.saturated_weight, self.level) for each in self.kept]
            self._starts[key] = solve_environment(rays, sharpness.resolution)
        start, footprints = self._starts[key], Footprints(self.kept)
        environment = deblur_map(footprints, start, self.saturation, sharpness.smoothness, lamps, steps=TRIAL_STEPS)
        return _Tried(*self._errors(environment, lamps))

    def _errors(self, environment: Float[Tensor, "6 3 L L"], lamps: Lamps) -> tuple[float, float]:
        """Of all tested pixels, and of the unsaturated ones."""
        summed = torch.zeros(2, 2)
        for each in self.tested:
            error = each.seen(environment).minimum(self.saturation.to(environment)) - each.radiance
            badly = bounded_error(error, ROBUST_SCALE)
            weight = counting_saturated(each, lamps.saturated_weight, self.level).initial_weight()
            for part, counted in zip(summed, (weight, weight * ~each.reaches(self.level)), strict=True):
                part += torch.stack([(counted * badly).sum(), counted.sum()]).cpu()
        every, unsaturated = (summed[:, 0] / summed[:, 1].clamp(min=1e-9)).tolist()
        return every, unsaturated


def deblur_map(
    footprints: Footprints,
    environment: Float[Tensor, "6 3 L L"],
    saturation: Float[Tensor, "3"],
    smoothness: float,
    lamps: Lamps = SOFT,
    *,
    steps: int = STEPS,
) -> Float[Tensor, "6 3 L L"]:
    """The map E₀ of pixel centers, sharpened; texels that no footprint touches stay. Views are clipped at `saturation`.

    It lies between 0 and that, or `CEILING` times that in channels in which pixels are saturated. Before each round,
    pixels that bend the light much, or reflect it often, and so see wide parts of it, determine how bright the inside
    of saturated regions is, coarsely.
    """
    if not footprints.smooth:
        return environment
    saturation = saturation.to(environment)
    level = SATURATED * saturation
    areas = [counting_saturated(each, lamps.saturated_weight, level) for each in footprints.smooth]
    lit = torch.stack([(each.radiance >= level).any(0) for each in areas]).any(0)
    highest = (saturation * torch.where(lit, CEILING, 1.0))[:, None, None]
    inner = _eroded(environment >= LIT * saturation[:, None, None])
    others = None
    if footprints.trace_others is not None and inner.any():
        others = PixelFootprints.joined(thinned(footprints.trace_others(), COARSE_PIXELS))
    for scale in lamps.robust_scales:
        if others is not None:
            environment = _brightened(environment, others, inner, saturation).minimum(highest)
        change = _sharpening(environment, areas, saturation, smoothness, scale, steps)
        environment = (environment + change).clamp(min=0).minimum(highest)
    return environment


def _sharpening(
    environment: Float[Tensor, "6 3 L L"],
    areas: Sequence[PixelFootprints],
    saturation: Float[Tensor, "3"],
    smoothness: float,
    scale: float,
    steps: int,
) -> Float[Tensor, "6 3 L L"]:
    """The change of a map that explains pixels best, as they and its differences weigh under that map."""
    equations = _Equations.at(environment, areas, saturation, scale, PULL)
    agreeing = _Smoothness.at(environment, equations.total, smoothness, scale)
    return conjugate_gradients(
        lambda image: equations.product(image) + agreeing.product(image),
        torch.zeros_like(environment),
        equations.right_side - agreeing.product(environment),
        1 / (PULL + equations.total + agreeing.diagonal),
        steps,
    )


@dataclass(frozen=True)
class _Equations:
    """Normal equations of a change of the map: AᵀWA + ε and AᵀW (c − A E)."""

    products: Sequence[Callable[[Float[Tensor, "6 3 L L"]], Float[Tensor, "6 3 L L"]]]
    right_side: Float[Tensor, "6 3 L L"]
    total: Float[Tensor, "6 3 L L"]
    """The weight that lies on each texel."""
    pull: float

    @classmethod
    def at(
        cls,
        environment: Float[Tensor, "6 3 L L"],
        areas: Sequence[PixelFootprints],
        saturation: Float[Tensor, "3"],
        scale: float,
        pull: float,
    ) -> "_Equations":
        """Weighed by what is seen of a map."""
        resolution = environment.shape[-1]
        products, residual, total = [], torch.zeros_like(environment), torch.zeros_like(environment)
        for each in areas:
            seen = each.seen(environment)
            weights = each.weights(seen, saturation, scale, SATURATED)
            products.append(each.normal_product(weights, resolution))
            residual += each.spread((each.radiance - seen) * weights, resolution)
            total += each.spread(weights, resolution)
        return cls(products, residual, total, pull)

    def product(self, image: Float[Tensor, "6 3 L L"]) -> Float[Tensor, "6 3 L L"]:
        """The matrix times a change."""
        found = self.pull * image
        for product in self.products:
            found += product(image)
        return found


@dataclass(frozen=True)
class _Smoothness:
    """λ Σ v ‖E_i − E_j‖² over neighboring texels on which pixels fell."""

    around: Tensor
    weights: Float[Tensor, "4 T 1"]
    """λ v of a texel and each of its neighbors."""

    @classmethod
    def at(
        cls,
        environment: Float[Tensor, "6 3 L L"],
        total: Float[Tensor, "6 3 L L"],
        smoothness: float,
        scale: float,
    ) -> "_Smoothness":
        """With v of the differences of a map."""
        around = texel_neighbors(environment.shape[-1]).to(environment.device)
        texels, touched = by_texel(environment), by_texel(total).amax(1) > 0
        apart = (texels[around] - texels).square().sum(2, keepdim=True)
        return cls(around, smoothness * (touched[around] & touched)[..., None] / (1 + apart / scale**2))

    def product(self, image: Float[Tensor, "6 3 L L"]) -> Float[Tensor, "6 3 L L"]:
        """The matrix times a change."""
        texels = by_texel(image)
        return by_face((self.weights * (texels - texels[self.around])).sum(0), image.shape[-1])

    @property
    def diagonal(self) -> Float[Tensor, "6 1 L L"]:
        """Of the matrix."""
        total = self.weights.sum(0)
        return by_face(total, round((len(total) / 6) ** 0.5))


def _brightened(
    environment: Float[Tensor, "6 3 L L"],
    areas: PixelFootprints,
    inner: Float[Tensor, "6 3 L L"],
    saturation: Float[Tensor, "3"],
) -> Float[Tensor, "6 3 L L"]:
    """The map plus what a coarse one adds within saturated regions; nothing there falls below saturation for it.

    That is B X of min_X Σ w ‖A (E + B X) − c‖² + ε ‖X‖², with B `finer` and `coarser` its adjoint.
    """
    resolution = environment.shape[-1]
    texels = cubemap_directions(resolution, device=environment.device).reshape(-1, 3)
    lowest = environment.minimum(saturation[:, None, None])

    def finer(coarse: Float[Tensor, "6 C M M"]) -> Float[Tensor, "6 C L L"]:
        return inner * resample(coarse, resolution)

    def coarser(image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C M M"]:
        return scatter_cubemap(by_texel(inner * image), texels, COARSE_RESOLUTION)

    def change_of(environment: Float[Tensor, "6 3 L L"]) -> Float[Tensor, "6 3 L L"]:
        equations = _Equations.at(environment, [areas], saturation, COARSE_SCALE, 0.0)
        right_side = coarser(equations.right_side)
        found = conjugate_gradients(
            lambda coarse: COARSE_PULL * coarse + coarser(equations.product(finer(coarse))),
            torch.zeros_like(right_side),
            right_side,
            1 / (COARSE_PULL + coarser(equations.total)),
            COARSE_STEPS,
        )
        return finer(found)

    for _ in range(COARSE_ROUNDS):
        environment = (environment + change_of(environment)).maximum(lowest)
    return environment


def _eroded(mask: Tensor) -> Float[Tensor, "6 3 L L"]:
    """1 where a texel and its eight neighbors on the same face are in a mask, and 0 elsewhere."""
    return -max_pool2d(-mask.float(), 3, 1, 1)
