"""The tuned numbers of poses as unknowns beside a geometry of few numbers."""

from dataclasses import dataclass
from typing import Literal

from shinypartial.io.records import Count, Positive, Share


@dataclass(frozen=True)
class PoseOptions:
    """When cameras are found beside a plane, a height field or a surface of revolution, and how.

    Free-form surfaces find theirs within their own fit. "Development scenes" are vase, mirror and deformed-mirror at
    160 px; "not tuned" is what only has to be large or small enough.
    """

    mode: Literal["auto", "off", "on"] = "auto"
    """Whether poses are unknowns: where silhouettes and held-out views gain by it, never, or always."""
    turn_deg: Positive = 1.0
    """Expected error of a camera's rotation."""
    shift: Positive = 0.02
    """Expected error of its position, in radii of the object."""
    stated_floor: Share = 0.1
    """This share of both is added, in squares, to a stated covariance of a pose: an adjustment knows of noise alone.
    By structure from motion in a corner of a room cameras are off by 0.13° where 0.008° is stated, by a board by 0.002°
    as stated."""
    checked_views: Count = 10
    """Views whose outlines tell whether poses are worth finding. Not tuned."""
    largest_share_left: Share = 0.8
    """They are if turns of the cameras leave less than this share of the outlines' distance from the masks. From true
    cameras it is 0.98 and 1.01 on vase and mirror, with turns of 0.1° 0.44 and 0.34, with turns of 1° 0.76 and 0.34. Of
    a wrong kind, true cameras leave 0.82 to 0.95.
    """
    least_overlap: Share = 0.75
    """No turns are looked for where a shape overlaps less with the masks: mirror and vase do by 0.86 and 0.83 with
    turns of 2°, and a plane by 0.70 with sculpture.
    """
    trial_views: Count = 16
    """So many views tell first, where there are at least twice as many, whether turns bring a shape near to the masks.
    Not tuned."""
    silhouette_rounds: Count = 5
    """Most rounds of turns and shape by silhouettes alone. Not tuned."""
    least_fall: Share = 0.2
    """They end when the distance does not fall by this share: then shape and turns only drift along with each other."""
    rounds: Count = 7
    """Most rounds of poses and shape by what is mirrored. On mirror with turns of 1° errors of 0.095° become 0.068°,
    0.049°, 0.040° and 0.035°. On vase with turns of 0.5° normals are wrong by 0.13° in the median after three, and by
    0.07° after seven.
    """
    settled_deg: Positive = 0.01
    """They end when the median camera turns by less than this. Not tuned."""
    maps: Count = 4
    """Steps of the poses, each with its own map, before the shape follows."""
    uncertainty_factor: Positive = 6.0
    """By how much standard deviations are larger than those of independent pixels under a right surface. With cameras
    turned by 0.5° turns are wrong by 8 such on the trial shape brick, by 7 on the trial shape torus and by 3.5 on vase.
    """
    least_pose_gain: Share = 0.002
    """Share of the held-out error by which turns that outlines ask for have to lower it. Little, because under a smooth
    environment poses matter little.
    """
    largest_rise: Share = 0.02
    """Rounds whose held-out error is higher than that before them by more than this share are taken back. Between good
    rounds it changes by 1 % on mirror.
    """
    steps: Count = 4
    """Poses of a view by itself that are compared, each a Gauss–Newton step after the best, under a geometry and a map
    that stay. Not tuned."""
    shortening: Share = 0.3
    """Factor of a step that raises the cost. Not tuned."""
    noise_multiple: Positive = 3.0
    """Robust scales are so many medians of the residuals. Not tuned."""
    least_outline_px: Positive = 0.02
    """Standard deviation of outlines, in pixels, below which none is believed. Not tuned."""
    least_radiance: Positive = 0.01
    """The same of a pixel's color (linear radiance). Not tuned."""
    largest_bend_rad: Positive = 0.1
    """Pixels over which the normal turns by more tell poses by silhouettes only. Not tuned."""
    pixels: Count = 2_500
    """About so many pixels of each view tell its pose."""
    map_rays: Count = 400_000
    """Rays from which the map is solved that they are compared with."""
    map_resolution: Count = 128
    """Texels along a face side of that map."""
