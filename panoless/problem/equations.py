"""Photographs and silhouettes of a surface of few numbers with nuisance blocks, linearized (see `solve`)."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int, Num
from torch import Tensor

from panoless.capture.poses import StatedCameras
from panoless.capture.views import Views
from panoless.environment.direct import direct_rays
from panoless.environment.mirrored import MirroredRays, slopes_of
from panoless.environment.rays import Rays
from panoless.environment.solve import solve_environment
from panoless.environment.surroundings import Surroundings
from panoless.environment.variable_projection import VariableProjection
from panoless.kernels.cubemap import sample_cubemap
from panoless.numeric.factorize import regularize
from panoless.numeric.gauss_newton import damped_step, normal_equations
from panoless.numeric.robust import bounded_error, robust_scale, robust_weight
from panoless.problem.blocks import Exposures, WhiteBalances
from panoless.problem.nuisance import Nuisance
from panoless.problem.observations import Pixels, is_saturated, silhouette_rays, solid_pixels
from panoless.problem.parametric import MirrorHits, ParametricSurface, Silhouette
from panoless.problem.rays import PixelRays
from panoless.problem.rows import CHI_MEDIAN, CONTOUR_SIGMA_PX, CORRELATED, rows_of
from shinypartial.core.sphere import tangents

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

RADIANCE_SIGMA = 0.05
"""Standard deviation of a pixel (linear radiance) where nothing beside the surface is unknown."""
LEAST_SIGMA = 0.005
"""Of a pixel (linear radiance)."""
NOISE_MULTIPLE = 3.0
"""The robust scale of silhouettes is at least so many medians of their distances."""
SILHOUETTE_POINTS = 20_000
"""Most contour points of all views."""
INNER_PX = 1.5
"""Pixels nearer to the edge of their mask (px) mix object and background."""
COUNTED_RAYS = 30_000
"""Rays count as so many where there are more: errors of surface and map repeat between them."""
LEAST_CLEAR = 50
"""Fewer rays that see the surroundings have no weight."""
DAMPINGS = (1e-6, 1e-3, 1e-1, 10.0)
"""Of a step, in shares of the matrix' diagonal (Levenberg and Marquardt), tried in turn."""
CONTOUR_SCALE_PX = 0.5
"""Robust scale of silhouettes beside photographs (px)."""


@dataclass(frozen=True)
class Round:
    """Gauss–Newton steps, the map solved before each."""

    resolution: int
    """Texels along a face side of the map; 0: silhouettes alone."""
    robust_scale: float
    """Residual (linear radiance; px of silhouettes alone) beyond which a pixel loses its vote."""
    rays: int
    """About so many pixels of all views take part."""
    steps: int
    """Most steps."""


@dataclass(frozen=True)
class State:
    """All unknowns but the map."""

    surface: ParametricSurface
    nuisance: Nuisance

    @property
    def around(self) -> Surroundings:
        """What is mirrored."""
        return self.nuisance.around(self.surface.surroundings)

    def without_common(self, cameras: StatedCameras) -> "State":
        """In a world without what moves all cameras alike."""
        common, nuisance = self.nuisance.without_common(cameras)
        return State(self.surface if common is None else self.surface.taken_back(common), nuisance)

    def stepped(self, step: Float[np.ndarray, "D"]) -> "State":
        """Changed: the surface's numbers, those of views, and those that all views share."""
        of_views, shared = (self.nuisance.free_blocks(by_view=each) for each in (True, False))
        first, each = self.surface.count, sum(block.size for block in of_views)
        last = first + each * (len(of_views[0].values) if of_views else 0)
        nuisance = self.nuisance.stepped(
            step[first:last].reshape(-1, each) if of_views else None, step[last:] if shared else None
        )
        return State(self.surface.stepped(step[:first]), nuisance)


@dataclass(frozen=True)
class Data:
    """What a round is solved for."""

    pixels: Pixels | None
    silhouettes: PixelRays
    cameras: StatedCameras
    settings: Round
    last: bool
    """Whether photographs under this map determine all of the surface."""
    views: Views
    """For what is seen past the object."""

    @classmethod
    def of(cls, views: Views, settings: Round, last: int, free: Collection[str] = ()) -> "Data":
        """Of views, with maps of so many texels in the `last` round. Where blocks are `free`, masks may be wrong, and a
        saturated pixel has no radiance to divide by a gain.
        """
        silhouettes = silhouette_rays(views, longest_only=True)
        chosen = silhouettes.chosen(slice(None, None, max(1, len(silhouettes.size) // SILHOUETTE_POINTS)))
        pixels = solid_pixels(views, settings.rays) if settings.resolution else None
        if pixels is not None and free:
            kept = pixels.inner_px > INNER_PX
            if {Exposures.name, WhiteBalances.name} & set(free):
                kept &= ~is_saturated(pixels.radiance).any(1)
            pixels = pixels.chosen(kept)
        return cls(pixels, chosen, StatedCameras.of(views), settings, settings.resolution >= last, views)


@dataclass(frozen=True)
class Traced:
    """Rays of all pixels where cameras of a state are, and where they meet its surface."""

    rays: PixelRays
    hits: MirrorHits

    @classmethod
    def of(cls, data: Data, state: State) -> "Traced | None":
        """None where no pixels take part."""
        if data.pixels is None:
            return None
        rays = state.nuisance.moved(data.pixels.rays, data.cameras)
        return cls(rays, state.surface.hits(rays))


@dataclass(frozen=True)
class Photographs:
    """Pixels that see the surroundings, under a map solved from them."""

    chosen: Int[np.ndarray, "Q"]
    rays: PixelRays
    hits: MirrorHits
    mirrored: MirroredRays
    environment: Float[Tensor, "6 3 L L"]
    light: Float[np.ndarray, "Q 3"]
    residual: Float[np.ndarray, "Q 3"]
    sigma: float
    projection: VariableProjection
    """Of the pixels, then of what is seen past the object."""
    direct: Float[np.ndarray, "D 3"]
    """Residuals of the latter."""

    @classmethod
    def at(cls, data: Data, state: State, traced: Traced, *, estimated: bool) -> "Photographs | None":
        """Of a state, with `estimated` noise; None where too few pixels see the surroundings."""
        assert data.pixels is not None, "photographs take part"
        chosen = np.flatnonzero(traced.hits.clear)
        if len(chosen) < LEAST_CLEAR:
            return None
        rays, hits = traced.rays.chosen(chosen), chosen_hits(traced.hits, chosen)
        radiance = state.nuisance.equalized(data.pixels.radiance[chosen], rays.view)
        mirrored = MirroredRays(rays.directions, hits.normals, hits.points, state.around)
        directions, seen = (torch.from_numpy(each).float() for each in (mirrored.looked_up, radiance))
        rays_seen = [Rays(directions, seen)]
        past = direct_rays(data.views, state.around, rays_seen)
        environment = solve_environment([*rays_seen, past], data.settings.resolution)
        light = mirrored.light(environment)
        residual = light - radiance
        sigma = RADIANCE_SIGMA
        if estimated:
            sigma = max(float(np.median(np.linalg.norm(residual, axis=1))) / CHI_MEDIAN, LEAST_SIGMA)
        weights = robust_weight(residual, data.settings.robust_scale) / sigma**2
        if estimated:
            weights *= min(COUNTED_RAYS / len(chosen), 1.0)
        direct = (sample_cubemap(environment, past.directions) - past.radiance).double().numpy()
        counted = past.initial_weight().double().numpy() * robust_weight(direct, data.settings.robust_scale)
        weights = np.concatenate([weights, counted * np.median(weights)])
        looked_up = np.concatenate([mirrored.looked_up, past.directions.double().numpy()])
        projection = VariableProjection.of(looked_up, weights, data.settings.resolution)
        return cls(chosen, rays, hits, mirrored, environment, light, residual, sigma, projection, direct)

    @cached_property
    def by_normal(self) -> Float[np.ndarray, "Q 3 3"]:
        """Derivatives of the light by the unit normals."""
        across = np.stack(tangents(self.hits.normals), 2)
        return np.matmul(self.mirrored.light_by_turns(self.environment, across), across.transpose(0, 2, 1))

    def motion_rows(self) -> Float[np.ndarray, "Q 3 6"]:
        """Of the light, by (ω, τ) of the rays.

        A hit moves by (1 − d nᵀ/(d·n)) (τ + t ω × d) along the surface, the normal by S times that, and the mirrored
        direction with normal and ray.
        """
        hits, directions = self.hits, self.rays.directions
        along = np.matmul(self.by_normal, hits.shape)
        facing = (directions * hits.normals).sum(1)
        slide = np.matmul(along, directions[:, :, None]) * (hits.normals / facing[:, None])[:, None]
        by_shift = along - slide
        by_ray = self.mirrored.by_ray(self.mirrored.slopes(self.environment))
        by_turn = np.cross(directions[:, None], by_ray + hits.distance[:, None, None] * by_shift)
        return np.concatenate([by_turn, by_shift], 2)

    @cached_property
    def surroundings_rows(self) -> Float[np.ndarray, "Q 3 D"]:
        """Of the light, by the unknowns of the surroundings."""
        slopes = slopes_of(self.environment, self.mirrored.looked_up)
        return self.mirrored.surroundings.rows(slopes, self.mirrored.points, self.mirrored.mirrored)

    def with_direct(self, values: Num[np.ndarray, "Q *K"]) -> Num[np.ndarray, "P *K"]:
        """Of pixels, and zeros of what is seen past the object, which depends on no unknown."""
        return np.concatenate([values, np.zeros((len(self.direct), *values.shape[1:]), values.dtype)])

    @property
    def all_residuals(self) -> Float[np.ndarray, "P 3"]:
        """Of pixels, and of what is seen past the object."""
        return np.concatenate([self.residual, self.direct])

    def cost(self, data: Data, state: State, traced: Traced) -> float:
        """½ Σ w ‖(1 − Π) e‖² of another state, under this map. A ray that no longer sees the surroundings costs what it
        did before, so it is not lost for gain.
        """
        assert data.pixels is not None, "photographs take part"
        rays, hits, chosen = traced.rays.chosen(self.chosen), traced.hits, self.chosen
        mirrored = MirroredRays(rays.directions, hits.normals[chosen], hits.points[chosen], state.around)
        radiance = state.nuisance.equalized(data.pixels.radiance[chosen], rays.view)
        residual = mirrored.light(self.environment) - radiance
        residual = np.where(hits.clear[chosen, None], residual, self.residual)
        return self.projection.cost(np.concatenate([residual, self.direct]))


def chosen_hits(hits: MirrorHits, chosen: Int[np.ndarray, "Q"]) -> MirrorHits:
    """Some of them."""
    return MirrorHits(*(values[chosen] for values in vars(hits).values()))


@dataclass(frozen=True)
class Equations:
    """A state, linearized."""

    data: Data
    state: State
    photographs: Photographs | None
    silhouette: Silhouette
    distance_px: Float[np.ndarray, "S"]
    scale_px: float
    sigma_px: float
    """Standard deviation of a silhouette's point."""
    gradient: Float[np.ndarray, "D"]
    matrix: Float[np.ndarray, "D D"]
    regularizing: Float[np.ndarray, "_ _"]
    anchor: Float[np.ndarray, "_"] | None

    @classmethod
    def at(cls, data: Data, state: State, traced: Traced | None = None) -> "Equations":
        """With the map solved for the state, whose pixels may be traced."""
        surface, nuisance, count = state.surface, state.nuisance, state.surface.count
        by_view, shared = (nuisance.free_blocks(by_view=each) for each in (True, False))
        views = len(data.cameras.centers)
        size, others = (sum(block.size for block in blocks) for blocks in (by_view, shared))
        unknowns = count + views * size + others
        free = bool(by_view or shared)
        numbers = np.arange(size), count + views * size + np.arange(others)

        def beside(rays: PixelRays, by_motion: np.ndarray, seen: Photographs | None) -> tuple[np.ndarray, ...]:
            light = None if seen is None else seen.light
            rows = [
                seen.surroundings_rows[..., each.surroundings_columns]
                if seen is not None and each.surroundings_columns is not None
                else rows_of(each, rays, data.cameras, by_motion, light)
                for each in (*by_view, *shared)
            ]
            empty = np.zeros((*by_motion.shape[:2], 0))
            columns = [count + size * rays.view[:, None] + numbers[0], np.tile(numbers[1], (len(rays.view), 1))]
            return np.concatenate([empty, *rows], 2), np.concatenate(columns, 1)

        gradient, matrix = np.zeros(unknowns), np.zeros((unknowns, unknowns))
        traced = traced or Traced.of(data, state)
        photographs = None if traced is None else Photographs.at(data, state, traced, estimated=free)
        if photographs is not None:
            hits, rays = photographs.hits, photographs.rays
            by_motion = photographs.motion_rows() if free else np.zeros((len(rays.view), 3, 6))
            rows, columns = beside(rays, by_motion, photographs)
            gradient, matrix = photographs.projection.sparse_equations(
                photographs.with_direct(np.concatenate([np.matmul(photographs.by_normal, hits.rows), rows], 2)),
                photographs.with_direct(np.concatenate([hits.columns, columns], 1)),
                unknowns,
                photographs.all_residuals,
            )
            if surface.unseen is not None and not data.last:
                hidden = np.concatenate([surface.unseen, np.zeros((unknowns - count, surface.unseen.shape[1]))])
                gradient = gradient - hidden @ (hidden.T @ gradient)
                matrix = matrix - hidden @ (hidden.T @ matrix)
                matrix = matrix - (matrix @ hidden) @ hidden.T
        silhouettes = nuisance.moved(data.silhouettes, data.cameras)
        silhouette = surface.silhouette(silhouettes)
        distance = silhouette.pixels - nuisance.offsets_px(silhouettes.view)
        least = CONTOUR_SCALE_PX if data.settings.resolution else data.settings.robust_scale
        scale = robust_scale(distance[silhouette.weights > 0], least, NOISE_MULTIPLE)
        sigma = float(np.hypot(CONTOUR_SIGMA_PX, data.views.mask_sigma_px))
        weights = silhouette.weights * robust_weight(distance, scale) / sigma**2
        rows, columns = beside(silhouettes, silhouette.by_motion[:, None], None)
        by_silhouettes, of_silhouettes = normal_equations(
            _jacobian(silhouette, rows[:, 0], columns, unknowns), distance, weights
        )
        gradient, matrix = gradient + by_silhouettes, matrix + of_silhouettes
        start = 0
        for block in by_view:
            for view in range(views):
                place = count + size * view + start
                where = slice(place, place + block.size)
                gradient[where] += CORRELATED * block.precision[view] @ block.values[view]
                matrix[where, where] += CORRELATED * block.precision[view]
            start += block.size
        start = count + views * size
        for block in shared:
            where = slice(start, start + block.size)
            gradient[where] += CORRELATED * block.precision[0] @ block.values[0]
            matrix[where, where] += CORRELATED * block.precision[0]
            start += block.size
        found = surface.regularization(matrix[:count, :count])
        matrix[:count, :count] += found.matrix
        if found.value is not None:
            gradient[:count] += found.matrix @ found.value
        return cls(
            data,
            state,
            photographs,
            silhouette,
            distance,
            scale,
            sigma,
            gradient,
            matrix,
            found.matrix,
            found.value,
        )

    def cost(self, state: State, step: Float[np.ndarray, "D"], traced: Traced | None = None) -> float:
        """Of a state after a step, whose pixels are traced."""
        total = CORRELATED * state.nuisance.prior_cost
        if self.anchor is not None:
            value = self.anchor + step[: len(self.anchor)]
            total += float(value @ self.regularizing @ value) / 2
        seen, found, distance = self.photographs, self.silhouette, self.distance_px
        if state is self.state:
            total += 0.0 if seen is None else seen.projection.cost(seen.all_residuals)
        else:
            total += 0.0 if seen is None or traced is None else seen.cost(self.data, state, traced)
            rays = state.nuisance.moved(self.data.silhouettes, self.data.cameras)
            found = state.surface.silhouette(rays)
            distance = found.pixels - state.nuisance.offsets_px(rays.view)
        lost = np.where(found.valid, bounded_error(distance, self.scale_px), 1.0)
        return total + (self.scale_px / self.sigma_px) ** 2 * float(self.silhouette.weights @ lost) / 2

    def after_step(self) -> tuple[State, float, Traced | None]:
        """The state after the least damped of the tried steps that lowers the cost, by which share of it, and its
        pixels.
        """
        limit, diagonal = self.state.surface.limit, np.diag(self.matrix)
        before = self.cost(self.state, np.zeros_like(diagonal))
        for damping in DAMPINGS:
            damped = self.matrix + damping * np.diag(diagonal)
            step = damped_step(self.gradient, damped, largest=limit.largest, limited=limit.limited)
            moved = self.state.stepped(step)
            traced = Traced.of(self.data, moved)
            cost = self.cost(moved, step, traced)
            if cost < before:
                return moved, 1 - cost / before, traced
        return self.state, 0.0, None

    def covariances(self) -> dict[str, Float[np.ndarray, "N N"]]:
        """Posterior covariances of the numbers of each free block, group after group: the part of C H⁻¹, with the
        surface, the other blocks and the map that follow.
        """
        by_view, shared = (self.state.nuisance.free_blocks(by_view=each) for each in (True, False))
        if not by_view and not shared:
            return {}
        whole = CORRELATED * np.linalg.inv(regularize(self.matrix, "cameras and exposures"))
        found: dict[str, np.ndarray] = {}
        size, first = sum(each.size for each in by_view), self.state.surface.count
        start = first
        for block in by_view:
            places = start + size * np.arange(len(block.values))[:, None] + np.arange(block.size)
            found[block.name] = whole[np.ix_(places.ravel(), places.ravel())]
            start += block.size
        start = len(whole) - sum(each.size for each in shared)
        for block in shared:
            where = slice(start, start + block.size)
            found[block.name], start = whole[where, where], start + block.size
        return found


def _jacobian(
    silhouette: Silhouette, rows: Float[np.ndarray, "S M"], columns: Int[np.ndarray, "S M"], unknowns: int
) -> "csr_matrix":
    """Derivatives of the distances by all unknowns: those of the surface, and rows in columns."""
    from scipy import sparse

    own = silhouette.jacobian
    padded = sparse.csr_matrix((own.data, own.indices, own.indptr), shape=(own.shape[0], unknowns))
    starts = np.arange(len(rows) + 1) * rows.shape[1]
    return padded + sparse.csr_matrix((rows.ravel(), columns.ravel(), starts), shape=(len(rows), unknowns))
