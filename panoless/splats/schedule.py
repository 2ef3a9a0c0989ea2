"""When things happen during a fit: the only place that turns shares of the iterations into iteration numbers."""

from dataclasses import dataclass

from panoless.config import FitConfig
from panoless.splats.descent import Published, published
from panoless.splats.kernels.objective import ObjectiveTerms
from panoless.splats.kernels.rasterize import Channels
from panoless.splats.rendering import DEPTH_BLEND

RECOVERY_STEPS = 100
MEANS_FALL = 0.01
DROP_AT = 0.4
"""Share of our iterations after which every rate falls geometrically…"""
DROP_FACTOR = 0.01
"""…to this factor at the last iteration, which improves the normals."""


@dataclass(frozen=True)
class Schedule:
    """Answers, for an iteration in [0, iterations), what acts in it."""

    config: FitConfig

    def _iteration(self, share: float) -> int:
        return round(share * self.config.splats.iterations)

    @property
    def _published(self) -> Published:
        return published(self.config)

    def _share(self, step: float) -> float:
        """Of a step of the published schedule."""
        return step / self._published.steps

    def begun(self, iteration: int, share: float) -> bool:
        """Whether that share of the iterations is over."""
        return iteration >= self._iteration(share)

    def reached(self, iteration: int, share: float) -> bool:
        """Whether that share of the iterations ends right before this one; never for a share of 0."""
        return 0 < iteration == self._iteration(share)

    def due(self, iteration: int, share: float) -> bool:
        """Whether something happens in this iteration that does each time after so large a share of them."""
        period = max(self._iteration(share), 1)
        return share > 0 and iteration > 0 and iteration % period == 0

    def geometry_moves(self, iteration: int) -> bool:
        """False while only the environment is warmed up."""
        return self.begun(iteration, self.config.environment.warmup)

    def rate_factor(self, iteration: int) -> float:
        """1, then a geometric fall to `DROP_FACTOR` at the last iteration; published rates do not fall."""
        begin, end = self._iteration(DROP_AT), self.config.splats.iterations
        if self.config.splats.rates == "published" or iteration < begin:
            return 1.0
        return DROP_FACTOR ** ((iteration + 1 - begin) / max(end - begin, 1))

    def means_factor(self, iteration: int) -> float:
        """What the rate of the means is multiplied by besides: in published rates, a geometric fall to
        MEANS_FALL, where it stays.
        """
        if self.config.splats.rates == "ours":
            return 1.0
        fall = self._iteration(self._share(self._published.means_fall_until))
        return MEANS_FALL ** min(iteration / max(fall, 1), 1.0)

    def lambda_silhouette(self, iteration: int) -> float:
        """The weight of Eq. 13, zero when its time is over ([t < 3000] in Eq. 14)."""
        loss = self.config.splats.loss
        return 0.0 if self.begun(iteration, loss.silhouette_until) else loss.lambda_silhouette

    def _density_active(self, iteration: int) -> bool:
        first, last = (self._share(step) for step in (self._published.grows_from, self._published.grows_until))
        within = self.begun(iteration, first) and not self.begun(iteration, last)
        return self.config.splats.density.enabled and within

    def density_round(self, iteration: int) -> bool:
        """Whether surfels are cloned, split and pruned after this iteration."""
        return self._density_active(iteration) and self.due(iteration, self._share(self._published.grows_every))

    def opacity_reset(self, iteration: int) -> bool:
        """Whether opacities are reset after this iteration."""
        return self._density_active(iteration) and self.due(iteration, self._share(self._published.resets_every))

    def opacities_recovered(self, iteration: int) -> bool:
        """Whether surfels had time to earn their opacity back since the last reset, so that pruning is fair.

        Recovery takes steps, not a share of the fit: a hundred, or half the time between resets if that is less.
        """
        period = max(self._iteration(self._share(self._published.resets_every)), 1)
        return iteration < period or iteration % period >= min(RECOVERY_STEPS, period // 2)

    def propagation(self, iteration: int) -> bool:
        """Whether normals are propagated after this iteration; an opacity reset has precedence."""
        first, last = (
            self._share(step) for step in (self._published.propagates_from, self._published.propagates_until)
        )
        within = self.begun(iteration, first) and not self.begun(iteration, last)
        due = self.due(iteration, self._share(self._published.propagates_every))
        return self._density_active(iteration) and within and due and not self.opacity_reset(iteration)

    def resting(self, iteration: int) -> frozenset[str]:
        """The parameters that hold still in this iteration: opacities for a while after a propagation."""
        rest = self._iteration(self._share(self._published.opacities_rest))
        since = iteration % max(self._iteration(self._share(self._published.propagates_every)), 1)
        rests = 0 < since <= rest and self.propagation(iteration - since)
        return frozenset({"opacity_logits"}) if rests else frozenset()


@dataclass(frozen=True)
class Phase:
    """What acts in a run of iterations: the terms of the objective, and what of the images they read."""

    geometry_moves: bool
    terms: ObjectiveTerms
    channels: Channels
    everywhere: bool
    """Whether some term reads pixels that are not the object's."""


def phase_of(config: FitConfig, geometry_moves: bool, lambda_silhouette: float) -> Phase:
    """The phase of given answers of a `Schedule`; geometric terms wait until the geometry moves."""
    loss, masked = config.splats.loss, config.splats.loss.photometric == "masked"
    terms = ObjectiveTerms(
        robust_scale=loss.robust_scale,
        photometric=masked,
        lambda_normal_consistency=loss.lambda_normal_consistency * geometry_moves,
        consistency_everywhere=not masked,
        lambda_silhouette=lambda_silhouette * geometry_moves,
        depth_blend=DEPTH_BLEND,
        activation=config.environment.activation,
        alpha_applied=config.splats.alpha_applied,
    )
    channels = Channels(colors=config.splats.albedo, depth=terms.lambda_normal_consistency > 0, distortion=False)
    everywhere = not masked or terms.lambda_silhouette > 0
    return Phase(geometry_moves, terms, channels, everywhere)
