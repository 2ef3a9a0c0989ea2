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
class PoseOptions:
    """Whether cameras may be elsewhere than stated."""

    mode: Literal["auto", "off", "on"] = "auto"
    """Whether poses are unknowns: where the scene needs them, never, or always."""


@dataclass(frozen=True)
class CorrectionOptions:
    """What of the photographs' own errors is unknown, and corrected where the scene needs it."""

    masks: Literal["auto", "off"] = "auto"
    """Whether masks may be too small or too large, all by one distance and each by another."""
    exposure: Literal["auto", "off"] = "auto"
    """Whether views, or their channels, may be exposed differently; never in a high dynamic range."""
    lens: Literal["auto", "on", "off"] = "auto"
    """Whether the focal length of all views may be wrong by one factor, and their lens distort: where the scene needs
    it, always, or never."""
