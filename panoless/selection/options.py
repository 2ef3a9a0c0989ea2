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
    """Its silhouette and the masks share at least this part of their union: median over views."""
    bent_edge: Positive = 2.0
    """What a kind refines may be farther from the masks by this factor: its edge bends, too. Not tuned."""
    largest_error: NonNegative = 0.3
    """A candidate that leaves more of the held-out views unexplained is refused even if surfels do no better, unless no
    later kind explains more. Right ones leave a twentieth."""
    doubted_error: NonNegative = 0.15
    """Where a candidate leaves more, those after it are asked, too. Right ones of development scenes leave up to
    0.143."""
    doubted_share: Share = 0.5
    """One of those is preferred where it leaves less than this share of that. Not tuned."""
    explained_error: Share = 0.03
    """A candidate that no other kind takes on, and that leaves less of the held-out views unexplained, is chosen
    without asking surfels. On sculpture and on other shapes of trial these leave 0.04 and more."""
    least_gain: Share = 0.05
    """Surfels have to lower the held-out error by this share to be preferred."""
    standard_errors: NonNegative = 2.0
    """And by this many standard errors of the paired differences."""
    compared_rays: Count = 1_000_000
    """Most rays that held-out errors are computed from."""
    trial_share: Share = 0.2
    """Share of the configured iterations that surfels are given for the comparison."""
    trial_resolution: Count = 128
    """Texels along a face side of the compared maps."""


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
    """Whether the focal length of all views may be wrong by one factor: where photographs pull a fit and held-out views
    gain by it, whenever it is found, or never."""
    largest_error: Share = 0.08
    """Held-out error of a fit above which masks are doubted, and focal lengths not asked for. Right ones of development
    scenes leave at most 0.06, masks that are off by 2 px at least 0.10. A kind that goes on from a fit tells of masks
    in seconds, so they are doubted from `explained_error` of the model selection on: drum leaves 0.018, with masks that
    are 1 px too large 0.038; chrome-block leaves 0.031 and sculpture 0.026."""
    step_px: Positive = 2.0
    """Offsets are tried this far apart. Not tuned."""
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
    followed_step_px: Positive = 1.0
    """By so much masks are moved each time that such a kind goes on. Not tuned."""
    least_pull_px: Positive = 0.005
    """The fit to moved masks stays where its outlines lie nearer to them than this. With masks that are right it is
    0.001 on vase and 0.004 on sculpture. Moved by 1.9 px where 2 were missing, vase is not followed with 0.02, and its
    normals are off by 0.17 instead of 0.05 degrees."""
    settled_pull: Share = 0.5
    """Share of a doubted pull that is left a step nearer to the right masks: there any gain beyond its standard errors
    counts. Not tuned."""
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
    focal_rays: Count = 100_000
    """Rays that tell how far photographs pull a fit toward another focal length. Not tuned."""
    focal_resolution: Count = 128
    """Texels along a face side of the map under which they do. With 64, a true focal length pulls mirror by 0.0005."""
    focal_scale: Positive = 0.15
    """Residual (linear radiance) beyond which a ray loses its vote on that. Not tuned."""
    least_focal_pull: Positive = 0.0004
    """The focal length is doubted where the pull is larger. A true one pulls by 0.00002 on vase, 0.0002 on mirror and
    0.00014 on sculpture, one that is 2 % too long by 0.0046, 0.0126 and 0.0010."""
    least_posed_focal_pull: Positive = 0.002
    """The same where cameras are turned, too: what is left of that pulls as well, by 0.0008 on vase with turns of 0.5°.
    """
    focal_sigmas: Positive = 3.0
    """And larger than so many of its standard deviations. On vase in a room at 5 radii a true one pulls by 0.0005, 2.3
    of them; on sculpture, one that is 2 % too long by 5."""
    focal_share: Positive = 0.06
    """Share of a change of the focal length that pulls, for the first trial only: the least of development scenes, that
    of sculpture. On vase it is 0.23, on mirror 0.6."""
    largest_focal_step: Positive = 0.03
    """Trials lie at most so far apart, in logarithms of the focal length."""
    settled_focal: Positive = 0.0015
    """Trials end where the next would lie so near to one before. On vase the noise of the pull is as much as 0.001."""
    focal_trials: Count = 3
    """Most fits to other focal lengths. Not tuned."""
    focal_prior: Positive = 0.02
    """Expected error of the focal length as a share of it. A factor that is not told better is not believed."""
    farthest_focal: Positive = 3.0
    """A factor that is farther from one than so many expected errors is not believed, nor…"""
    nearest_focal: Positive = 2.0
    """…a change that is no larger than so many of its own standard deviations. Neither is tuned."""
    focal_error: Share = 0.004
    """Standard deviation of a factor that was found as an unknown beside the shape. On sculpture and chrome-block it is
    off by 0.0003 to 0.0057."""
    least_focal_gain: Share = 0.003
    """Share of the held-out error by which another focal length has to lower it, and by `selection.standard_errors`."""
    least_outline_fall: Share = 0.15
    """Share of the outlines' distance from the masks by which it has to lower that where it takes the place of near
    surroundings. On mirror, 2 % are told by 0.3 of it."""
