"""The tuned numbers of the map from pixel footprints, of its confidence, and of the distance of what it shows."""

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from shinypartial.io.records import Count, Natural, NonEmpty, NonNegative, Positive, Share

Roughness = Annotated[float, Meta(gt=0, le=0.5)]
"""Of a mirror, in units of Blender's principled shader."""
COARSEST = 4
"""Texels along a face side on which the widest blur of a lobe works."""


def halves_whole(resolution: int) -> bool:
    """Whether a map of so many texels along a face side is halved without a rest until it is as coarse as blurs ask."""
    while resolution > COARSEST and resolution % 2 == 0:
        resolution //= 2
    return resolution <= COARSEST


@dataclass(frozen=True)
class LampOptions:
    """How pixels are believed about what saturates them."""

    saturated_weight: Positive
    """Of a saturated pixel, where that of another is 1."""
    robust_scales: NonEmpty[Positive]
    """Of radiance errors, in rounds in which weights are found anew."""


@dataclass(frozen=True)
class FootprintMapOptions:
    """How a map of pixel centers is sharpened by pixel footprints.

    "Not tuned" is what only has to be large or small enough.
    """

    soft: LampOptions = LampOptions(0.5, (0.3, 0.25, 0.2, 0.16))
    """Where lamps and windows are little brighter than what saturates: their borders are pixels in between, which wide
    scales keep. Chosen, as the next, on nine shapes and scenes of development. From 0.5 on they gain as much, but lose
    up to 2 dB where a fifth of the pixels is wrong."""
    hard: LampOptions = LampOptions(0.25, (0.16, 0.16, 0.16, 0.16))
    """Where they are much brighter, and saturate pixels that they hardly touch. Half as much loses small lamps."""
    least_hard_gain: Share = 0.02
    """Share of the error of unsaturated held-out pixels that hard lamps have to lower: they lower it by 0.04 to 0.32
    on four of those, and by 0.00 or not at all on the others."""
    robust_scale: Positive = 0.16
    """Of errors of held-out pixels, and where the scales of lamps end. Chosen by the true maps of Vase and Cola;
    held-out views would take 0.3."""
    smoothness: NonEmpty[NonNegative] = (0.01, 0.05, 0.25)
    """Weights λ of differences between neighboring texels, in pixels, among which held-out pixels choose, from the
    middle one on. On Sculpture and Vase they take that where pixels have no noise, and the largest where it is 0.02."""
    held_out: Annotated[int, Meta(ge=2)] = 5
    """Of so many pixels one is held out. Not tuned."""
    least_gain: Share = 0.002
    """Share of the error of held-out pixels by which a map of twice the resolution has to lower it. Not tuned."""
    least_unsaturated_gain: Share = 0.005
    """The same of unsaturated pixels alone, where all together are explained no worse: 0.012 on a copy of sculpture
    with an operator of 10°, whom no map shows. Not tuned."""
    least_told: Positive = 1.0
    """Pixels on a texel of the coarsest map from which their footprints tell where the map starts. Not tuned."""
    pull: Positive = 0.002
    """Weight ε of the start, in pixels. Not tuned."""
    steps: Count = 6
    """Conjugate-gradient steps of a round."""
    trial_steps: Count = 2
    """The same in maps that only choose resolution and smoothness: on seven shapes they choose as six do."""
    trial_pixels: Count = 500_000
    """From about so many pixels at most these maps are made: those that look at some patches of the sky. A quarter of
    1.4 to 1.9 million chooses as all do on sculpture, horseshoe and dish at 400 px; an eighth of dish does not, nor
    always a half of 300,000."""
    trial_patches: Count = 8
    """Patches along a face side, of which some are chosen. Not tuned."""
    saturated: NonNegative = 0.998
    """Share of the largest value from which a pixel is saturated."""
    lit: NonNegative = 0.95
    """Share of the largest value from which a texel of the start is saturated."""
    ceiling: Positive = 4.0
    """Largest radiance of the map, in those of views. Eight changes nothing on Vase and Cola."""
    coarse_pixels: Count = 200_000
    """About so many pixels at most tell how bright the inside of saturated regions is. Not tuned."""
    coarse_resolution: Count = 8
    """Texels along a face side of what is added there."""
    coarse_rounds: Natural = 2
    """Rounds of it."""
    coarse_steps: Count = 6
    """Conjugate-gradient steps of such a round."""
    coarse_pull: Positive = 0.2
    """Weight of what is added, in pixels."""
    coarse_scale: Positive = 1.0
    """Robust scale there: while a lamp is far too dark, pixels that see it in part must keep their votes."""

    @property
    def middle(self) -> int:
        """The index of the smoothness that is tried first, and taken where nobody asks held-out pixels."""
        return len(self.smoothness) // 2


DEFAULTS = FootprintMapOptions()


@dataclass(frozen=True)
class ConfidenceOptions:
    """How far a direction of the map is believed, by the rays that look there. Chosen by how well it orders the errors
    of Vase and Cola.
    """

    vote_scale: Positive = 0.05
    """Residual (linear radiance) beyond which a ray does not agree with the map."""
    halving_disagreement: Positive = 0.05
    """Mean difference of rays from the map (sRGB, 0 to 1) that halves it."""
    halving_contrast: Positive = 0.1
    """Difference of a texel's neighbors (linear radiance) that halves it."""


@dataclass(frozen=True)
class SurroundingsOptions:
    """When the surroundings are taken to be near, and how their distance is found.

    "Rooms" are spheres about vase and sculpture at 5 and 10 radii of the object, 160 px; "not tuned" is what only has
    to be large or small enough.
    """

    mode: Literal["auto", "off", "on"] = "auto"
    """Whether their distance is an unknown: where held-out views gain by it, never, or always."""
    degree: Literal[0, 1, 2] = 0
    """Of the harmonics that 1/D is made of where it is near: 0 is a sphere, 1 one about another point, 2 walls that
    differ."""
    checked_views: Count = 10
    """So many views tell whether to look closer…"""
    checked_rays: Count = 20_000
    """…by about so many pixels. Not tuned."""
    rays: Count = 60_000
    """About so many pixels of all views tell how near they are."""
    robust_scale: Positive = 0.15
    """Residual (linear radiance) beyond which a ray loses its vote. Not tuned."""
    checked_resolution: Count = 8
    """Texels along a face side of the map under which a first step tells whether to look closer."""
    least_pull: NonNegative = 0.0003
    """Share of the cost that this step has to promise. It is 0.024 and 0.017 in rooms of vase at 5 and 10 radii, 0.063
    and 0.028 in those of sculpture, 0.0005 in one of mirror at 20 radii, and up to 0.0001 in their far worlds."""
    first_inverse_distance: Positive = 0.1
    """1/D, in inverse radii of the object, in which a fit is tried first that a far world leaves pulled like that. The
    fit of a brick in a room at 5 radii, no scene of the benchmark, is pulled by 0.002; in a far world by 0.00005."""
    resolutions: NonEmpty[Count] = (8, 8, 16, 16, 16, 32, 32, 32, 64, 64, 64)
    """Texels along a face side of the maps of all steps."""
    stretch: Positive = 1.7
    """Factor of a step: it lets each texel follow by the mean of its rays, as a map does not quite."""
    least_share: Positive = 1e-3
    """Share of the mean diagonal that is added to the diagonal, for walls that no ray tells. Not tuned."""
    floor: Literal["auto", "off"] = "auto"
    """Whether what the object stands on is taken for a level disk before the walls, where held-out views gain by it."""
    floor_depths: NonEmpty[Positive] = (0.45, 0.55, 0.65, 0.8, 1.0)
    """Of what the object may stand on below its center, in radii of the object: those that are tried first."""
    floor_reaches: NonEmpty[Positive] = (2.5, 4.0, 8.0)
    """How far that may reach, in radii of the object."""
    floor_resolution: Count = 16
    """Texels along a face side of the maps that tell which of these explains most."""
    largest_floor_cost: NonNegative = 0.99
    """Share of the cost in a far world that a floor has to leave, for anyone to look closer: it leaves 0.85 to 0.98
    below vase, sculpture and the pot of a film, and 1.004 and more of far worlds of seven scenes."""
    least_floor_gain: Share = 0.02
    """Share by which a floor has to lower the held-out error of a shape from silhouettes. That of *sculpture* filmed on
    a board falls by 0.034: most of it is the shape's."""
    refined_floor_resolutions: NonEmpty[Count] = (64, 64, 128, 128, 128)
    """Texels along a face side of the maps of all steps by which a fit tells its floor anew. Under coarser maps that of
    a filmed ball comes out 4 % too deep and leans by 1.4°; under these 1.2 % and 0.5°."""
    refined_floor_rays: Count = 200_000
    """About so many pixels of all views tell it: three of them a texel."""
    least_refined_floor_gain: Share = 0.005
    """Share by which that has to lower the held-out error: it falls by 0.011 on the filmed ball, and not at all where a
    filmed sculpture is bent to the floor that silhouettes told."""
    judged_rays: Count = 400_000
    """About so many pixels of all views tell whether a fit in near surroundings explains more than a far one."""
    judged_resolution: Count = 64
    """Texels along a face side of the map that predicts held-out views."""


@dataclass(frozen=True)
class MaterialOptions:
    """What the mirror is made of, where held-out views gain by it.

    "Not tuned" is what only has to be large or small enough.
    """

    reflectance: Literal["auto", "off"] = "auto"
    """Whether the share of the light that is mirrored may depend on color and angle, as that of a metal does; not where
    a tint is given, and never in a high dynamic range."""
    rays: Count = 100_000
    """About so many pixels of all views tell it. Not tuned."""
    resolution: Count = 64
    """Texels along a face side of the map that follows it. Not tuned."""
    robust_scale: Positive = 0.1
    """Residual (linear radiance) beyond which a ray loses its vote. With 0.03 the rays of a golden vase, all far off at
    first, lose so many votes that its blue comes out at 0.77 instead of 0.34."""
    rounds: Count = 12
    """Gauss–Newton steps. Not tuned."""
    largest_reflectance: Share = 0.97
    """Of the channel that is mirrored least, above which nobody asks held-out views: it is 0.34 on golden copies of
    vase and sculpture and 0.9997 on vase itself."""
    least_gain: Share = 0.02
    """Share by which the held-out error has to fall. It falls by 0.045 and 0.065 on golden copies of vase and
    sculpture; texels as wide as pixels leave much of it in any case."""
    least_albedo: Positive = 0.02
    """Share of scattered light, in the channel that has most of it, from which held-out views are asked. Not tuned."""
    least_scattering_gain: Positive = 0.1
    """Share by which scattered light has to lower the held-out error: 0.18 and 0.40 on copies of vase that are matte by
    0.05 and 0.2; at most 0.003 on mirrors of a right shape, and up to 0.03 on those of a wrong one."""
    least_scattering_error: NonNegative = 0.05
    """Held-out error of a fit from which the shape is looked for again without scattered light, where there is some."""
    roughness: Literal["auto", "off"] = "auto"
    """Whether the mirror may be slightly rough; not of surfels, whose normals are too coarse to tell, and never in a
    high dynamic range."""
    blur: Literal["auto", "off"] = "auto"
    """Whether pictures may be blurred, as out of focus or by compression: the wider pixels, the rougher a mirror looks
    where it is flat. Where both explain held-out views better, the one that does so more is taken."""
    first_blur_px: Positive = 0.5
    """Standard deviation of the blur of which held-out views are asked first: it lowers their error by 0.18 of it on a
    copy of sculpture with 1 px, and raises it by 1.9 on sculpture itself and by 0.43 on a rough copy."""
    blurs_px: tuple[Positive, Positive] = (0.25, 2.0)
    """Among these it is searched for. Not tuned."""
    known_roughness: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.0
    """Where it is known, in units of Blender's principled shader and in [0, 0.5]; 0: held-out views tell it."""
    first_roughness: Roughness = 0.085
    """That of which held-out views are asked first: it lowers their error by 0.04 and 0.03 of it on copies of sculpture
    and vase with 0.1, and raises it by 0.06, 0.22 and 0.15 on sculpture, vase and mirror themselves."""
    least_roughness_gain: Share = 0.01
    """Share by which that has to lower the held-out error, also that of a sharp map which its lobe smooths afterwards:
    there 0.06 on sculpture with a roughness of 0.1, 0.005 with JPEG of quality 40 and 0.008 with noise."""
    least_unexplained: NonNegative = 0.01
    """Held-out error of a sharp map from which anything softer is asked for: 0.10 on a copy of vase with a roughness of
    0.1, and 0.003 on a smooth trial shape in a world without detail, of which a lobe explains 7 % all the same."""
    roughnesses: tuple[Roughness, Roughness] = (0.06, 0.3)
    """Among these it is searched for. Not tuned."""
    roughness_trials: Count = 6
    """So many are tried in the search, which tells it to 15 %, and in that of a blur. Not tuned."""
    judged_pixels: Count = 60_000
    """About so many pixels at most make a map under which roughness is judged: two or three a texel. With fewer, the
    map of a smooth mirror fits noise, and sculpture itself is taken for rough; with many, a smooth mirror in a blurred
    world explains the copy of vase better."""
    judged_resolution: Count = 64
    """Texels along a face side of it. With 128, a roughness of 0.1 comes out as 0.07 to 0.09."""
    judged_rounds: Natural = 8
    """Steps that sharpen it for the first question; the search takes those of the exported map."""
    sharpening_rounds: Natural = 20
    """Steps that sharpen the exported map of a rough mirror. Further ones amplify noise."""
    step_power: Positive = 1.5
    """Exponent of a step: 1 is the method's, more goes faster. Not tuned."""
    sharpening_scale: Positive = 0.16
    """Robust scale of radiance errors, as that of footprints."""
    lit: NonNegative = 0.95
    """Share of the largest value from which a texel of the start is saturated."""
    lamp_border_rad: NonNegative = 0.0123
    """By so much lamps are smaller at the start than what they saturate: a texel of 128. Twice as much costs 1 dB on a
    copy of mirror with 0.1."""
    lamp_light: Positive = 3.0
    """Their radiance at the start, in largest values of views. Chosen among 2, 3 and 10 on copies of vase, mirror and
    sculpture with 0.1: with 10, sculpture loses 2.6 dB."""
    inertia: Positive = 1e-4
    """Added above and below the bar of a step, in rays times radiance, so that what no pixel sees stays. Not tuned."""
    least_light: Positive = 1e-3
    """Radiance at the start of what is darker: zero would stay zero. Not tuned."""
