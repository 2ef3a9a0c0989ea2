"""Adam over named parameters whose surfel rows can be edited during the fit."""

import math
from typing import Any

import torch
from torch import Tensor

from panoless.splats.descent import Rates
from panoless.splats.kernels.adam import UNBOUNDED, AdamTensor, adam_step
from panoless.splats.model import Surfels

MOMENTUM = 0.9
EPSILON = 1e-12
NOT_NEGATIVE = (0.0, math.inf)
MOMENTS = ("exp_avg", "exp_avg_sq")
ENVIRONMENT = "environment"


class SurfelOptimizer:
    """A rate and moments for each name. `torch.optim` is not used: it loads a compiler, which takes seconds."""

    def __init__(self, surfels: Surfels, environment: Tensor, rates: Rates) -> None:
        """Make leaves of all tensors; rates are looked up by the parameters' names."""
        self._betas = MOMENTUM, rates.square_memory
        self._rates = rates.by_name
        self._state: dict[str, dict[str, Tensor]] = {}
        self.surfels = surfels.mapped(_leaf)
        """The surfel parameters, leaves of the graph."""
        self.environment = _leaf(environment)
        """The environment parameters, a leaf of the graph."""

    def step(
        self,
        factor: float,
        *,
        geometry: bool,
        frozen: frozenset[str],
        means_factor: float = 1.0,
        environment_bounds: tuple[float, float] = UNBOUNDED,
    ) -> None:
        """One step with every rate times `factor`, that of the means times `means_factor`, too.

        Without `geometry` only the environment moves, in its bounds. Albedo is light and stays at 0 or above.
        """
        tensors = []
        for name, parameter in {**self.surfels.named(), ENVIRONMENT: self.environment}.items():
            gradient, parameter.grad = parameter.grad, None
            if gradient is None or name in frozen or (name != ENVIRONMENT and not geometry):
                continue
            if name not in self._state:
                self._state[name] = {"step": torch.zeros(()), **{key: torch.zeros_like(parameter) for key in MOMENTS}}
            state = self._state[name]
            state["step"] += 1
            rate = self._rates[name] * factor * (means_factor if name == "means" else 1.0)
            mean, square = (state[key] for key in MOMENTS)
            bounds = {ENVIRONMENT: environment_bounds, "albedo": NOT_NEGATIVE}.get(name, UNBOUNDED)
            tensors.append(AdamTensor(parameter.detach(), gradient, mean, square, rate, int(state["step"]), bounds))
        adam_step(tensors, self._betas, EPSILON)

    def edit_surfels(self, surfels: Surfels, source: Tensor, keep_moments: Tensor) -> None:
        """Take `surfels`; row i inherits the moments of old row `source[i]` where `keep_moments[i]`, else zeros."""
        for name, value in surfels.named().items():
            if name in self._state:
                kept = keep_moments.view(-1, *[1] * (value.dim() - 1)).to(value.dtype)
                moments = {key: self._state[name][key][source] * kept for key in MOMENTS}
                self._state[name] = {**self._state[name], **moments}
        self.surfels = surfels.mapped(_leaf)

    def set_values(self, surfels: Surfels) -> None:
        """Take the values of as many surfels. Parameters that change restart their moments, the others keep them."""
        leaves = self.surfels.named()
        for name, value in surfels.named().items():
            if torch.equal(value, leaves[name]):
                continue
            leaves[name] = _leaf(value)
            if name in self._state:
                self._state[name] = {**self._state[name], **{key: torch.zeros_like(value) for key in MOMENTS}}
        self.surfels = type(surfels)(**leaves)

    def set_environment(self, environment: Tensor) -> None:
        """Take another map, whose moments restart."""
        self.environment = _leaf(environment)
        self._state.pop(ENVIRONMENT, None)

    def state_dict(self) -> dict[str, Any]:
        """Moments and step counts by name, for a checkpoint."""
        return {"state": {name: dict(values) for name, values in self._state.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` gave, or the numbered groups of checkpoints of version 0.1."""
        names = {index: group["name"] for index, group in enumerate(state.get("param_groups", ()))}
        like = {**self.surfels.named(), ENVIRONMENT: self.environment}
        for key, values in state["state"].items():
            name = names.get(key, key)
            self._state[name] = {
                moment: (value if moment == "step" else value.to(like[name])).clone()
                for moment, value in values.items()
            }


def _leaf(value: Tensor) -> Tensor:
    return value.detach().clone().requires_grad_()
