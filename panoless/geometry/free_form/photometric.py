"""What pixels see by way of a level set under a map that follows it, and what it costs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.lens import LensChange
from panoless.capture.poses import Poses, StatedCameras
from panoless.capture.views import concatenated
from panoless.environment.cubemap import resample
from panoless.environment.footprints import PixelFootprints
from panoless.geometry.free_form.beside import Beside, BlockRows, pixel_pose_rows
from panoless.geometry.free_form.equations import Rows, gauge_rows, joined_rows, silhouette_rows
from panoless.geometry.free_form.map import smoothed_map, splatted_map
from panoless.geometry.free_form.observations import PixelRays, Pixels
from panoless.geometry.free_form.options import FreeFormOptions, FreeFormRound
from panoless.geometry.free_form.surface import Hits, LevelSet
from panoless.geometry.free_form.trust import Trust
from panoless.kernels.level_set import (
    mirror_rows,
    mirrored,
    seen_with_slopes,
    third_differences,
    whole_differences,
    without_means,
)
from panoless.kernels.reference.cubemap import padded_texels
from panoless.numeric.factorize import regularize
from panoless.numeric.robust import bounded_error, robust_weight


@dataclass(frozen=True)
class Sights:
    """Where rays of pixels meet a surface and what they mirror: the mean mirrored direction, not of unit length, K
    directions over each pixel in which they look into the map, how far they turn over it (rad), and whether it sees the
    surroundings at a useful angle.
    """

    hits: Hits
    mirrored: Float[np.ndarray, "P 3"]
    outgoing: Float[np.ndarray, "P K 3"]
    turn: Float[np.ndarray, "P"]
    clear: Bool[np.ndarray, "P"]

    @classmethod
    def of(
        cls, surface: LevelSet, rays: PixelRays, samples: int, least_cosine: float, *, occlusion_test: bool = True
    ) -> "Sights":
        """By tracing the rays, and, but without an occlusion test, their mirrored rays against the surface itself."""
        hits = surface.hits(rays.origins, rays.directions)
        normals = hits.normals
        facing = -(normals * rays.directions).sum(1)
        clear = hits.met & (facing > least_cosine)
        chosen = np.flatnonzero(clear & occlusion_test)
        middle = rays.directions[chosen] + 2 * facing[chosen, None] * normals[chosen]
        clear[chosen[surface.meets_again(hits.places[chosen], middle)]] = False
        return cls.along(surface, rays, samples, hits, clear)

    @classmethod
    def along(
        cls, surface: LevelSet, rays: PixelRays, samples: int, hits: Hits, clear: Bool[np.ndarray, "P"]
    ) -> "Sights":
        """Of rays that were traced already."""
        distance = np.where(hits.met, hits.distance, 0.0) / surface.spacing
        _, outgoing, turn = mirrored(hits.derivatives, rays.directions, distance, rays.steps, samples)
        points = np.broadcast_to(surface.points(hits.places)[:, None], outgoing.shape)
        looked_up = surface.surroundings.looked_up(points, outgoing)
        return cls(hits, outgoing.mean(1), looked_up, turn, clear)


@dataclass(frozen=True)
class Task:
    """What one round of steps is solved for."""

    pixels: Pixels
    outlines: PixelRays
    photograph_weight: float
    """Of a pixel, in units of 1/σ²."""
    outline_weight: float
    """Of an outline's point."""
    settings: FreeFormRound
    options: FreeFormOptions
    cameras: StatedCameras
    """Of all views."""
    brightness: float
    """Mean over all pixels and channels (linear radiance)."""
    anchor: Float[np.ndarray, "A B C"] | None = None
    """Coefficients the change from which is to be smooth; None: the surface is."""

    @cached_property
    def pose_prior(self) -> Float[np.ndarray, "V 6 6"]:
        """Weights of squared turns and shifts: the inverse of what the views state."""
        return np.linalg.inv(regularize(np.array(self.cameras.covariances), "the poses"))

    def outlined(self, gain: float) -> "Task":
        """The same with another factor of the outlines' weight."""
        settings = replace(self.settings, outline_gain=gain)
        return replace(self, settings=settings, outline_weight=self.outline_weight * gain / self.settings.outline_gain)

    def seen_from(self, rays: PixelRays, poses: Poses | None, lens: LensChange | None) -> PixelRays:
        """Rays where their cameras are, through the lens that they have."""
        rays = rays if lens is None else rays.through_lens(lens, self.cameras.rotations[rays.view, 2])
        return rays if poses is None else rays.moved(poses)


def photon_gain(seen: Float[np.ndarray, "P 3"], brightness: float, share: float) -> Float[np.ndarray, "P"]:
    """By how much a residual counts more than at the mean brightness m: 1/√(1 − s + s E/m), with E what is seen.

    The share s of the variance grows with the light, as that of photons does and that of what a map gets wrong: so a
    dark ground under a bright sky has a say, too. E is the prediction, not the pixel, whose own error would weigh it.
    """
    gain: Float[np.ndarray, "P"] = 1 / np.sqrt(1 - share + share * np.maximum(seen.mean(1), 0.0) / brightness)
    return gain


@dataclass(frozen=True)
class Solution:
    """A surface, the map that explains the pixels best with it, and what both cost."""

    task: Task
    surface: LevelSet
    sights: Sights
    trust: Trust
    environment: Float[Tensor, "6 3 L L"]
    gain: Float[np.ndarray, "P"]
    residual: Float[np.ndarray, "P 3"]
    """What is seen less what was, times the gain."""
    slopes: Float[np.ndarray, "P 3 3"]
    """Of the residual, by the mirrored direction."""
    texels: Int[np.ndarray, "P"]
    free: Float[np.ndarray, "P"]
    """Weights of the pixels without trust and robust weights."""
    poses: Poses | None = None
    """Of the views; None: as they are said to be."""
    lens: LensChange | None = None
    """Of all views, where it is unknown; None: it is believed."""

    @classmethod
    def at(
        cls,
        task: Task,
        surface: LevelSet,
        trust: Trust,
        start: Float[Tensor, "6 3 M M"] | None,
        rounds: int,
        poses: Poses | None = None,
        lens: LensChange | None = None,
    ) -> "Solution":
        """With the map solved in so many robust rounds from another one, or from nothing."""
        options, settings = task.options, task.settings
        rays = task.seen_from(task.pixels.rays, poses, lens)
        sights = Sights.of(surface, rays, settings.samples, options.least_cosine)
        clear = sights.clear & (task.pixels.inner_px > options.inner_px)
        texel = np.pi / 2 / settings.resolution
        free = clear / (1 + (sights.turn / (options.wide_texels * texel)) ** 2)
        weights = free * trust.at(surface.points(sights.hits.places))
        areas = PixelFootprints(
            torch.from_numpy(sights.outgoing).float(), torch.from_numpy(task.pixels.radiance).float()
        )
        if start is None:
            environment = splatted_map(areas, torch.from_numpy(weights).float(), settings.resolution)
        else:
            environment = start if start.shape[-1] == settings.resolution else resample(start, settings.resolution)

        def gain_of(seen: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
            return photon_gain(seen, task.brightness, settings.photon_share)

        for _ in range(rounds):
            seen = areas.seen(environment)
            gain = torch.from_numpy(gain_of(seen.double().numpy())).float()
            agreed = robust_weight((seen - areas.radiance) * gain[:, None], settings.robust_scale)
            votes = torch.from_numpy(weights).float() * gain**2 * agreed
            environment = smoothed_map(environment, areas, votes, options.map_smoothness, options.map_steps)
        length = settings.resolution + 2
        padded = padded_texels(environment).reshape(6, length, length, 3).double().numpy()
        light, slopes, texels = seen_with_slopes(padded, sights.outgoing)
        counted = gain_of(light)
        residual, slopes = (light - task.pixels.radiance) * counted[:, None], slopes * counted[:, None, None]
        return cls(task, surface, sights, trust, environment, counted, residual, slopes, texels, free, poses, lens)

    @cached_property
    def rays(self) -> PixelRays:
        """Of the pixels, from where their cameras are."""
        return self.task.seen_from(self.task.pixels.rays, self.poses, self.lens)

    @cached_property
    def weights(self) -> Float[np.ndarray, "P"]:
        """Of the pixels, with trust, but without robust weights; in units of 1/σ²."""
        trusted = self.trust.at(self.surface.points(self.sights.hits.places))
        return self.task.photograph_weight * self.free * trusted

    @cached_property
    def points(self) -> Float[np.ndarray, "P 3"]:
        """Where the pixels see the surface."""
        return self.surface.points(self.sights.hits.places)

    @cached_property
    def mirrored_slopes(self) -> Float[np.ndarray, "P 3 3"]:
        """Of what is seen, by the mirrored direction."""
        return self.surface.surroundings.slopes_by_mirrored(self.slopes, self.points, self.sights.mirrored)

    @cached_property
    def photographs(self) -> Rows:
        """Pixels under the map."""
        rows = mirror_rows(self.sights.hits.derivatives, self.rays.directions, self.mirrored_slopes)
        weights = self.weights * robust_weight(self.residual, self.task.settings.robust_scale)
        return Rows(self.sights.hits.places, rows, self.residual, weights)

    @property
    def silhouettes(self) -> Rows:
        """Outlines and missed pixels."""
        return self._silhouettes[0]

    @cached_property
    def pose_rows(self) -> tuple[BlockRows, BlockRows]:
        """By the poses of views: of photographs, and of silhouettes."""
        hits = self.sights.hits
        distance = np.where(hits.met, hits.distance, 0.0) / self.surface.spacing
        rows = pixel_pose_rows(
            hits.derivatives, self.rays.directions, distance, self.mirrored_slopes, self.photographs.rows[..., 1:]
        )
        rows[..., 3:] /= self.surface.spacing
        return BlockRows(self.rays.view, rows, self.photographs.weights), self._silhouettes[1]

    @cached_property
    def _silhouette_rays(self) -> tuple[PixelRays, PixelRays]:
        """Of outlines, and of pixels that miss the surface."""
        outlines = self.task.seen_from(self.task.outlines, self.poses, self.lens)
        return outlines, self.rays.chosen(~self.sights.hits.met)

    @cached_property
    def _silhouettes(self) -> tuple[Rows, BlockRows]:
        sigmas = self.task.options.radiance_sigma / self.task.options.outline_sigma_px
        return silhouette_rows(
            self.surface,
            *self._silhouette_rays,
            self.task.outline_weight,
            self.task.photograph_weight * sigmas**2,
            self.task.options,
        )

    @property
    def outlines_agree(self) -> bool:
        """Whether outlines lie within `agreed_outline_px` of their masks' in the median, and within `agreed_pull_px` in
        the median over views of the median with a sign, which wrong masks move.
        """
        view, options = self.task.outlines.view, self.task.options
        met = self.silhouettes.weights[: len(view)] > 0
        if not met.any():
            return False
        view, apart = view[met], self.silhouettes.residual[: len(view), 0][met]
        pulled = np.median([np.median(apart[view == each]) for each in np.unique(view)])
        return bool(np.median(np.abs(apart)) <= options.agreed_outline_px and abs(pulled) <= options.agreed_pull_px)

    @cached_property
    def gauge(self) -> Rows:
        """‖∇φ‖ = 1 near the surface."""
        near = np.abs(self._values) < self.task.options.gauge_cells
        return gauge_rows(self.surface, near, self.task.options.gauge)

    @cached_property
    def constraints(self) -> Rows:
        """Silhouettes and gauge in one."""
        return joined_rows(self.silhouettes, self.gauge)

    @cached_property
    def active(self) -> Bool[np.ndarray, "A B C"]:
        """Coefficients that are unknowns."""
        return np.abs(self._values) < self.task.options.band_cells

    @cached_property
    def _values(self) -> Float[np.ndarray, "A B C"]:
        return self.surface.at_nodes()

    @property
    def smoothing(self) -> float:
        """Weight of the third differences, in cells, whose sum of squares is h times the integral of |D³φ|²."""
        return self.task.settings.smoothing / self.surface.spacing

    @cached_property
    def bent(self) -> Float[np.ndarray, "A B C"]:
        """The gradient of the prior."""
        return self.smoothing * third_differences(self._rough, self.active, whole=self._whole)

    def prior(self, before: "Solution") -> float:
        """λ/2 ∫ |D³φ|² over the unknowns of a solution `before`: coefficients that come near the surface by a step have
        never been smoothed, and would count against it.
        """
        if before is self:
            return float((self.bent * self._rough).sum()) / 2
        bent = self.smoothing * third_differences(self._rough, before.active, whole=before._whole)
        return float((bent * self._rough).sum()) / 2

    @cached_property
    def _whole(self) -> Int[np.ndarray, "A B C"]:
        return whole_differences(self.active)

    @property
    def _rough(self) -> Float[np.ndarray, "A B C"]:
        """What is to be smooth."""
        anchor, coefficients = self.task.anchor, self.surface.coefficients
        return coefficients if anchor is None else coefficients - anchor

    def cost(self, before: "Solution") -> float:
        """Half the sum of all robust squares, pixels weighed as in a solution `before`, and with its gain and unknowns.

        A pixel that no longer sees the surroundings costs what it did before, so it is not lost for gain.
        """
        scale = self.task.settings.robust_scale
        residual = self.residual * (before.gain / self.gain)[:, None]
        residual = np.where(self.sights.clear[:, None], residual, before.residual)
        photographs = scale**2 * float((before.weights * bounded_error(residual, scale)).sum()) / 2
        prior = self.prior(before)
        if self.poses is not None:
            prior += float(np.einsum("vi,vij,vj", self.poses.stacked, self.task.pose_prior, self.poses.stacked)) / 2
        if self.lens is not None:
            prior += float((self._lens_precision * self.lens.values**2).sum()) / 2
        return photographs + self.constraints.cost + prior

    @cached_property
    def _texel_total(self) -> Float[np.ndarray, "T"]:
        count = 6 * self.task.settings.resolution**2
        total = np.bincount(self.texels, self.photographs.weights, count)
        return np.maximum(total + self.task.options.texel_prior * self.task.photograph_weight, np.finfo(float).tiny)

    def beyond_map(self, residual: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """(1 − Π) e: what the map does not take over."""
        return without_means(residual, self.photographs.weights, self.texels, self._texel_total)

    @cached_property
    def _unexplained(self) -> Float[np.ndarray, "P 3"]:
        """The photographs' residual beyond the map."""
        return self.beyond_map(self.photographs.residual)

    @cached_property
    def beside(self) -> tuple[Beside, ...]:
        """What is unknown beside the surface: poses of the views, then what all views share."""
        of_poses = () if self.poses is None else (self._beside_poses(self.poses),)
        of_all = () if self.lens is None and self.surface.surroundings.is_far else (self._beside_shared(),)
        return of_poses + of_all

    @property
    def _curvature(self) -> float:
        """Factor of the photographs' part of the matrix: one where cameras or surroundings are unknown, too."""
        return 1.0 if self.beside else self.task.options.photograph_curvature

    def _beside_poses(self, poses: Poses) -> Beside:
        count, (seen, outlined) = len(poses.turns), self.pose_rows
        if not self.task.settings.outlines_alone:
            outlined = replace(outlined, rows=np.zeros_like(outlined.rows))
        blocks = seen.blocks(count) + outlined.blocks(count) + self.task.pose_prior
        return Beside(seen, outlined, poses.stacked, self.task.pose_prior, blocks)

    @property
    def _lens_precision(self) -> Float[np.ndarray, "M"]:
        """Of what is unknown of the lens."""
        assert self.lens is not None, "the lens was unknown"
        return self.lens.of_unknowns(self.task.options.focal_prior, self.task.options.k1_prior) ** -2.0

    def _beside_shared(self) -> Beside:
        """Coefficients of the surroundings, and then unknowns of the lens. The prior of the former only damps."""
        around, options = len(self.surface.surroundings.coefficients), self.task.options
        photographs, silhouettes = self.photographs, self.silhouettes
        seen = [self.surface.surroundings.rows(self.slopes, self.points, self.sights.mirrored)[..., :around]]
        outlined = [np.zeros((*silhouettes.residual.shape, around))]
        if self.lens is not None:
            rays = self.rays, concatenated(list(self._silhouette_rays))
            for found, of, by_pose in zip((seen, outlined), rays, self.pose_rows, strict=True):
                motions = self.lens.motions(of.origins, of.directions, self.task.cameras.rotations[of.view, 2])
                found.append(np.matmul(by_pose.rows, motions))
        rows = np.concatenate(seen, 2) * (photographs.weights > 0)[:, None, None]
        beyond = np.stack([self.beyond_map(np.ascontiguousarray(column)) for column in np.moveaxis(rows, 2, 0)], 2)
        of_silhouettes = BlockRows(
            np.zeros(len(silhouettes.weights), int), np.concatenate(outlined, 2), silhouettes.weights
        )
        matrix = np.einsum("pck,p,pcl->kl", rows, photographs.weights, beyond) + of_silhouettes.blocks(1)[0]
        least = options.least_surroundings_share * max(float(np.trace(matrix)), 1e-30)
        of_lens = (np.zeros(0), np.zeros(0)) if self.lens is None else (self._lens_precision, self.lens.values)
        precision = np.diag(np.append([least] * around, of_lens[0]))[None]
        value = np.append([0.0] * around, of_lens[1])
        of_photographs = BlockRows(np.zeros(len(photographs.weights), int), rows, photographs.weights)
        return Beside(of_photographs, of_silhouettes, value[None], precision, matrix + precision)

    def gradient(self) -> tuple[Float[np.ndarray, "A B C"], list[Float[np.ndarray, "_ _"]]]:
        """Of the cost, over active coefficients and over what is unknown beside them."""
        shape, constrained = self.surface.shape, self.constraints.residual
        total = self.photographs.backward(self._unexplained, shape)
        total += self.constraints.backward(constrained, shape)
        outlined = self.silhouettes.residual
        return (total + self.bent) * self.active, [
            each.backward(self._unexplained, outlined, each.value) for each in self.beside
        ]

    def product(
        self, change: Float[np.ndarray, "A B C"], beside: Sequence[Float[np.ndarray, "_ _"]] = ()
    ) -> tuple[Float[np.ndarray, "A B C"], list[Float[np.ndarray, "_ _"]]]:
        """The Gauss–Newton matrix, bent as photographs are, times a change of active coefficients and of what is
        unknown beside them.
        """
        shape, count = self.surface.shape, len(self.silhouettes.weights)
        seen, constrained = self.photographs.forward(change), self.constraints.forward(change)
        for each, moved in zip(self.beside, beside, strict=True):
            seen += each.photographs.forward(moved)
            constrained[:count] += each.silhouettes.forward(moved)
        seen = self._curvature * self.beyond_map(seen)
        total = self.photographs.backward(seen, shape)
        total += self.constraints.backward(constrained, shape)
        total += self.smoothing * third_differences(change, self.active, whole=self._whole)
        pulled = zip(self.beside, beside, strict=True)
        return total * self.active, [each.backward(seen, constrained[:count], moved) for each, moved in pulled]

    def after(self, change: Float[np.ndarray, "A B C"], beside: Sequence[Float[np.ndarray, "_ _"]]) -> "Solution":
        """Moved by a step, with hits, visibility and map made anew."""
        surface, moved = self.surface, list(beside)
        surface = replace(surface, coefficients=surface.coefficients + change)
        poses = None if self.poses is None else self.poses.after(moved.pop(0))
        shared = moved[0][0] if moved else np.zeros(0)
        if not surface.surroundings.is_far:
            around = surface.surroundings.after_walls(shared[: len(surface.surroundings.coefficients)])
            surface = replace(surface, surroundings=around)
        lens = None if self.lens is None else self.lens.after(shared[-len(self.lens.values) :])
        rounds = self.task.options.map_rounds
        return Solution.at(self.task, surface, self.trust, self.environment, rounds, poses, lens)

    def diagonal(self, smoothing_diagonal: float) -> Float[np.ndarray, "A B C"]:
        """The matrix's diagonal, but for what the map takes over; at least a millionth of its largest."""
        shape = self.surface.shape
        total = self._curvature * self.photographs.squares(shape)
        total += self.constraints.squares(shape)
        total += self.smoothing * smoothing_diagonal
        return np.maximum(total, 1e-6 * total[self.active].max(initial=1e-30))
