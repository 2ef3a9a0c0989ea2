"""What decides which kind of geometry a scene needs."""

from dataclasses import dataclass

from shinypartial.io.records import Count, NonNegative, Share


@dataclass(frozen=True)
class SelectionOptions:
    """Thresholds of model selection, chosen on the development scenes."""

    largest_silhouette_px: NonNegative = 0.5
    """A candidate's silhouette lies at most this far from the masks' contours: median over views of the median."""
    least_overlap: Share = 0.98
    """Its silhouette and the masks share at least this part of their union: median over views."""
    largest_error: NonNegative = 0.3
    """A candidate that another kind takes on (a plane) is refused if it leaves more of the held-out views unexplained,
    even if surfels do no better. Right ones leave a twentieth."""
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
