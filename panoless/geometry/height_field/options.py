"""The tuned numbers of a height field's fit."""

from dataclasses import dataclass

from panoless.geometry.plane.options import PlaneOptions
from shinypartial.io.records import Count, Finite, Natural, NonEmpty, NonNegative, Positive, Share


@dataclass(frozen=True)
class HeightFieldRound:
    """Gauss–Newton steps, the map solved anew before each."""

    resolution: Count
    """Texels along a face side of the map."""
    robust_scale: Positive
    """Residual (linear radiance) beyond which a pixel loses its vote."""
    rays: Count
    """About so many pixels of all views take part."""
    steps: Natural
    """Most steps."""


@dataclass(frozen=True)
class HeightFieldOptions:
    """How a height over a plane is fitted to silhouettes and photographs.

    "Development scenes" are vase, cola, mirror, deformed-mirror and sculpture; "not tuned" is what only has to be large
    or small enough.
    """

    cells: Count = 16
    """Cells of the spline along the longer side of the boundary, to begin with. Chosen on the development scenes."""
    halvings: Natural = 1
    """How often they may be halved, where held-out views gain by it. Not tuned."""
    judged_steps: Natural = 2
    """Steps on a finer grid after which it is judged. Not tuned."""
    max_points: Count = 20_000
    """Most contour points of all views. Not tuned."""
    edge_scales_px: NonEmpty[Positive] = (2.0, 1.0, 1.0, 0.5, 0.5, 0.5)
    """Robust scales, in pixels, of the first steps, which ask contours only. Not tuned."""
    start_slopes: NonEmpty[Finite] = (0.0, 0.2, 0.4, 0.6, -0.2, -0.4, -0.6)
    """Domes and bowls, by their slope at the edge, of which the one that photographs agree on best is the start. With a
    spherical cap of slope 0.45, photographs leave half as much of 0.4 and 0.5 as of 0.2 and 0.6, and of a flat mirror
    half as much as of 0.1."""
    slope_steps: tuple[Positive, ...] = (0.1, 0.05, 0.025)
    """By these the best of them is made steeper or flatter, unless it is flat. Halves of the steps between them, and of
    these; not tuned."""
    edge_bending: NonNegative = 1e-2
    """Weight of the bending energy in these steps, against the mean diagonal of the data: contours say nothing of the
    inside. Not tuned.
    """
    contour_scale_px: Positive = 0.5
    """Robust scale of the contours, in pixels, beside photographs. Not tuned."""
    contour_sigma_px: Positive = 0.05
    """Standard deviation of a contour point, in pixels. Less than its median error of 0.07 px, because photographs
    count pixel by pixel, but errors of the map are common to all rays of a texel. Chosen on the development scenes.
    """
    radiance_sigma: Positive = 0.05
    """Standard deviation of a pixel (linear radiance). Chosen on the development scenes."""
    bending: NonNegative = 1e-4
    """Weight of the bending energy beside photographs. Chosen on the development scenes."""
    rounds: NonEmpty[HeightFieldRound] = (
        HeightFieldRound(16, 0.5, 60_000, 12),
        HeightFieldRound(32, 0.3, 60_000, 8),
        HeightFieldRound(64, 0.3, 60_000, 6),
        HeightFieldRound(128, 0.1, 200_000, 4),
    )
    """From coarse to fine: the first texels are as wide as a ray turns when its normal does by 2.8°. Only in the last
    round do photographs tell the tilt of the whole. Chosen on the development scenes.
    """
    least_fall: Share = 1e-3
    """A round ends with a step that lowers its cost by a smaller share. Not tuned."""
    clear_px: NonNegative = 1.0
    """A mirrored ray has to pass the frame at least this far away, in pixels: pixels are no points. Not tuned."""
    clearances: tuple[NonNegative, ...] = (0.03, 0.06, 0.12)
    """Heights over the plane, in radii of the object, that mirrored rays may have to pass at the boundary, each tried
    after the one before. Not tuned."""
    least_cleared: Share = 0.1
    """Share of the held-out error by which one has to lower it. Before a rim of 0.076 radii these three leave 0.81,
    0.72 and 0.72 of it."""
    contours: PlaneOptions = PlaneOptions()
    """How contours are weighted; of these only corners, noise and the pull of vertices."""
