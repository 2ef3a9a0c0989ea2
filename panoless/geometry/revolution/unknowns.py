"""A surface of revolution as a surface of few numbers: its axis, and splines of the shift of its profile."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from panoless.geometry.revolution.lip import SPOILED_PX
from panoless.geometry.revolution.model import Hits, SurfaceOfRevolution, trace_reflections
from panoless.geometry.revolution.photometric import normal_motion
from panoless.geometry.revolution.profile import (
    ProfileSplines,
    apply_step,
    resample_profile,
    side_normals,
    vertex_motions,
)
from panoless.geometry.revolution.silhouette import (
    LARGEST_TURN_RAD,
    ContourRays,
    SilhouetteResiduals,
    axis_motion,
    parameter_columns,
    silhouette_residuals,
)
from panoless.numeric.gauss_newton import jacobian_of_rows
from panoless.problem.parametric import (
    LEAST_COSINE,
    MirrorHits,
    ParametricSurface,
    Regularization,
    Silhouette,
    StepLimit,
    motion_rows,
)
from panoless.problem.rays import PixelRays
from panoless.problem.rows import CONTOUR_SIGMA_PX
from shinypartial.core.camera import Similarity

AXIS_NUMBERS = 4
KNOT_PX, STIFF_PX = 3.0, 8.0
"""Spacing of the splines (px): for silhouettes and the last rounds, and for photographs under coarse maps, under which
a proposal changes smoothly."""
END_PX, END_SIGMA_PX = 4.0, 0.3
"""Silhouettes so near to an end (px) have this standard deviation (px): edges are round, corners are not."""
BENDING = 1e-3
"""Penalty on second differences of a step, in mean diagonals of the normal matrix."""


@dataclass(frozen=True)
class RevolutionUnknowns(ParametricSurface):
    """Turns and shifts of the axis, and the coefficients of the splines."""

    surface: SurfaceOfRevolution
    pixel: float
    """Length of a pixel at the object."""
    knot_px: float = KNOT_PX

    @property
    def shape(self) -> SurfaceOfRevolution:
        """The surface."""
        return self.surface

    @cached_property
    def splines(self) -> ProfileSplines:
        """Along the profile."""
        return ProfileSplines.of(self.surface, self.knot_px * self.pixel)

    @property
    def count(self) -> int:
        """Four, and the coefficients."""
        return AXIS_NUMBERS + self.splines.count

    @property
    def limit(self) -> StepLimit:
        """Of the axis."""
        return StepLimit(LARGEST_TURN_RAD, slice(AXIS_NUMBERS))

    def hits(self, rays: PixelRays) -> MirrorHits:
        """Where rays meet the outside and are mirrored once.

        Its ends are left out: their corners bend what silhouettes show, and cameras would turn to make up for that.
        """
        paths = trace_reflections(self.surface, rays.origins, rays.directions)
        first, count = paths.first, len(rays.size)
        once = np.flatnonzero((paths.bounces == 1) & ~self._is_end(first, SPOILED_PX))
        motion = normal_motion(rays.directions[once], first.of(once), self.surface, self.splines, self.pixel)
        kept = once[motion.kept]
        clear, distance = np.zeros(count, dtype=bool), np.where(first.met, first.distance, 0.0)
        clear[kept] = -(first.normals[kept] * rays.directions[kept]).sum(1) > LEAST_COSINE
        shape, rows = np.zeros((count, 3, 3)), np.zeros((count, 3, 8))
        columns = np.zeros((count, 8), dtype=np.int64)
        shape[kept] = np.matmul(motion.along * motion.bends[:, None], motion.along.transpose(0, 2, 1))
        rows[kept] = np.matmul(motion.along, motion.turns)
        columns[kept] = parameter_columns(motion.index)
        return MirrorHits(clear, distance, first.points, first.normals, shape, rows, columns)

    def silhouette(self, rays: PixelRays) -> Silhouette:
        """How far rays pass outside of the profile."""
        surface, count = self.surface, len(rays.size)
        lengths = np.linalg.norm(rays.origins, axis=1) * rays.size
        found = silhouette_residuals(
            ContourRays(rays.view, rays.origins, rays.directions, lengths), surface, self.pixel
        )
        # At a corner, that of the base or of the lid, sides have other normals than what the ray touches.
        last = max(surface.lip - 1, 1)
        base = (found.side <= 0) | ((found.side == 1) & (found.along <= 0))
        lid = (found.side > last) | ((found.side == last) & (found.along >= 1))
        side, along = np.clip(found.side, 1, last), np.where(base, 0.0, np.where(lid, 1.0, found.along))
        directions = rays.directions @ surface.frame.T
        azimuth = np.stack([-found.points[:, 1], found.points[:, 0], np.zeros(count)], 1)
        touched = np.cross(directions, azimuth)
        touched /= np.maximum(np.linalg.norm(touched, axis=1, keepdims=True), 1e-12)
        radial = self._radial(found.points)
        outward = np.where((base | lid)[:, None], radial, found.normals)
        touched *= np.sign((touched * outward).sum(1, keepdims=True))
        in_half_plane = np.stack([(touched * radial).sum(1), touched[:, 2]], 1)
        by_wall, by_lid = (each[last] for each in vertex_motions(surface))
        share = np.where(base, in_half_plane @ side_normals(surface)[1, 0], 1.0)
        share = np.where(lid, in_half_plane @ by_wall, share)
        values, index = self.splines.values(side, along)
        more, beyond = self.splines.values(np.full(count, last + 1), np.zeros(count))
        splines = np.concatenate([values * share[:, None], more * (lid * (in_half_plane @ by_lid))[:, None]], 1)
        met = found.side >= 0
        inverse = met[:, None] / lengths[:, None]
        rows = np.concatenate([-axis_motion(found.points, touched), -splines], 1) * inverse
        columns = np.concatenate([parameter_columns(index), AXIS_NUMBERS + beyond], 1)
        normals = touched @ surface.frame
        points = found.points @ surface.frame + surface.origin
        distance = ((points - rays.origins) * rays.directions).sum(1)
        by_shift = normals * inverse
        return Silhouette(
            np.where(met, found.pixels, 0.0),
            met * np.where(self._is_end(found, END_PX), (CONTOUR_SIGMA_PX / END_SIGMA_PX) ** 2, 1.0),
            met,
            jacobian_of_rows(rows, columns, self.count),
            np.nan_to_num(motion_rows(by_shift, rays.directions, distance)),
        )

    def _is_end(self, met: Hits | SilhouetteResiduals, reach_px: float) -> Bool[np.ndarray, "P"]:
        """Whether that is the base, the lid, or so near to one."""
        length, place = self.surface.arc_lengths, self.surface.arc_length_at(np.maximum(met.side, 0), met.along)
        reach: float = reach_px * self.pixel
        return (place < length[1] + reach) | (place > length[self.surface.lip] - reach)

    def _radial(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Unit directions from the axis, in its frame."""
        across = points * [1, 1, 0]
        return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)

    def regularization(self, matrix: Float[np.ndarray, "D D"]) -> Regularization:
        """Second differences of a step."""
        found = np.zeros_like(matrix)
        weight = BENDING * np.trace(matrix[AXIS_NUMBERS:, AXIS_NUMBERS:]) / max(self.splines.count, 1)
        found[AXIS_NUMBERS:, AXIS_NUMBERS:] = self.splines.bending(weight)
        return Regularization(found)

    def stepped(self, step: Float[np.ndarray, "D"]) -> "RevolutionUnknowns":
        """Moved."""
        return replace(self, surface=apply_step(self.surface, self.splines, step))

    def taken_back(self, common: Similarity) -> "RevolutionUnknowns":
        """Moved and scaled."""
        origin, axis = common.undone(self.surface.origin[None])[0], self.surface.axis @ common.rotation
        profile = self.surface.profile / common.scale
        return replace(self, surface=replace(self.surface, origin=origin, axis=axis, profile=profile))

    def refined(self) -> "RevolutionUnknowns":
        """With a finer profile."""
        return replace(self, knot_px=KNOT_PX)

    def settled(self) -> "RevolutionUnknowns":
        """With vertices about a pixel apart."""
        return replace(self, surface=resample_profile(self.surface, self.pixel))
