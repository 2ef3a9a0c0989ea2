"""What pixels see by way of a level set under a map that adapts to it, and the cost."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.views import concatenated
from panoless.geometry.free_form.equations import Rows, gauge_rows, joined_rows, silhouette_rows
from panoless.geometry.free_form.map import LEAST_NOISE, MapData, Mirrored, direction_gain
from panoless.geometry.free_form.material import LEAST_SHARE
from panoless.geometry.free_form.motions import pixel_motion_rows
from panoless.geometry.free_form.surface import Hits, LevelSet
from panoless.geometry.free_form.task import RADIANCE_SIGMA, SILHOUETTE_SIGMA_PX, Task
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
from panoless.numeric.robust import bounded_error, robust_weight
from panoless.problem.blocks import Block
from panoless.problem.nuisance import NO_NUISANCE, Nuisance, block_diagonal
from panoless.problem.rays import PixelRays
from panoless.problem.rows import BlockRows, Linearized, rows_of

INNER_PX = 1.5
"""Pixels nearer to the silhouette of their mask are left out: they mix two things."""
LEAST_COSINE = 0.12
"""Between the ray and the surface's normal, for a pixel to count for the shape."""
WIDE_TEXELS = 4.0
"""A pixel that mirrors so many texels has half the weight."""
BAND_CELLS = 3.5
"""Coefficients within so many cells of the surface are unknowns: all whose support meets it."""
PHOTOGRAPH_CURVATURE = 0.5
"""Factor of the photographs' part of the Gauss–Newton matrix where the surface alone is unknown: their cost bends less
where the map follows."""
AGREED_SILHOUETTE_PX = 0.1
"""Photographs and masks agree where the silhouettes are this near to those of the masks…"""
AGREED_PULL_PX = 0.01
"""…and pulled no more than this."""


@dataclass(frozen=True)
class ReflectedRays:
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
    ) -> "ReflectedRays":
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
    ) -> "ReflectedRays":
        """Of rays that were traced already."""
        distance = np.where(hits.met, hits.distance, 0.0) / surface.spacing
        _, outgoing, turn = mirrored(hits.derivatives, rays.directions, distance, rays.steps, samples)
        points = np.broadcast_to(surface.points(hits.places)[:, None], outgoing.shape)
        looked_up = surface.surroundings.looked_up(points, outgoing)
        return cls(hits, outgoing.mean(1), looked_up, turn, clear)


@dataclass(frozen=True)
class Linearization:
    """A surface, the map that explains the pixels best with it, and what both cost."""

    task: Task
    surface: LevelSet
    reflected: ReflectedRays
    trust: Trust
    environment: Float[Tensor, "6 3 L L"]
    gain: Float[np.ndarray, "P 3"]
    """By how much residuals count; what is saturated may be any brighter."""
    residual: Float[np.ndarray, "P 3"]
    """What is seen less what was, times the gain."""
    slopes: Float[np.ndarray, "P 3 3"]
    """Of the residual, by the mirrored direction."""
    texels: Int[np.ndarray, "P"]
    free: Float[np.ndarray, "P"]
    """Weights of the pixels without trust and robust weights."""
    light: Float[np.ndarray, "P 3"]
    """Of the map, where pixels look into it."""
    known: Float[np.ndarray, "T"]
    """Weights of what is seen directly of each texel."""
    nuisance: Nuisance = NO_NUISANCE
    """Cameras, exposures and masks, where these are unknown."""

    @classmethod
    def at(
        cls,
        task: Task,
        surface: LevelSet,
        trust: Trust,
        start: Float[Tensor, "6 3 M M"] | None,
        rounds: int,
        nuisance: Nuisance = NO_NUISANCE,
        reflected: ReflectedRays | None = None,
    ) -> "Linearization":
        """With the map solved in so many robust rounds from another one, or from nothing; rays that are `reflected`
        already are not traced.
        """
        settings, surface = task.settings, replace(surface, surroundings=nuisance.around(surface.surroundings))
        rays = nuisance.moved(task.pixels.rays, task.cameras)
        radiance = nuisance.equalized(task.pixels.radiance, rays.view)
        if reflected is None:
            reflected = ReflectedRays.of(surface, rays, settings.samples, LEAST_COSINE)
        clear = reflected.clear & (task.pixels.inner_px > INNER_PX)
        texel = np.pi / 2 / settings.resolution
        free = clear / (1 + (reflected.turn / (WIDE_TEXELS * texel)) ** 2)
        facing, points = reflected.hits.facing(rays.directions), surface.points(reflected.hits.places)
        mirrored = Mirrored.by(task.material, task.pixels.radiance, radiance, points, facing)
        weights = torch.from_numpy(free * trust.at(points)).float()
        seen = MapData.of(mirrored, reflected.outgoing, weights, task.views, surface.surroundings)
        environment = seen.first_map(start, settings.resolution)
        for _ in range(rounds):
            environment = seen.next_map(environment, settings.robust_scale, task.brightness)
        length = settings.resolution + 2
        padded = padded_texels(environment).reshape(6, length, length, 3).double().numpy()
        light, slopes, texels = seen_with_slopes(padded, reflected.outgoing)
        counted = mirrored.gain(light, task.brightness)
        residual, slopes = (light - mirrored.radiance) * counted, slopes * counted[..., None]
        least_noise = LEAST_NOISE if settings.is_coarse else RADIANCE_SIGMA
        turned = direction_gain(residual, slopes, free > 0, least_noise)[:, None]
        counted, residual, slopes = counted * turned, residual * turned, slopes * turned[..., None]
        known = seen.known(settings.resolution)
        found = task, surface, reflected, trust, environment, counted, residual, slopes, texels, free, light, known
        return cls(*found, nuisance)

    @cached_property
    def rays(self) -> PixelRays:
        """Of the pixels, from where their cameras are."""
        return self.nuisance.moved(self.task.pixels.rays, self.task.cameras)

    @property
    def radiance(self) -> Float[np.ndarray, "P 3"]:
        """Of the pixels at equal exposures."""
        return self.nuisance.equalized(self.task.pixels.radiance, self.rays.view)

    @property
    def light_shown(self) -> Float[np.ndarray, "P 3"]:
        """What pixels are predicted to show."""
        share, scattered = self._material
        return share * self.light + scattered

    @cached_property
    def _material(self) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
        """Mirrored share and scattered radiance of the pixels."""
        if self.task.material is None:
            return np.ones_like(self.light), np.zeros_like(self.light)
        return self.task.material.at(self.points, self.facing)

    @property
    def facing(self) -> Float[np.ndarray, "P"]:
        """cos θ."""
        return self.reflected.hits.facing(self.rays.directions)

    @cached_property
    def weights(self) -> Float[np.ndarray, "P"]:
        """Of the pixels, with trust, but without robust weights; in units of 1/σ²."""
        return self.task.photograph_weight * self.free * self.trust.at(self.points)

    @cached_property
    def points(self) -> Float[np.ndarray, "P 3"]:
        """Where the pixels see the surface."""
        return self.surface.points(self.reflected.hits.places)

    @cached_property
    def mirrored_slopes(self) -> Float[np.ndarray, "P 3 3"]:
        """Of what is seen, by the mirrored direction."""
        return self.surface.surroundings.slopes_by_mirrored(self.slopes, self.points, self.reflected.mirrored)

    @cached_property
    def photographs(self) -> Rows:
        """Pixels under the map."""
        rows = mirror_rows(self.reflected.hits.derivatives, self.rays.directions, self.mirrored_slopes)
        weights = self.weights * robust_weight(self.residual, self.task.settings.robust_scale)
        return Rows(self.reflected.hits.places, rows, self.residual, weights)

    @property
    def silhouettes(self) -> Rows:
        """Silhouettes, and pixels that err about them."""
        return self._silhouettes[0]

    @cached_property
    def _motion_rows(self) -> Float[np.ndarray, "P 3 6"]:
        """Of photographs, by the motions of their rays."""
        hits = self.reflected.hits
        distance = np.where(hits.met, hits.distance, 0.0) / self.surface.spacing
        rows = pixel_motion_rows(
            hits.derivatives, self.rays.directions, distance, self.mirrored_slopes, self.photographs.rows[..., 1:]
        )
        rows[..., 3:] /= self.surface.spacing
        return rows

    @cached_property
    def _silhouette_rays(self) -> tuple[PixelRays, PixelRays, PixelRays]:
        """Of silhouettes, of pixels on the object that miss the surface, and of those beside it that do not."""
        silhouettes, beside = (
            self.nuisance.moved(rays, self.task.cameras) for rays in (self.task.silhouettes, self.task.background)
        )
        met = self.surface.meets(beside.origins, beside.directions)
        return silhouettes, self.rays.chosen(~self.reflected.hits.met), beside.chosen(met)

    @cached_property
    def _silhouettes(self) -> tuple[Rows, Float[np.ndarray, "S 1 6"]]:
        sigmas = RADIANCE_SIGMA / SILHOUETTE_SIGMA_PX
        return silhouette_rows(
            self.surface,
            *self._silhouette_rays,
            self.task.silhouette_weight,
            self.task.photograph_weight * sigmas**2,
            self.nuisance,
        )

    @property
    def silhouettes_agree(self) -> bool:
        """Whether silhouettes lie within `AGREED_SILHOUETTE_PX` of their masks' in the median, and within
        `AGREED_PULL_PX` in the median over views of the median with a sign, which wrong masks move.
        """
        view = self.task.silhouettes.view
        met = self.silhouettes.weights[: len(view)] > 0
        if not met.any():
            return False
        view, apart = view[met], self.silhouettes.residual[: len(view), 0][met]
        pulled = np.median([np.median(apart[view == each]) for each in np.unique(view)])
        return bool(np.median(np.abs(apart)) <= AGREED_SILHOUETTE_PX and abs(pulled) <= AGREED_PULL_PX)

    @cached_property
    def gauge(self) -> Rows:
        """‖∇φ‖ = 1 near the surface."""
        return gauge_rows(self.surface, self._values)

    @cached_property
    def constraints(self) -> Rows:
        """Silhouettes and gauge in one."""
        return joined_rows(self.silhouettes, self.gauge)

    @cached_property
    def active(self) -> Bool[np.ndarray, "A B C"]:
        """Coefficients that are unknowns."""
        return np.abs(self._values) < BAND_CELLS

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

    def prior(self, before: "Linearization") -> float:
        """λ/2 ∫ |D³φ|² over the unknowns of a linearization `before`: coefficients that come near the surface by a step
        have never been smoothed, and would count against it.
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
        reference, coefficients = self.task.reference, self.surface.coefficients
        return coefficients if reference is None else coefficients - reference

    def cost(self, before: "Linearization") -> float:
        """Half the sum of all robust squares, with weights, gain and unknowns of a linearization `before`.

        A pixel that no longer sees the surroundings costs what it did before, so it is not lost for gain.
        """
        scale = self.task.settings.robust_scale
        residual = self.residual * (before.gain / np.maximum(self.gain, 1e-12))
        residual = np.where(self.reflected.clear[:, None], residual, before.residual)
        photographs = scale**2 * float((before.weights * bounded_error(residual, scale)).sum()) / 2
        prior = self.prior(before)
        prior += self.task.prior_factor * self.nuisance.prior_cost
        return photographs + self.constraints.cost + prior

    @cached_property
    def _texel_total(self) -> Float[np.ndarray, "T"]:
        count = 6 * self.task.settings.resolution**2
        total = np.bincount(self.texels, self.photographs.weights, count)
        known = (self.task.texel_prior + self.known) * self.task.photograph_weight
        return np.maximum(total + known, np.finfo(float).tiny)

    def beyond_map(self, residual: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """(1 − Π) e: what the map does not take over."""
        return without_means(residual, self.photographs.weights, self.texels, self._texel_total)

    @cached_property
    def _unexplained(self) -> Float[np.ndarray, "P 3"]:
        """The photographs' residual beyond the map."""
        return self.beyond_map(self.photographs.residual)

    @cached_property
    def beside(self) -> tuple[Linearized, ...]:
        """What is free beside the surface: blocks of views, then those of all views."""
        by_view, shared = (self.nuisance.free_blocks(by_view=each) for each in (True, False))
        return ((self._of_views(by_view),) if by_view else ()) + ((self._of_all(shared),) if shared else ())

    @property
    def _curvature(self) -> float:
        """Factor of the photographs' part of the matrix: one where others are unknown, too."""
        return 1.0 if self.beside else PHOTOGRAPH_CURVATURE

    def _rows_of(self, block: Block) -> tuple[Float[np.ndarray, "P 3 M"], Float[np.ndarray, "S 1 M"]]:
        """Of photographs and of silhouettes, by the unknowns of a block."""
        cameras = self.task.cameras
        if block.surroundings_columns is not None:
            seen = self._surroundings_rows[..., block.surroundings_columns]
        else:
            seen = rows_of(block, self.rays, cameras, self._motion_rows, self._light)
        return seen, rows_of(block, self._all_silhouette_rays, cameras, self._silhouettes[1])

    @cached_property
    def _surroundings_rows(self) -> Float[np.ndarray, "P 3 D"]:
        """Of photographs, by the unknowns of the surroundings."""
        return self.surface.surroundings.rows(self.slopes, self.points, self.reflected.mirrored)

    @cached_property
    def _all_silhouette_rays(self) -> PixelRays:
        """The rays of silhouettes in one."""
        return concatenated(list(self._silhouette_rays))

    @cached_property
    def _light(self) -> Float[np.ndarray, "P 3"]:
        """The prediction, times the gain of residuals."""
        share, _ = self._material
        return self.light_shown * self.gain / np.maximum(share, LEAST_SHARE)

    def _of_views(self, blocks: Sequence[Block]) -> Linearized:
        count = len(blocks[0].values)
        seen, silhouette_rows = (np.concatenate(each, 2) for each in zip(*map(self._rows_of, blocks), strict=True))
        photographs = BlockRows(self.rays.view, seen, self.photographs.weights)
        silhouettes = BlockRows(self._all_silhouette_rays.view, silhouette_rows, self.silhouettes.weights)
        precision = self.task.prior_factor * block_diagonal([each.precision for each in blocks])
        matrix = photographs.blocks(count) + silhouettes.blocks(count) + precision
        return Linearized(
            photographs, silhouettes, np.concatenate([each.values for each in blocks], 1), precision, matrix
        )

    def _of_all(self, blocks: Sequence[Block]) -> Linearized:
        photographs, silhouettes = self.photographs, self.silhouettes
        seen, silhouette_rows = (np.concatenate(each, 2) for each in zip(*map(self._rows_of, blocks), strict=True))
        seen = seen * (photographs.weights > 0)[:, None, None]
        beyond = np.stack([self.beyond_map(np.ascontiguousarray(column)) for column in np.moveaxis(seen, 2, 0)], 2)
        all_alike = [np.zeros(len(each.weights), int) for each in (photographs, silhouettes)]
        of_silhouettes = BlockRows(all_alike[1], silhouette_rows, silhouettes.weights)
        matrix = np.einsum("pck,p,pcl->kl", seen, photographs.weights, beyond) + of_silhouettes.blocks(1)[0]
        precision = self.task.prior_factor * block_diagonal([each.precision for each in blocks])
        value = np.concatenate([each.values for each in blocks], 1)
        of_photographs = BlockRows(all_alike[0], seen, photographs.weights)
        return Linearized(of_photographs, of_silhouettes, value, precision, matrix + precision)

    def gradient(self) -> tuple[Float[np.ndarray, "A B C"], list[Float[np.ndarray, "_ _"]]]:
        """Of the cost, over active coefficients and over what is unknown beside them."""
        shape, constrained = self.surface.shape, self.constraints.residual
        total = self.photographs.backward(self._unexplained, shape)
        total += self.constraints.backward(constrained, shape)
        apart = self.silhouettes.residual
        return (total + self.bent) * self.active, [
            each.backward(self._unexplained, apart, each.value) for each in self.beside
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

    def after(self, change: Float[np.ndarray, "A B C"], beside: Sequence[Float[np.ndarray, "_ _"]]) -> "Linearization":
        """Moved by a step, with hits, visibility and map computed again."""
        moved = list(beside)
        surface = replace(self.surface, coefficients=self.surface.coefficients + change)
        by_view = moved.pop(0) if self.nuisance.free_blocks(by_view=True) else None
        nuisance = self.nuisance.stepped(by_view, moved[0][0] if moved else None)
        return Linearization.at(self.task, surface, self.trust, self.environment, self.task.map_rounds, nuisance)

    def under(self, task: Task) -> "Linearization":
        """Of another task with the same pixels, with the map computed again."""
        return Linearization.at(
            task, self.surface, self.trust, self.environment, task.map_rounds, self.nuisance, self.reflected
        )

    def diagonal(self, smoothing_diagonal: float) -> Float[np.ndarray, "A B C"]:
        """The matrix's diagonal, but for what the map takes over; at least a millionth of its largest."""
        shape = self.surface.shape
        total = self._curvature * self.photographs.squares(shape)
        total += self.constraints.squares(shape)
        total += self.smoothing * smoothing_diagonal
        return np.maximum(total, 1e-6 * total[self.active].max(initial=1e-30))
