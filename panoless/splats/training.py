"""What steps of gradient descent need to continue, and their listeners."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.splats.mirror import SurfelMirror


@dataclass
class Training:
    """What a fit of surfels needs to continue. `iteration` counts finished steps.

    `environment` is the map as the optimizer holds it; `evidence` is what online visibility has accumulated.
    """

    environment: Float[Tensor, "6 3 L L"]
    evidence: Float[Tensor, "6 L L"]
    iteration: int = 0
    optimizer: dict[str, Any] = field(default_factory=dict)

    def to(self, device: torch.device) -> "Training":
        """The same on a device; the optimizer's part follows its parameters when it is loaded."""
        return Training(self.environment.to(device), self.evidence.to(device), self.iteration, self.optimizer)


@runtime_checkable
class TrainingObserver(Protocol):
    """Listeners to the steps of a fit."""

    title: str
    """What the progress is called."""

    def after_step(self, iteration: int, seconds: float, current: Callable[[], tuple[SurfelMirror, Training]]) -> None:
        """That many steps are finished, the last in so many seconds; `current` gives the state after it."""
        ...

    def record(self, point: dict[str, float]) -> None:
        """Values of the curves at one iteration."""
        ...
