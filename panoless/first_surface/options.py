"""The tuned numbers of the first surface. Lengths in pixels are of training views, at the object."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FirstSurfaceOptions:
    """How the hull is carved, what counts as contact with a silhouette, and how stiff the plate between contacts is.

    Where nothing else is said, a value was chosen on the five development scenes (vase, cola, mirror, deformed mirror,
    sculpture) at 400 px, by the normals of the first surface.
    """

    coarse_voxels: int = 48
    """Voxels along a side of the grid on which carving starts; it is halved until it is fine enough. For speed."""
    band_voxels: float = 1.5
    """|h|, in voxels, below which the surface may pass through a voxel's refined cells: half its diagonal and some to
    spare. Geometry, not tuned."""
    tested_rays: int = 4000
    """Rays through silhouettes that tell whether the views agree."""
    ray_samples: int = 128
    """Points tested along each of them."""
    largest_gap_px: float = 10.0
    """A ray that passes the hull at more than this distance counts as one at this distance."""
    worthwhile_px: float = 0.25
    """Views are left out as contradictory if that closes the rays' mean gap by more than this."""
    contradiction_px: float = 0.5
    """Where the median ray passes the hull at more than this, cameras are a little off. It is −0.4 on the trial shapes
    brick and ellipsoid, and 4.6 and 5.0 with cameras turned by 2°. Not tuned."""
    least_votes: float = 0.6
    """The share of the views that has to agree at least where they are. On these two 0.78 did. Not tuned."""
    contact_px: float = 3.9
    """Standard deviation of a hull vertex from a silhouette's cone, and of its contact from the contour generator along
    the ray."""
    least_trust: float = 0.01
    """Trust in a hull vertex below this is none."""
    trust_floor: float = 1e-7
    """Trust added to every vertex, so that the plate is determined where nothing is trusted. Not tuned."""
    neighbor_view_deg: float = 12.0
    """Views are compared for a contact over about this angle between their directions."""
    neighbor_height_deg: float = 8.0
    """…and over about this difference of their heights above the tangent plane."""
    contact_views: int = 150
    """Views that tell contacts, at most: as well as all of a long video."""
    plate_length_px: float = 5.0
    """Details of the trusted hull shorter than this are smoothed."""
    pixels_a_voxel: float = 4.5
    """The two lengths above are in pixels, or in voxels divided by this where the grid is coarser than the images."""
    obstacle_px: float = 0.25
    """A plate that leaves the hull by more than this is held on it, as if a silhouette touched it there."""
    obstacle_trust: float = 0.5
    """Trust in such a point."""
    obstacle_rounds: int = 3
    """Solutions of the plate with ever more such points."""
    projection_steps: int = 3
    """Newton steps by which points outside the hull are moved onto it."""
    least_slope: float = 0.5
    """Lower bound of |∇h| in such a step, dimensionless: 1 for a distance. Not tuned."""


DEFAULTS = FirstSurfaceOptions()
