"""What a fit is trusted by."""

import math
from dataclasses import dataclass

from shinypartial.io.records import Count, NonNegative, Positive


@dataclass(frozen=True)
class TrustOptions:
    """How evidence is gathered, and from what figures on a fit is doubted.

    Limits were chosen on Vase, Mirror and Sculpture, clean and made worse: at 100 px 27 fits that lost 3 dB and 16 that
    did not; those of unexplained light once more at 160 px, 33 that lost and 79 that did not.
    """

    rays: Count = 300_000
    """Most rays that the map without held-out views is solved from, and most that test it."""
    resolution: Count = 128
    """Most texels along a face side of that map."""
    scale: Positive = 0.1
    """Scale s of errors ‖e‖²/(‖e‖² + s²) of linear radiance."""
    cells: Count = 48
    """Along a side of the grid on which a matte surface has its colors."""
    least_noise: Positive = 1e-3
    """Standard deviation of noise below which none is believed."""
    part_cells: Count = 24
    """Along a side of the grid whose cells are places that are explained or not."""
    part_unexplained: Positive = 0.6
    """A place is not explained from this share of the light on that a matte object would leave unexplained."""
    saturated: NonNegative = 0.998
    """Share of the largest radiance from which a pixel is saturated."""
    views: Count = 20
    """Most views of either part, kept and held out, whose silhouettes and places are looked at."""
    shift_scale_px: Positive = 0.5
    """Distance of outlines after a shift beyond which they lose their say in it, or…"""
    shift_medians: Positive = 3.0
    """…so many times the median distance. Not tuned."""
    shift_rounds: Count = 5
    """Rounds of such weights. Not tuned."""
    largest_view_shift_px: Positive = 0.8
    """Root mean square shift of single silhouettes from which a fit is doubted."""
    largest_silhouette_px: Positive = 1.0
    """Median distance of the silhouettes from which it is."""
    largest_share_of_matte: Positive = 0.5
    """Unexplained light over that of a matte object from which it is."""
    largest_unexplained: Positive = 0.15
    """Unexplained share of held-out light from which it is. Of pixels as areas, good fits leave 0.01 to 0.05."""
    largest_unexplained_part: Positive = 0.2
    """Share of the light from places that are not explained from which it is. On the development scene dish a fit that
    misses the hollow has 0.62, one that finds it 0.0005."""
    missed_inside_px: Positive = 4.0
    """Pixels as far inside and outside the masks are asked whether the surface covers them. Not tuned."""
    largest_missed: Positive = 0.03
    """Share of these that it leaves bare from which it is. On the trial shape Pawn, where its neck comes apart, it is
    0.04, and 0 on the development scenes."""
    largest_surplus: Positive = 0.01
    """Pixels that it covers as far outside the masks, over those of the masks, from which it is. Of right fits of the
    development scenes there is none. Not tuned."""
    least_viewed: Positive = 0.08
    """Share of all directions near those of cameras, up to which a fit is doubted. It leaves Mirror trusted, whose 50
    views have 0.145. At 160 px arcs of 30° have 0.083 on it and on Vase, and cost 13 and 4.6 dB."""
    viewed_within_rad: Positive = math.radians(15.0)
    """What is as near to the direction of a camera was seen from it. Not tuned."""
    viewed_directions: Count = 4000
    """Of the sphere, among which these are counted. Not tuned."""
    largest_saturated: Positive = 0.3
    """Share of saturated pixels from which it is."""
    largest_roughness: Positive = 0.1
    """Roughness of the object from which it is. With 0.1, vase loses 7 dB and sculpture 1."""
    least_one_color: Positive = 0.01
    """Light that one color a view leaves unexplained, up to which a fit is doubted."""
    refused: Positive = 2.0
    """How many times its limit a figure has to be for `do not trust`."""
