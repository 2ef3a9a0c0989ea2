"""The tuned numbers of a sphere's fit."""

from dataclasses import dataclass

from shinypartial.io.records import Count, NonEmpty, NonNegative, Positive, Share


@dataclass(frozen=True)
class SphereOptions:
    """How a sphere is fitted to silhouettes and photographs, and what its pixels are.

    "Not tuned" is what only has to be large or small enough.
    """

    radius: NonNegative = 0.0
    """Known radius, in units of the world; 0: unknown. Cameras in different places tell it, so it is for views along
    one line, which leave open how large and how far away a ball is."""
    largest_cone_px: Positive = 0.5
    """The outline of a sphere is a circular cone about the camera, wherever both are. Where the median contour point of
    the median view is farther from the best cone, the object is no sphere. On a rendered ball of 50 px radius it is
    0.05, on an ellipsoid of the axes 1.2, 0.8 and 0.95 1.5, on mirror 5.6, on vase 8.8."""
    largest_ellipticity: Share = 0.005
    """Nor where the contour is an oval about its cone by this share of its radius: an ellipsoid of the axes 1, 1 and
    0.98 is by 0.005 when seen from the side. On the rendered ball it is 0.0002."""
    cone_rounds: Count = 6
    """Rounds of robust weights that a cone is found in. Not tuned."""
    scales_px: NonEmpty[Positive] = (4.0, 2.0, 1.0, 0.5, 0.5)
    """Robust scales, in pixels, of the steps by all outlines. Not tuned."""
    noise_scale: Positive = 3.0
    """A robust scale is no less than so many medians of the distances. Not tuned."""
    samples: Count = 4
    """So many rays along each side of a pixel at the outline tell how far it is covered, and those of every pixel what
    it shows. Not tuned."""
    widest_footprint_rad: Positive = 0.2
    """Pixels that span more tell the map by their centers only. Not tuned."""
    operator_deg: NonNegative = 12.0
    """Of several views, rays that return to their camera within this angle show who holds it, and… With a figure of 1.7
    scene units in two photographs of a rendered ball, 0°, 12° and 25° give maps of 22.5, 22.7 and 22.0 dB; without
    one 24.5, 24.6 and 24.7 dB."""
    operator_trust: Share = 0.01
    """…count so little that any other view of their directions decides. They are a hundredth of all. Not tuned."""
