"""The tuned numbers of the surface of revolution, in one place. Imports nothing heavy.

Lengths in px are lengths of a pixel at the object; radiance is linear, in [0, 1]. Unless a docstring says otherwise, a
number was chosen on the development scenes Vase (open, smooth) and Cola (closed, grooves) at 400 px.
"""

import math
from dataclasses import dataclass

from shinypartial.io.records import Count, Natural, NonEmpty, NonNegative, Positive, Share


@dataclass(frozen=True)
class SilhouetteOptions:
    """Axis and outside from masks alone."""

    start_views: Count = 24
    """Views whose principal axes propose an axis."""
    start_points: Count = 1500
    """Contour points of a coarse fit."""
    start_cell_px: Positive = 3.0
    """Spacing of the profile in a coarse fit."""
    start_scales_px: NonEmpty[Positive] = (16.0, 16.0, 16.0, 16.0)
    """Robust scales of the steps of a coarse fit."""
    points: Count = 30_000
    """Contour points of the final fit."""
    scales_px: NonEmpty[Positive] = (4.0, 2.0, 1.0, 1.0, 0.5, 0.5)
    """Robust scales of its steps."""
    noise_multiple: NonNegative = 3.0
    """Robust scales are at least this many medians of the distances."""
    rank_share: Share = 0.02
    """Share of the rays at a height that may cut into the body by noise."""
    tip_cells: NonNegative = 1.5
    """A profile narrower than this ends in a tip."""
    blunt_cells: NonNegative = 4.0
    """A profile wider than this may end flat, where silhouettes stop telling its slope."""
    widest_within: Positive = 0.6
    """The widest place of the body has a height below this, in radii of the object frame."""
    least_cells: Count = 5
    """Fewer cells make no profile."""
    grazing_rad: Positive = math.radians(10.0)
    """Silhouettes don't tell slopes within this angle of the lowest camera's line of sight over an end."""
    bending: NonNegative = 1e-3
    """Penalty on second differences of a step, in mean diagonals of the normal matrix."""
    largest_turn_rad: Positive = 0.1
    """Most that a step turns the axis, and shifts it in radii of the object frame."""
    damping: Positive = 1e-6
    """Of every step, in mean diagonals."""
    judged_scale_px: Positive = 2.0
    """Scale s of the errors e²/(e² + s²) by which coarse fits are compared. Not tuned."""
    largest_start_cost: Share = 0.6
    """Mean of them over a coarse fit above which no axis is near."""
    least_views: Count = 6
    """Fewer views with a contour propose nothing."""
    believed_overlap: Share = 0.98
    """Of the closed body with the masks, from which no stem is looked for: what model selection asks for."""
    scored_views: Count = 16
    """Views over which the overlap of a proposal is measured."""


@dataclass(frozen=True)
class Round:
    """Steps under one map: its resolution, the robust scale of radiance, spacing of the splines, penalty on bending."""

    resolution: Count
    robust: Positive
    knot_px: Positive
    steps: Natural
    bending: NonNegative = 1e-4


@dataclass(frozen=True)
class PhotometricOptions:
    """Axis and profile by what single rays through pixel centers mirror."""

    coarse: NonEmpty[Round] = (Round(64, 0.3, 3.0, 2), Round(128, 0.3, 2.0, 2))
    """Rounds before the mouth is opened."""
    fine: NonEmpty[Round] = (
        Round(128, 0.2, 1.5, 2),
        Round(256, 0.2, 1.5, 2),
        Round(256, 0.1, 1.0, 2),
        Round(256, 0.1, 1.0, 2),
    )
    """Rounds after."""
    map_rays: Count = 600_000
    """Rays that a round's map is solved from."""
    pixels: Count = 120_000
    """Pixels of a step."""
    contour_points: Count = 20_000
    """Contour points of a step."""
    contour_scale_px: Positive = 1.0
    """Robust scale of the contours."""
    contour_sigma_px: Positive = 0.15
    """Standard deviation of contours, which weighs them against radiance."""
    radiance_sigma: Positive = 0.05
    """Standard deviation of radiance under a right map."""
    least_cosine: Share = 0.05
    """Rays that graze the surface more than this have no vote: they amplify every error."""
    least_radius_px: NonNegative = 1.0
    """Nearer to the axis, azimuth is not determined."""
    least_fall: Share = 1e-3
    """A round ends with a step that lowers its cost by a smaller share."""


@dataclass(frozen=True)
class MouthOptions:
    """Which end of the axis is open, and what is inside."""

    pixels: Count = 100_000
    """Pixels among which those are counted that see an end of the closed surface."""
    unclear_share: Share = 0.1
    """Both ends are tried if the one that fewer pixels see is seen by more than this share of the other's. Chosen so
    that cameras between −10° and 50° of elevation leave no doubt."""
    thin_walls: bool = True
    """Whether a wall without thickness, which mirrors on both faces, is among the candidates."""
    judged_pixels: Count = 120_000
    """Pixels of the held-out views among which those that see an end judge the candidates."""
    searched_resolution: Count = 128
    """Texels along a face side of the map under which an interior is searched again."""
    slopes: Count = 48
    """Directions of the profile that the search tells apart."""
    cell_px: Positive = 0.75
    """Size of the search's cells."""
    cells: Count = 128
    """Most cells along the radius; wider mouths have larger cells."""
    depth: Positive = 0.8
    """Of the search, in radii of the mouth."""
    rows_above: Natural = 3
    """Cells above the lip: a rolled lip rises on where silhouettes end."""
    searched_pixels: Count = 60_000
    """Most pixels that vote."""
    error_scale: Positive = 0.15
    """Scale s of a vote ‖e‖²/(‖e‖² + s²)."""
    few_pixels: Positive = 4.0
    """Votes' worth of the cost of an unseen cell that every cell starts with."""
    unseen_cost: NonNegative = 0.7
    """Cost of a cell and slope that no pixel sees: worse than a fair one, better than a wrong one."""
    reach: Count = 3
    """Cells that an edge of the path spans at most."""
    settled_share: Share = 0.05
    """Share of all pixels that the ends may leave unexplained, the held-out error times the share that sees them. Where
    it is more, candidates descend by steps under coarse maps…"""
    descending: NonNegative = 1.25
    """…whose error is within so many times the least. Chosen on a plate and a bowl with thick walls, whose right
    inside is the best at first, too."""
    descent: tuple[Round, ...] = (
        Round(8, 0.5, 6.0, 4),
        Round(16, 0.5, 4.0, 4),
        Round(32, 0.4, 3.0, 4),
        Round(64, 0.3, 2.0, 4),
    )
    """Rounds of that descent."""
    descent_pixels: Count = 30_000
    """Pixels of its steps."""
    descent_rays: Count = 150_000
    """Rays of its maps."""


@dataclass(frozen=True)
class FloorOptions:
    """The floor of a vessel, seen by way of its walls: the height of a cubic in the middle."""

    pixels: Count = 2500
    """Pixels whose paths meet the floor that judge heights."""
    least_pixels: Count = 200
    """Fewer tell nothing."""
    searched_pixels: Count = 400_000
    """Pixels of all views among which those are searched."""
    heights: Count = 16
    """Tried to either side of a flat floor, in steps of a 64th of its radius."""
    halvings: Natural = 6
    """Of the step around the best height."""
    sides: Count = 24
    """Of the profile's polyline along the floor."""
    wall_px: NonNegative = 9.0
    """Length of the wall from which its slope is found where the floor begins."""


@dataclass(frozen=True)
class LipOptions:
    """The lip: by silhouettes, then by pixels that mix it with what lies around it."""

    least_rays: Count = 20
    """Fewer contour rays over the lip leave it where it is."""
    farthest_px: Positive = 6.0
    """Contour rays that pass the lip farther away touch something else."""
    steps: Natural = 6
    """Of placing the lip by silhouettes."""
    tip_damping: Positive = 2e-3
    """Of each of them, in mean diagonals. Not tuned."""
    spoiled_px: NonNegative = 7.0
    """Length of the wall below a flat lid that the lid's corner bends."""
    fitted_px: Positive = 16.0
    """Length of the wall from which a cubic is led on to the lip."""
    tip_weight: NonNegative = 4.0
    """Of the lip in that cubic, in vertices of the wall."""
    end_px: NonNegative = 4.0
    """Length of a thin wall below its lip that no pixel sees alone."""
    clearance_px: Natural = 2
    """Pixels nearer to the image of a thin wall's lip may show what lies before and behind it."""
    length_px: Positive = 20.0
    """Length of the wall that is refined by mixed pixels."""
    knot_px: Positive = 3.0
    """Of its B-splines."""
    reach_px: Natural = 5
    """Mixed pixels are nearer to the image of the lip than this, or mirrored more than once."""
    pixels: Count = 8_000
    """Mixed pixels of the refinement."""
    least_pixels: Count = 500
    """Fewer tell nothing."""
    judged_pixels: Count = 30_000
    """Pixels of the held-out views, all over the vessel, that a moved lip must not explain worse. Not tuned."""
    refined_steps: Natural = 3
    """Gauss–Newton steps of the refinement."""
    lengths: NonEmpty[Positive] = (4.0, 2.0, 1.0, 0.5)
    """Of a step, tried in turn: radiance that changes by leaps makes steps too short."""
    difference_px: Positive = 0.05
    """Of the derivatives."""
    largest_step_px: Positive = 0.5
    """Most that a parameter changes in a step of length one."""
    parameter_sigma_px: NonNegative = 0.05
    """Standard deviation of what is not fitted: pixels that change much with the parameters count less."""
    damping: Positive = 1e-3
    """In mean diagonals."""


@dataclass(frozen=True)
class FootprintOptions:
    """Grooves and edges no wider than some pixels: pixels as areas, coarse to fine."""

    spacing_px: Positive = 1 / 3
    """Of the vertices: an edge is as sharp as they are dense."""
    rounds: NonEmpty[Round] = (
        Round(32, 0.5, 1.5, 4),
        Round(64, 0.4, 1.5, 4),
        Round(128, 0.3, 1.0, 4),
        Round(256, 0.2, 0.7, 4, 1e-5),
    )
    """Blurred maps first: their basins are as wide as the normals are wrong."""
    map_rays: Count = 2_000_000
    """Rays of the map, which has the resolution of the last round."""
    pixels: Count = 60_000
    """Pixels of a step."""
    largest_share: Share = 1 / 3
    """Of all pixels that are taken."""
    searched_pixels: Count = 2_000_000
    """Pixels among which those are searched that see the profile turn."""
    curved_rad: NonNegative = math.radians(2.0)
    """Where the profile turns by more within two pixels, single rays tell less than areas."""
    curved_share: Share = 0.75
    """Of the pixels taken that see such a place."""
    edge_rad: NonNegative = math.radians(8.0)
    """Where the profile turns by more within two pixels, there is an edge or a groove."""
    least_edge_share: Share = 0.01
    """Of the pixels that see one: with fewer, areas are not worth their time. It is 0 on Vase and 0.21 on Cola."""
    counted_pixels: Count = 100_000
    """Pixels among which those are counted."""


@dataclass(frozen=True)
class MapOptions:
    """The pixels of the final map of a surface of revolution."""

    confidence_texel_rad: Positive = math.pi / 2 / 128
    """A pixel that spans a wider angle says little about any texel: confidence 1/(1 + a/t) with t its square."""
    pixels: Count = 3_500_000
    """Most pixels with a footprint."""
    traced: Count = 60_000
    """Pixels without a smooth footprint that tell how bright saturated regions are."""


@dataclass(frozen=True)
class RenderingOptions:
    """How a picture is made of a surface and a map."""

    max_bounces: Count = 16
    """Reflections after which a ray is black. As many as the renderer of the data sets follows."""
    samples: Count = 4
    """Rays along either side of a pixel: a box filter, as in the data sets."""
    largest_bend: NonNegative = 0.05
    """Second differences of directions (rad per pixel²) up to which they are interpolated between pixels."""


@dataclass(frozen=True)
class RevolutionOptions:
    """All of them."""

    silhouette: SilhouetteOptions = SilhouetteOptions()
    photometric: PhotometricOptions = PhotometricOptions()
    mouth: MouthOptions = MouthOptions()
    floor: FloorOptions = FloorOptions()
    lip: LipOptions = LipOptions()
    footprints: FootprintOptions = FootprintOptions()
    map: MapOptions = MapOptions()
    rendering: RenderingOptions = RenderingOptions()
    max_bounces: Count = 6
    """Reflections that a fit follows."""
    judged_scale: Positive = 0.1
    """Scale s of the errors ‖e‖²/(‖e‖² + s²) by which held-out views judge."""
    least_gain: Share = 0.02
    """Share of the held-out error by which a refinement has to be better to be kept."""


DEFAULTS = RevolutionOptions()
