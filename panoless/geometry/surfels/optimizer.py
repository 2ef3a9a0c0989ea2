"""Adam over named parameters whose surfel rows can be edited during the fit."""

import math
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from panoless.config import RateConfig
from panoless.geometry.surfels.model import Surfels
from panoless.kernels.adam import UNBOUNDED, AdamTensor, adam_step

MOMENTUM = 0.9
EPSILON = 1e-12
NOT_NEGATIVE = (0.0, math.inf)
MOMENTS = ("exp_avg", "exp_avg_sq")
ENVIRONMENT = "environment"


class SurfelOptimizer:
    """One parameter group a name, so that every quantity has its own rate."""

    def __init__(self, surfels: Surfels, environment: Tensor, rates: RateConfig) -> None:
        """Make leaves of all tensors; rates are looked up by the parameters' names."""
        base = {"opacity_logits": rates.opacity_logits, **asdict(rates)}
        named = {**surfels.named(), ENVIRONMENT: environment}
        groups: list[dict[str, Any]] = [
            {"params": [value.detach().clone().requires_grad_()], "lr": base[name], "name": name, "base": base[name]}
            for name, value in named.items()
        ]
        self._betas = MOMENTUM, rates.square_memory
        self._adam = torch.optim.Adam(groups, betas=self._betas, eps=EPSILON)
        self._index()

    def _index(self) -> None:
        self._groups: dict[str, dict[str, Any]] = {group["name"]: group for group in self._adam.param_groups}
        leaves = {name: group["params"][0] for name, group in self._groups.items()}
        self.environment: Tensor = leaves.pop(ENVIRONMENT)
        """The environment parameters, a leaf of the graph."""
        self.surfels = Surfels(**leaves)
        """The surfel parameters, leaves of the graph."""

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
        for name, group in self._groups.items():
            group["lr"] = group["base"] * factor * (means_factor if name == "means" else 1.0)
            parameter = group["params"][0]
            gradient, parameter.grad = parameter.grad, None
            if gradient is None or name in frozen or (name != ENVIRONMENT and not geometry):
                continue
            state = self._adam.state[parameter]
            if not state:
                state["step"] = torch.zeros(())
                state.update({moment: torch.zeros_like(parameter) for moment in MOMENTS})
            state["step"] += 1
            mean, square = (state[moment] for moment in MOMENTS)
            bounds = {ENVIRONMENT: environment_bounds, "albedo": NOT_NEGATIVE}.get(name, UNBOUNDED)
            tensors.append(
                AdamTensor(parameter.detach(), gradient, mean, square, group["lr"], int(state["step"]), bounds)
            )
        adam_step(tensors, self._betas, EPSILON)

    def edit_surfels(self, surfels: Surfels, source: Tensor, keep_moments: Tensor) -> None:
        """Take `surfels`; row i inherits the moments of old row `source[i]` where `keep_moments[i]`, else zeros."""
        for name, value in surfels.named().items():
            state = self._adam.state.get(self._groups[name]["params"][0], {})
            moments = {
                key: state[key][source] * keep_moments.view(-1, *[1] * (value.dim() - 1)).to(value.dtype)
                for key in MOMENTS
                if key in state
            }
            self._replace(name, value, {"step": state["step"], **moments} if moments else None)
        self._index()

    def set_values(self, surfels: Surfels) -> None:
        """Take the values of as many surfels. Parameters that change restart their moments, the others keep them."""
        for name, value in surfels.named().items():
            parameter = self._groups[name]["params"][0]
            if not torch.equal(value, parameter):
                state = self._adam.state.get(parameter)
                restarted = state and {"step": state["step"], **{key: torch.zeros_like(value) for key in MOMENTS}}
                self._replace(name, value, restarted)
        self._index()

    def _replace(self, name: str, value: Tensor, state: dict[str, Tensor] | None) -> None:
        group = self._groups[name]
        self._adam.state.pop(group["params"][0], None)
        leaf = value.detach().clone().requires_grad_(group["params"][0].requires_grad)
        group["params"] = [leaf]
        if state:
            self._adam.state[leaf] = state

    def state_dict(self) -> dict[str, Any]:
        """Moments and step counts, for a checkpoint."""
        return self._adam.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` gave."""
        self._adam.load_state_dict(state)
        self._index()
