"""Poses of all views under one geometry: six unknowns a view, robust Gauss–Newton steps with a prior."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from panoless.alignment.adjustment import adjusting_step
from panoless.alignment.equations import PoseRows, light_rows, outline_rows
from panoless.alignment.options import PoseOptions
from panoless.capture.poses import Poses, StatedCameras, common_and_lens, moved_view
from panoless.capture.silhouettes import silhouette_distance_px
from panoless.capture.views import TrainView, Views
from panoless.environment.solve import solve_environment
from panoless.geometry.base import Geometry, observe_views, usable_views
from panoless.numeric.factorize import regularize
from panoless.numeric.gauss_newton import damped_step
from panoless.numeric.robust import NORMAL_MEDIAN, robust_scale


@dataclass(frozen=True)
class Scene:
    """What a view is compared with: a geometry and, if colors have a say, its map."""

    geometry: Geometry
    environment: Float[Tensor, "6 3 L L"] | None = None

    @property
    def unknowns(self) -> int:
        """Outlines alone turn a camera; colors shift it as well."""
        return 3 if self.environment is None else 6


def pose_prior(views: Views, options: PoseOptions) -> Float[np.ndarray, "V 6 6"]:
    """Inverse covariances of turns (rad) and shifts."""
    return StatedCameras.of(views).prior(math.radians(options.turn_deg), options.shift, options.stated_floor)


@dataclass(frozen=True)
class Alignment:
    """The views as they are said to be, and what finds their poses."""

    views: Views
    options: PoseOptions

    @cached_property
    def prior(self) -> Float[np.ndarray, "V 6 6"]:
        """Weights of squared turns and shifts."""
        return pose_prior(self.views, self.options)

    @cached_property
    def _seen(self) -> "list[_SeenView]":
        return [_SeenView(view, self.options) for view in self.views.train]

    def left_by_turns(self, geometry: Geometry) -> float:
        """The share of the outlines' distance from the masks' contours that turns of the cameras leave, to first order:
        after over before, each the median over some of the views of the median distance.
        """
        scene, distances = Scene(geometry), []
        for view in self._seen[:: -(-len(self._seen) // self.options.checked_views)]:
            rows = view.rows(scene, np.zeros(6))[0]
            if len(rows.residual):
                scale = robust_scale(rows.residual, self.options.least_outline_px, self.options.noise_multiple)
                gradient, matrix, _ = rows.equations(scale, 1.0)
                turn = damped_step(gradient[:3], matrix[:3, :3])
                distances.append((rows.typical, PoseRows(rows.residual + rows.rows[..., :3] @ turn, rows.rows).typical))
        before, left = np.median(np.array(distances).reshape(-1, 2), axis=0) if distances else (0.0, 0.0)
        return float(left / before) if before > 0 else 1.0

    def aligned(self, scene: Scene, start: Poses, chosen: Sequence[int] | None = None) -> Poses:
        """The poses that explain outlines and colors best, from a start on; of the views `chosen`, where not of all.

        Noise is not known beforehand: outlines and colors are weighed by the medians of their residuals at the start.
        """
        indices = list(range(len(self._seen)) if chosen is None else chosen)
        found = start.stacked
        noise = self._noise([self._seen[index].rows(scene, found[index]) for index in indices])
        for index in indices:
            found[index] = self._seen[index].solved(scene, found[index], noise, self.prior[index])
        return Poses(found[:, :3], found[:, 3:])

    def adjusted(self, geometry: Geometry, poses: Poses, environment: Float[Tensor, "6 3 L L"]) -> Poses:
        """The poses after one Gauss–Newton step of all views together, in which the map follows them."""
        start, scene = poses.stacked, Scene(geometry, environment)
        found = [view.rows(scene, pose) for view, pose in zip(self._seen, start, strict=True)]
        step = adjusting_step(found, self._noise(found), start, self.prior, environment.shape[-1], self.options)
        return poses.after(step)

    def _noise(self, residuals: Sequence[Sequence[PoseRows]]) -> list[float]:
        """Standard deviations of outlines (px) and colors."""
        least = self.options.least_outline_px, self.options.least_radiance
        medians = [np.median([rows.typical for rows in each]) for each in zip(*residuals, strict=True)]
        return [max(float(each) / NORMAL_MEDIAN, floor) for each, floor in zip(medians, least, strict=False)]

    def uncertainty(self, geometry: Geometry) -> Float[np.ndarray, "V 6"]:
        """Standard deviations of the turns (rad) and shifts (normalized frame) that a finished geometry has, with its
        surface and map as they are: k √diag (Σ JᵀWJ/σ² + P)⁻¹ over outlines and colors of each view.

        The factor k stands for pixels that err alike, and for a surface and a map that are wrong themselves.
        """
        assert geometry.poses is not None, "poses were found"
        scene = Scene(geometry, known_map(self.views, geometry, self.options))
        rows = [view.rows(scene, pose) for view, pose in zip(self._seen, geometry.poses.stacked, strict=True)]
        noise, found = self._noise(rows), []
        for each, prior in zip(rows, self.prior, strict=True):
            parts = zip(each, noise, strict=True)
            known = sum((part.equations(self.options.noise_multiple * sigma, sigma)[1] for part, sigma in parts), prior)
            found.append(np.sqrt(np.diag(np.linalg.inv(regularize(known, "the poses")))))
        return self.options.uncertainty_factor * np.array(found)

    def without_motion_of_object(self, turns: Poses) -> Poses:
        """Turns less what looks like a motion of the object, which outlines don't tell from one: by least squares.

        With v the line of sight, a shift t of the object across it looks like the turn v × t, and a turn θ of the
        object about it like the turn (v·θ) v. What a wrong principal point turns looks much like these: where it is
        most of what they leave, it stays as a whole.
        """
        cameras = StatedCameras.of(self.views)
        sights = cameras.centers / np.linalg.norm(cameras.centers, axis=1, keepdims=True)
        shifted, rolled = np.cross(sights[:, None], np.eye(3)), sights[:, :, None] * sights[:, None]
        motions, lens = (
            each.transpose(0, 2, 1).reshape(-1, each.shape[1])
            for each in (np.concatenate([shifted, rolled], 1), cameras.rotations[:, :2])
        )
        alike = motions @ common_and_lens(motions, lens, turns.turns.ravel())[0]
        return Poses(turns.turns - alike.reshape(-1, 3), turns.shifts)

    def without_common(self, poses: Poses) -> Poses:
        """The poses less what turns, shifts and scales all cameras alike."""
        return poses.without_common(StatedCameras.of(self.views), self.prior)[1]


@dataclass(frozen=True)
class _SeenView:
    """One view as it is said to be."""

    view: TrainView
    options: PoseOptions

    @cached_property
    def distance_px(self) -> Float[np.ndarray, "H W"]:
        """How far each pixel lies outside of the mask's contour."""
        return silhouette_distance_px(self.view.mask).cpu().numpy().astype(np.float64)

    @cached_property
    def pixels(self) -> Int[np.ndarray, "P"]:
        """Those whose colors have a say."""
        solid: np.ndarray = self.view.solid.cpu().numpy()
        return solid[:: max(1, len(solid) // self.options.pixels)]

    def rows(self, scene: Scene, pose: Float[np.ndarray, "6"]) -> list[PoseRows]:
        """Of the outline, and of colors where there is a map."""
        view = moved_view(self.view, Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:])
        surface = scene.geometry.buffers(view.camera)
        rows = [outline_rows(view, self.distance_px, surface)]
        if scene.environment is not None:
            around = scene.geometry.surroundings
            rows.append(light_rows(view, self.pixels, surface, scene.environment, self.options, around))
        return rows

    def solved(
        self, scene: Scene, start: Float[np.ndarray, "6"], noise: Sequence[float], prior: Float[np.ndarray, "6 6"]
    ) -> Float[np.ndarray, "6"]:
        """The pose of least cost that was met on Gauss–Newton steps, shortened where the cost rises."""
        rows, free = self.rows(scene, start), slice(scene.unknowns)
        scales = [
            max(each.typical, sigma) * self.options.noise_multiple for each, sigma in zip(rows, noise, strict=True)
        ]
        best, least, step = Poses(start[None, :3], start[None, 3:]), np.inf, np.zeros((1, 6))
        pose = best
        for index in range(self.options.steps):
            if index:
                pose = best.after(step)
                rows = self.rows(scene, pose.stacked[0])
            parts = [each.equations(*numbers) for each, *numbers in zip(rows, scales, noise, strict=True)]
            cost = sum(part[2] for part in parts) + float(pose.stacked[0] @ prior @ pose.stacked[0]) / 2
            if cost < least:
                gradient = sum((part[0] for part in parts), prior @ pose.stacked[0])
                matrix = sum((part[1] for part in parts), prior)
                best, least = pose, cost
                step[0, free] = -np.linalg.solve(regularize(matrix[free, free], "a pose"), gradient[free])
            else:
                step *= self.options.shortening
        return best.stacked[0]


def known_map(views: Views, geometry: Geometry, options: PoseOptions) -> Float[Tensor, "6 3 L L"]:
    """The map of the usable pixels of views under a geometry."""
    with torch.no_grad():
        rays = list(observe_views(usable_views(views, geometry), geometry, options.map_rays))
        return solve_environment(rays, options.map_resolution)
