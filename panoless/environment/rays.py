"""Rays: what was seen of the environment, in which direction, and how far it is to be trusted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor


class Weighted:
    """What saw radiance and is weighted beforehand as far as its trust says."""

    radiance: Float[Tensor, "P 3"]
    trust: Float[Tensor, "P"] | None

    def initial_weight(self) -> Float[Tensor, "P"]:
        """The trust, or ones."""
        return torch.ones_like(self.radiance[:, 0]) if self.trust is None else self.trust.clone()

    def reaches(self, level: Float[Tensor, "3"]) -> Bool[Tensor, "P"]:
        """Whether each saw that radiance or more in some channel."""
        return (self.radiance >= level.to(self.radiance)).any(1)


@dataclass(frozen=True)
class Rays(Weighted):
    """Observations of the environment: unit world directions and the linear radiance seen along them.

    `trust` says how far each is weighted beforehand, in [0, 1]; None: all alike. `incoming` are the unit world
    directions of the cameras' rays, which determine the angles at which these met the mirror; None: not needed.
    """

    directions: Float[Tensor, "P 3"]
    radiance: Float[Tensor, "P 3"]
    trust: Float[Tensor, "P"] | None = None
    incoming: Float[Tensor, "P 3"] | None = None

    def every(self, stride: int, first: int) -> "Rays":
        """Every stride-th ray from the first."""
        return self.kept(slice(first, None, stride))

    def kept(self, part: slice | Bool[Tensor, "P"]) -> "Rays":
        """Those of the rays."""
        trust, incoming = (None if each is None else each[part] for each in (self.trust, self.incoming))
        return Rays(self.directions[part], self.radiance[part], trust, incoming)


def joined_rays(parts: Sequence[Rays]) -> Rays:
    """All rays in one, trusted as they are; all of them know where they came from, or none does."""
    incoming = [part.incoming for part in parts if part.incoming is not None]
    return Rays(
        torch.cat([part.directions for part in parts]),
        torch.cat([part.radiance for part in parts]),
        torch.cat([part.initial_weight() for part in parts]),
        torch.cat(incoming) if incoming else None,
    )


def normalize_confidence(rays: Sequence[Rays]) -> list[Rays]:
    """The same rays with their trust in units of its mean.

    The map's fill of gaps and its pull toward a start count in rays: if all are hardly trusted, these would outvote
    them where only the least trusted see.
    """
    total = sum(float(batch.initial_weight().sum()) for batch in rays)
    mean = total / max(sum(len(batch.directions) for batch in rays), 1)
    if mean <= 0:
        return list(rays)
    return [replace(batch, trust=batch.initial_weight() / mean) for batch in rays]
