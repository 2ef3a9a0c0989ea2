"""What decides which kind of geometry a scene needs."""

from dataclasses import dataclass
from typing import Literal

from shinypartial.io.records import Count, NonNegative, Positive, Share


@dataclass(frozen=True)
class SelectionOptions:
    """Thresholds of model selection, chosen on the development scenes."""

    largest_silhouette_px: NonNegative = 0.5
    """A candidate's silhouette lies at most this far from the masks' contours: median over views of the median."""
    least_overlap: Share = 0.98
    """Its silhouette and the masks share at least this part of their union: median over views. Both are for outlines
    that agree with each other. Where they contradict each other a candidate may be farther from them by as much."""
    farthest: Positive = 4.0
    """What is farther off than so many times either is not near, however much outlines contradict each other: wrong
    cameras make them do so, too, and are turned. Not tuned."""
    bent_edge: Positive = 2.0
    """What a kind refines may be farther from the masks by this factor: its edge bends, too. Not tuned."""
    largest_error: NonNegative = 0.3
    """A candidate that leaves more of the held-out views unexplained is refused, unless no later kind explains more.
    Right ones leave a twentieth."""
    doubted_error: NonNegative = 0.15
    """Where a candidate leaves more, those after it are asked, too, but after one that outlines tell wholly. Right ones
    of development scenes leave up to 0.143."""
    doubted_share: Share = 0.5
    """One of those is preferred where it leaves less than this share of that. Not tuned."""
    least_gain: Share = 0.05
    """What is preferred has to lower the held-out error by this share."""
    standard_errors: NonNegative = 2.0
    """And by this many standard errors of the paired differences."""
    compared_rays: Count = 1_000_000
    """Most rays that held-out errors are computed from."""
    trial_resolution: Count = 128
    """Texels along a face side of the compared maps."""


@dataclass(frozen=True)
class LensLimits:
    """When another value of an unknown of the lens is looked for, how far, and when it is believed."""

    least_pull: Positive
    """It is doubted where the pull is larger…"""
    least_posed_pull: Positive
    """…or, where cameras are turned, than this: what is left of that pulls as well."""
    share: Positive
    """Share of a change that pulls, for the first trial only."""
    largest_step: Positive
    """Trials lie at most so far apart."""
    settled: Positive
    """Trials end where the next would lie so near to one before, and what is found beside a shape where it changes by
    less."""
    prior: Positive
    """Expected error. What is not told better is not believed."""
    least_gain: Share
    """Share of the held-out error by which it has to lower that, and by `selection.standard_errors`."""


@dataclass(frozen=True)
class CorrectionOptions:
    """What is taken back of the photographs' own errors, where held-out views gain by it.

    "Development scenes" are vase, mirror and sculpture at 160 px; "not tuned" is what only has to be large or small
    enough.
    """

    masks: Literal["auto", "off"] = "auto"
    """Whether all masks may be too small or too large by one distance."""
    exposure: Literal["auto", "off"] = "auto"
    """Whether views, or their channels, may be exposed differently; never in a high dynamic range."""
    lens: Literal["auto", "on", "off"] = "auto"
    """Whether the focal length of all views may be wrong by one factor, and their lens distort: where photographs pull
    a fit and held-out views gain by it, whenever it is found, or never."""
    largest_error: Share = 0.08
    """Held-out error of a fit above which masks are doubted. Right ones of development scenes leave at most 0.06, masks
    that are off by 2 px at least 0.10."""
    step_px: Positive = 2.0
    """Offsets are tried this far apart. Not tuned."""
    halvings: Count = 2
    """…and how often the step is halved around the best of them: of a goblet of 80 px whose masks are 1.5 px too
    large, steps of 2 px alone tell −0.4."""
    largest_px: Positive = 6.0
    """Largest offset that is tried."""
    doubted_inward_px: Positive = 0.03
    """Masks are doubted, too, where outlines of a fit give way to photographs by more: inward…"""
    doubted_outward_px: Positive = 0.01
    """…or outward. On sculpture it is 0.08 and 0.11 with masks that are off by 1 px. With masks that are right it is
    0.004 outward there and none on seven trial shapes, but up to 0.021 inward: a surface that is too smooth for its
    edges lies inside them. With masks that are 2 px too small it is 0.015 on the trial shape ellipsoid."""
    pull_share: Positive = 0.17
    """Share of a small offset by which outlines of a fit give way. On vase 0.18, on sculpture 0.16."""
    least_pull_px: Positive = 0.005
    """The fit to moved masks stays where its outlines lie nearer to them than this. With masks that are right it is
    0.001 on vase and 0.004 on sculpture. Moved by 1.9 px where 2 were missing, vase is not followed with 0.02, and its
    normals are off by 0.17 instead of 0.05 degrees."""
    examined_rays: Count = 100_000
    """Most rays from which a fit is told to leave much unexplained, and gains to explain more. Not tuned."""
    rays: Count = 60_000
    """Most rays of a map, and most that test it, in these trials. Not tuned."""
    resolution: Count = 64
    """Texels along a face side of that map. Not tuned."""
    least_stops: NonNegative = 0.02
    """Standard deviation of the gains, in stops, below which they are not believed."""
    rounds: Count = 4
    """Rounds of map and gains. Not tuned."""
    gain_scale: Positive = 0.1
    """Residual (linear radiance) beyond which a pixel loses its vote on the gain of its view. Not tuned."""
    lens_rays: Count = 100_000
    """Rays that tell how far photographs pull a fit toward another lens. Not tuned."""
    lens_resolution: Count = 128
    """Texels along a face side of the map under which they do. With 64, a true focal length pulls mirror by 0.0005."""
    lens_scale: Positive = 0.15
    """Residual (linear radiance) beyond which a ray loses its vote on that. Not tuned."""
    lens_compared_rays: Count = 500_000
    """Most rays of a map, and most that test it, where lenses are compared. On vase through a lens of k₁ = 0.1 the
    right lens leaves 0.83 of the error so, under 256 texels; by 240,000 rays and 128 texels it leaves 0.99, and by
    60,000 and 64 more than the wrong one."""
    lens_sigmas: Positive = 3.0
    """The lens is doubted where the pull is larger than so many of its standard deviations, too. On vase in a room at 5
    radii a true focal length pulls by 0.0005, 2.3 of them; on sculpture, one that is 2 % too long by 5."""
    lens_trials: Count = 3
    """Most fits to other focal lengths or distortions. Not tuned."""
    farthest_lens: Positive = 3.0
    """A change that is larger than so many expected errors is not believed, nor…"""
    nearest_lens: Positive = 2.0
    """…one that is no larger than so many of its own standard deviations. Neither is tuned."""
    focal: LensLimits = LensLimits(
        least_pull=0.0004,
        least_posed_pull=0.002,
        share=0.06,
        largest_step=0.03,
        settled=0.0015,
        prior=0.02,
        least_gain=0.003,
    )
    """Of the logarithm of the focal length. A true one pulls by 0.00002 on vase, 0.0002 on mirror and 0.00014 on
    sculpture, one that is 2 % too long by 0.0046, 0.0126 and 0.0010; on vase, what is left of turns by 0.5° pulls by
    0.0008. The share of a change that pulls is 0.06 on sculpture, 0.23 on vase and 0.6 on mirror. On vase the noise of
    the pull is as much as 0.001 of a change. Found beside the shape it is off by 0.0003 to 0.0057 on sculpture and
    chrome-block."""
    k1: LensLimits = LensLimits(
        least_pull=0.008,
        least_posed_pull=0.02,
        share=0.14,
        largest_step=0.15,
        settled=0.01,
        prior=0.1,
        least_gain=0.01,
    )
    """Of the radial distortion; lenses of phones have about 0.06. A pinhole pulls by 0.0003 on vase, 0.003 on sculpture
    and cola and 0.005 on the bundled vase of 88 px, a distortion of 0.1 by 0.014 on vase and 0.022 on sculpture: shares
    of 0.14 and 0.22. Found beside the shape it is off by 0.005 to 0.02 on sculpture and dish. Where it is right it has
    explained 0.17 and 0.03 more on vase and trial shapes. The pull of turned cameras is not tuned."""
    least_outline_fall: Share = 0.15
    """Share of the outlines' distance from the masks by which it has to lower that where it takes the place of near
    surroundings. On mirror, 2 % are told by 0.3 of it."""
