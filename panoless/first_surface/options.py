"""The tuned numbers of the first surface. Lengths in pixels are of training views, at the object."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from shinypartial.io.records import Count, Finite, Natural, NonNegative, Positive, Share


@dataclass(frozen=True)
class FirstSurfaceOptions:
    """How the hull is carved, what counts as contact with a silhouette, and how stiff the plate between contacts is.

    Where nothing else is said, a value was chosen on the five development scenes (vase, cola, mirror, deformed mirror,
    sculpture) at 400 px, by the normals of the first surface.
    """

    hull_resolution: Annotated[int, Meta(ge=8)] = 96
    """Voxels along a side of the cube in which the hull is carved; outlines count below the size of a voxel."""
    hull_votes: Share = 0.96
    """Least share of the views whose mask must keep a point of the hull; all views count unless they contradict."""
    coarse_voxels: Annotated[int, Meta(ge=2)] = 48
    """Voxels along a side of the grid on which carving starts; it is halved until it is fine enough. For speed."""
    band_voxels: NonNegative = 1.5
    """|h|, in voxels, below which the surface may pass through a voxel's refined cells: half its diagonal and some to
    spare. Geometry, not tuned."""
    tested_rays: Count = 4000
    """Rays through silhouettes that tell whether the views agree."""
    ray_samples: Count = 128
    """Points tested along each of them."""
    largest_gap_px: NonNegative = 10.0
    """A ray that passes the hull at more than this distance counts as one at this distance."""
    worthwhile_px: NonNegative = 0.25
    """Views are left out as contradictory if that closes the rays' mean gap by more than this."""
    contradiction_px: Finite = 0.5
    """Where the median ray passes the hull at more than this, cameras are a little off. It is −0.4 on the trial shapes
    brick and ellipsoid, and 4.6 and 5.0 with cameras turned by 2°. Not tuned."""
    least_votes: Share = 0.6
    """The share of the views that has to agree at least where they are. On these two 0.78 did. Not tuned."""
    contact_px: Positive = 3.9
    """Standard deviation of a hull vertex from a silhouette's cone, and of its contact from the contour generator along
    the ray."""
    least_trust: Share = 0.01
    """Trust in a hull vertex below this is none."""
    trust_floor: Positive = 1e-7
    """Trust added to every vertex, so that the plate is determined where nothing is trusted. Not tuned."""
    neighbor_view_deg: Positive = 12.0
    """Views are compared for a contact over about this angle between their directions."""
    neighbor_height_deg: Positive = 8.0
    """…and over about this difference of their heights above the tangent plane."""
    contact_views: Count = 150
    """Views that tell contacts, at most: as well as all of a long video."""
    plate_length_px: NonNegative = 5.0
    """Details of the trusted hull shorter than this are smoothed."""
    pixels_a_voxel: Positive = 4.5
    """The two lengths above are in pixels, or in voxels divided by this where the grid is coarser than the images."""
    obstacle_px: NonNegative = 0.25
    """A plate that leaves the hull by more than this is held on it, as if a silhouette touched it there."""
    obstacle_trust: Share = 0.5
    """Trust in such a point."""
    obstacle_rounds: Natural = 3
    """Solutions of the plate with ever more such points."""
    projection_steps: Natural = 3
    """Newton steps by which points outside the hull are moved onto it."""
    least_slope: Positive = 0.5
    """Lower bound of |∇h| in such a step, dimensionless: 1 for a distance. Not tuned."""


DEFAULTS = FirstSurfaceOptions()
