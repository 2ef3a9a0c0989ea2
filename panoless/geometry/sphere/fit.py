"""A sphere by outlines: a cone for each view, all cones in one linear system, then all contour points together.

The rays that touch a sphere form a circular cone about the camera. Its axis a and half angle α put the center at
c = o + ρ a/sin α from the camera at o, which is linear in c and ρ: two views determine both, one leaves open how far
away the ball is.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from panoless.capture.silhouettes import mask_contours
from panoless.capture.views import Views
from panoless.geometry.base import overlap
from panoless.geometry.sphere.model import Sphere, sphere_buffers
from panoless.numeric.cones import nearest_cone
from panoless.numeric.factorize import regularize
from panoless.numeric.gauss_newton import accept_step, damped_step
from panoless.numeric.robust import bounded_error, robust_scale, robust_weight

LARGEST_CONE_PX = 0.5
"""Where the median contour point of the median view is farther from the best cone (px), the object is no sphere."""
LARGEST_ELLIPTICITY = 0.005
"""Nor where the contour is an oval about its cone by this share of its radius: an ellipsoid of the axes 1, 1 and 0.98
is by 0.005."""
CONE_ROUNDS = 6
"""Rounds of robust weights that a cone is found in."""
SCALES_PX = (4.0, 2.0, 1.0, 0.5, 0.5)
"""Robust scales of the steps by all outlines (px)."""
NOISE_SCALE = 3.0
"""A robust scale is no less than so many medians of the distances."""
SAMPLES = 4
"""Rays along each side of a pixel at the outline that tell how far it is covered, and of every pixel what it shows."""

ORIGIN_PULL = 1e-6
"""Weight of a center at the origin of the normalized frame, for views that leave its distance open; not tuned."""
WIDEST_COSINE = 0.9999
"""A cone of a smaller half angle (0.8°) is no cone; not tuned."""


@dataclass(frozen=True)
class OutlineRays:
    """Unit rays of the contour points of all views, and how many pixels an angle of one is there."""

    view: Int[np.ndarray, "P"]
    origins: Float[np.ndarray, "P 3"]
    directions: Float[np.ndarray, "P 3"]
    pixels_per_rad: Float[np.ndarray, "P"]

    @classmethod
    def of(cls, views: Views) -> "OutlineRays":
        """Those of the longest contour of each mask."""
        contours = mask_contours(views)
        length = np.linalg.norm(contours.rays, axis=1)
        focal = np.array([view.camera.fx for view in views.train])[contours.view]
        return cls(contours.view, contours.centers, contours.rays / length[:, None], focal * length)


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
    def of(cls, rays: OutlineRays) -> "Cones":
        """Those nearest to the contour rays of each view."""
        found = []
        for view in np.unique(rays.view):
            own = rays.view == view
            directions, scale = rays.directions[own], rays.pixels_per_rad[own]
            cone = nearest_cone(
                directions,
                scale,
                rounds=CONE_ROUNDS,
                scale_px=SCALES_PX[-1],
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


@dataclass(frozen=True)
class OutlineResiduals:
    """How far contour rays are from touching a sphere, in pixels, positive outside, and their derivatives by (c, ρ).

    With p = c − o the angle between a ray r and p is β, and that of a ray that touches is α = arcsin(ρ/‖p‖). The angle
    β − α stays where all is scaled about a camera, so that one view moves nothing along what it leaves open.
    """

    sphere: Sphere
    rays: OutlineRays

    @cached_property
    def pixels(self) -> Float[np.ndarray, "P"]:
        """β − α, in pixels."""
        toward = self.sphere.center - self.rays.origins
        along = (toward * self.rays.directions).sum(1)
        across = np.linalg.norm(toward - along[:, None] * self.rays.directions, axis=1)
        sine = self.sphere.radius / np.linalg.norm(toward, axis=1)
        return (np.arctan2(across, along) - np.arcsin(np.clip(sine, -1, 1))) * self.rays.pixels_per_rad

    @cached_property
    def rows(self) -> Float[np.ndarray, "P 4"]:
        """∂β/∂c = ((p·r) p⊥/‖p⊥‖ − ‖p⊥‖ r)/‖p‖² and ∂α/∂(c, ρ) = (−ρ p/‖p‖², 1)/√(‖p‖² − ρ²), in pixels."""
        directions = self.rays.directions
        toward = self.sphere.center - self.rays.origins
        square = (toward**2).sum(1)[:, None]
        along = (toward * directions).sum(1)[:, None]
        passing = toward - along * directions
        across = np.maximum(np.linalg.norm(passing, axis=1, keepdims=True), 1e-12)
        room = np.sqrt(np.maximum(square - self.sphere.radius**2, 1e-12))
        by_center = (along * passing / across - across * directions) / square
        by_center += self.sphere.radius * toward / square / room
        return np.concatenate([by_center, -1 / room], 1) * self.rays.pixels_per_rad[:, None]

    def equations(self, scale: float) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "4 4"]]:
        """Gradient Jᵀ W e and matrix Jᵀ W J with Geman–McClure weights of that scale."""
        weighted = self.rows * robust_weight(self.pixels, scale)[:, None]
        return weighted.T @ self.pixels, weighted.T @ self.rows

    def cost(self, scale: float) -> float:
        """Sum of e²/(e² + s²)."""
        return float(bounded_error(self.pixels, scale).sum())


@dataclass(frozen=True)
class SphereFit:
    """A sphere and how well it explains the masks, view by view."""

    sphere: Sphere
    median_px: Float[np.ndarray, "V"]
    """Median distance of the mask's contour from the outline."""
    overlap: Float[np.ndarray, "V"]
    """Σ min(alpha, mask) / Σ max(alpha, mask)."""


def fit_sphere(views: Views, radius: float = 0.0, *, asked: bool) -> SphereFit | None:
    """The sphere that explains the masks best; None where their outlines are no cones, unless it was `asked` for.

    A `radius` that is known, in units of the world, stays as it is; 0: unknown.
    """
    rays = OutlineRays.of(views)
    cones = Cones.of(rays)
    if not len(cones.sines) or not (asked or cones.are_of_a_sphere()):
        return None
    known = radius / views.object_frame.radius
    sphere = _refined(cones.sphere(known), rays, known > 0)
    size = np.abs(OutlineResiduals(sphere, rays).pixels)
    medians = [np.median(size[rays.view == view]) for view in np.unique(rays.view)]
    overlaps = []
    for view in views.train:
        alpha = sphere_buffers(sphere, view.camera, SAMPLES).alpha.to(view.mask)
        overlaps.append(overlap(alpha, view.mask))
    return SphereFit(sphere, np.array(medians), np.array(overlaps))


def _refined(sphere: Sphere, rays: OutlineRays, radius_known: bool) -> Sphere:
    """After a robust Gauss–Newton step of all contour points for each scale."""
    state = OutlineResiduals(sphere, rays)
    for least_px in SCALES_PX:
        scale = robust_scale(state.pixels, least_px, NOISE_SCALE)
        gradient, matrix = state.equations(scale)
        if radius_known:
            gradient[3], matrix[3], matrix[:, 3] = 0, 0, 0
        state = accept_step(
            state,
            damped_step(gradient, matrix),
            lambda state, step: replace(state, sphere=state.sphere.moved(step)),
            lambda state, scale=scale: state.cost(scale),  # type: ignore[misc]
        )
    return state.sphere
