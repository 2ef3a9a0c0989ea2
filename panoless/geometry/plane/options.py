"""The tuned numbers of a plane's fit."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from shinypartial.io.records import Count, Finite, Natural, NonEmpty, NonNegative, Positive, Share


@dataclass(frozen=True)
class BoundaryRound:
    """A boundary by vote of the masks on a grid, then one Gauss–Newton step on plane and boundary for each scale."""

    grid: Annotated[int, Meta(ge=2)]
    """Points along a side of the grid."""
    level: Share
    """The boundary runs where this share of the largest vote is; later rounds see sharper edges. Not tuned."""
    tolerance_cells: Positive
    """The voted boundary is simplified by at most this many cells. Not tuned."""
    scales_px: NonEmpty[Positive]
    """Robust scales of the steps, in pixels: from coarse to fine. Not tuned."""


@dataclass(frozen=True)
class PlaneOptions:
    """How a plane and its boundary are fitted to silhouettes.

    "Development scenes" are vase, cola, mirror, deformed-mirror and sculpture; "not tuned" is what only has to be large
    or small enough.
    """

    min_views: Annotated[int, Meta(ge=2)] = 3
    """Fewest distinct views that determine a plane. Not tuned."""
    min_baseline: NonNegative = 0.02
    """Distance between two cameras, as a share of their distance from the object, that makes them distinct. Not tuned.
    """

    start_directions: Count = 200
    """Normals that are tried, evenly over the sphere. Not tuned."""
    start_offsets: NonEmpty[Finite] = (-0.2, 0.0, 0.2)
    """Offsets that are tried with each, in radii of the object. Not tuned."""
    start_cosine: Share = 0.15
    """A plane faces a camera if the cosine between its normal and the direction to it is above this. Not tuned."""
    start_grid: Annotated[int, Meta(ge=2)] = 32
    """Points along a side of the grid on which masks are compared at the start. Not tuned."""
    start_views: Count = 16
    """Views that are compared at the start. Not tuned."""
    start_half_side: Positive = 1.2
    """Half a side of that grid, in radii of the object. Not tuned."""
    starts: Count = 3
    """So many of the best starts go through the first round. Not tuned."""

    max_points: Count = 40_000
    """Most contour points of all views. Not tuned."""
    max_vertices: Annotated[int, Meta(ge=3)] = 128
    """Most vertices of the boundary. Not tuned."""
    voting_views: Count = 32
    """Views whose masks vote for the boundary. Not tuned."""
    first_round: BoundaryRound = BoundaryRound(96, 0.5, 1.0, (16.0, 8.0, 8.0))
    """From each start."""
    later_rounds: tuple[BoundaryRound, ...] = (
        BoundaryRound(128, 0.5, 1.0, (4.0, 4.0, 2.0, 2.0)),
        BoundaryRound(256, 0.4, 0.7, (1.0, 1.0, 0.5, 0.5, 0.5)),
    )
    """From the best of them."""
    hopeless_px: NonNegative = 2.0
    """A start whose median contour point is further from the boundary than this, and than a cell of its grid, is no
    plane. Chosen on the development scenes: planes were within a tenth of a cell, vase and can two to four cells away.
    """
    largest_step: Positive = 0.2
    """Most by which a step may move any parameter, in radii of the object or radians. Not tuned."""
    final_scale_px: Positive = 0.5
    """Robust scale of the last steps, in pixels. Not tuned."""
    final_steps: Natural = 3
    """Steps after each simplification. Not tuned."""
    simplifications: Natural = 2
    """How often the boundary is simplified. Not tuned."""
    simple_px: Positive = 0.25
    """A vertex goes if the boundary without it is nowhere further away than this, in pixels. Not tuned."""
    chamfer_px: NonNegative = 6.0
    """Shorter sides, in pixels, that cut the corner of longer ones are removed: votes round corners. Chosen on the
    development scenes.
    """
    frame_sigmas: NonNegative = 3.0
    """A frame is kept if its height is this many standard deviations above zero. Not tuned."""

    corner_deg: Annotated[float, Meta(ge=0, le=180)] = 20.0
    """Sides that turn by more than this, in degrees, meet in a corner. Not tuned."""
    corner_px: NonNegative = 1.5
    """Contour points nearer to a corner than this, in pixels, do not count: the level set of pixel averages is round
    there. Not tuned.
    """
    noise_scale: NonNegative = 3.0
    """The robust scale is at least this times the median distance, so that wrong poses leave all views a say. Not
    tuned.
    """
    vertex_pull: NonNegative = 1e-3
    """Weight of a vertex's place against the contour points of its side: along a straight side nothing else holds it.
    Not tuned.
    """
