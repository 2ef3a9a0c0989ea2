"""A sphere by silhouettes: a cone for each view, all cones in one linear system, then all contour points together.

The rays that touch a sphere form a circular cone about the camera. Its axis a and half angle α put the center at
c = o + ρ a/sin α from the camera at o, which is linear in c and ρ: two views determine both, one leaves open how far
away the ball is.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from panoless.capture.views import Views
from panoless.geometry.base import Proposal
from panoless.geometry.sphere.model import Sphere
from panoless.geometry.sphere.unknowns import SphereUnknowns
from panoless.numeric.cones import nearest_cone
from panoless.numeric.factorize import regularize
from panoless.numeric.robust import robust_weight
from panoless.problem.observations import silhouette_rays
from panoless.problem.rays import PixelRays
from panoless.problem.solve import by_silhouettes_alone

LARGEST_CONE_PX = 0.5
"""Where the median contour point of the median view is farther from the best cone (px), the object is no sphere."""
LARGEST_ELLIPTICITY = 0.005
"""Nor where the contour is an oval about its cone by this share of its radius: an ellipsoid of the axes 1, 1 and 0.98
is by 0.005."""
CONE_ROUNDS = 6
"""Rounds of robust weights that a cone is found in."""
CONE_SCALE_PX = 0.5
"""Robust scale of a cone (px)."""
NOISE_SCALE = 3.0
"""A robust scale is no less than so many medians of the distances."""

ORIGIN_PULL = 1e-6
"""Weight of a center at the origin of the normalized frame, for views that leave its distance open; not tuned."""
WIDEST_COSINE = 0.9999
"""A cone of a smaller half angle (0.8°) is no cone; not tuned."""


@dataclass(frozen=True)
class Cones:
    """A circular cone for each view that has one, and how far its contour points are from it."""

    origins: Float[np.ndarray, "V 3"]
    axes: Float[np.ndarray, "V 3"]
    sines: Float[np.ndarray, "V"]
    """Of half the opening angle."""
    median_px: Float[np.ndarray, "V"]
    ellipticity: Float[np.ndarray, "V"]
    """Amplitude of cos 2φ, φ around the axis, in the contour's distance from the cone, as a share of its radius. Noise
    of masks hardly shows in it, and another shape does.
    """

    @classmethod
    def of(cls, rays: PixelRays) -> "Cones":
        """Those nearest to the contour rays of each view."""
        found = []
        for view in np.unique(rays.view):
            own = rays.view == view
            directions, scale = rays.directions[own], 1 / rays.size[own]
            cone = nearest_cone(
                directions,
                scale,
                rounds=CONE_ROUNDS,
                scale_px=CONE_SCALE_PX,
                medians=NOISE_SCALE,
                widest_cosine=WIDEST_COSINE,
            )
            median_px = float(np.median(np.abs(cone.off_px)))
            oval = _second_harmonic(directions, cone.axis, cone.off_px / scale, cone.weights) / np.arccos(cone.cosine)
            found.append((rays.origins[own][0], cone.axis, cone.sine, median_px, oval))
        origins, axes, *figures = zip(*found, strict=True) if found else [()] * 5
        return cls(np.array(origins).reshape(-1, 3), np.array(axes).reshape(-1, 3), *map(np.array, figures))

    def are_of_a_sphere(self) -> bool:
        """Whether the median view has a contour near its cone, and not an oval one."""
        return bool(
            len(self.sines)
            and np.median(self.median_px) <= LARGEST_CONE_PX
            and np.median(self.ellipticity) <= LARGEST_ELLIPTICITY
        )

    def sphere(self, radius: float) -> Sphere:
        """The sphere whose cones are nearest to these, by linear least squares; of a `radius` that is known, unless 0.

        Solves c − ρ a/sin α = o for all views. What they leave open is settled by a center near the origin.
        """
        toward = self.axes / self.sines[:, None]
        weights = np.repeat(robust_weight(self.median_px, 1.0), 3) ** 0.5
        rows = np.concatenate([np.tile(np.eye(3), (len(toward), 1)), -toward.reshape(-1, 1)], 1) * weights[:, None]
        right = self.origins.ravel() * weights
        pull = ORIGIN_PULL * np.eye(4)[:3]
        if radius:
            right, rows = right - radius * rows[:, 3], np.concatenate([rows[:, :3], 0 * rows[:, 3:]], 1)
        solved = np.linalg.lstsq(np.concatenate([rows, pull]), np.append(right, np.zeros(3)), rcond=None)[0]
        return Sphere(solved[:3], radius or float(solved[3]))


def _second_harmonic(
    directions: Float[np.ndarray, "P 3"],
    axis: Float[np.ndarray, "3"],
    values: Float[np.ndarray, "P"],
    weights: Float[np.ndarray, "P"],
) -> float:
    """√(a² + b²) of the a cos 2φ + b sin 2φ nearest to values with weights, φ being the azimuth about an axis."""
    across = np.linalg.svd(axis[None])[2][1:]
    azimuth = np.arctan2(directions @ across[1], directions @ across[0])
    basis = np.stack([np.cos(2 * azimuth), np.sin(2 * azimuth)], 1)
    weighted = basis * weights[:, None]
    moment = regularize(weighted.T @ basis + 1e-12 * np.eye(2), "an oval")
    return float(np.linalg.norm(np.linalg.solve(moment, weighted.T @ values)))


def fit_sphere(views: Views, radius: float = 0.0, *, requested: bool) -> Proposal | None:
    """The sphere that explains the masks best; None where their silhouettes are no cones, unless it was `requested`.

    A `radius` that is known, in units of the world, stays as it is; 0: unknown.
    """
    rays = silhouette_rays(views, longest_only=True)
    cones = Cones.of(rays)
    if not len(cones.sines) or not (requested or cones.are_of_a_sphere()):
        return None
    known = radius / views.object_frame.radius
    surface = by_silhouettes_alone(views, SphereUnknowns(cones.sphere(known), known > 0))
    return Proposal.of(views, surface.sphere, surface)
