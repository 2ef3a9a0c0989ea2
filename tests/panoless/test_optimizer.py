"""The optimizer: what moves, how far, and that a restored one takes the same next step."""

import copy

import pytest
import torch

from panoless.config import RateConfig
from panoless.optimizer import SurfelOptimizer
from tests.support.mirror_sphere import sphere_surfels

RATES = RateConfig()


def make() -> SurfelOptimizer:
    environment = torch.rand(6, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    return SurfelOptimizer(sphere_surfels(5), environment, RATES)


def pull(optimizer: SurfelOptimizer, strength: float = 1.0) -> None:
    """Give every parameter a gradient."""
    values = [*optimizer.surfels.named().values(), optimizer.environment]
    sum((value - 10).square().sum() * strength for value in values).backward()


def snapshot(optimizer: SurfelOptimizer) -> dict[str, torch.Tensor]:
    named = {**optimizer.surfels.named(), "environment": optimizer.environment}
    return {name: value.detach().clone() for name, value in named.items()}


def moved(optimizer: SurfelOptimizer, before: dict[str, torch.Tensor]) -> set[str]:
    return {name for name, value in snapshot(optimizer).items() if not torch.equal(value, before[name])}


def test_without_geometry_only_the_environment_moves() -> None:
    optimizer = make()
    before = snapshot(optimizer)
    pull(optimizer)
    optimizer.step(1.0, geometry=False, frozen=frozenset())
    assert moved(optimizer, before) == {"environment"}


def test_frozen_parameters_do_not_move() -> None:
    optimizer, frozen = make(), frozenset({"albedo", "roughness_logits"})
    before = snapshot(optimizer)
    for _ in range(3):
        pull(optimizer)
        optimizer.step(1.0, geometry=True, frozen=frozen)
    assert moved(optimizer, before) == set(before) - frozen


@pytest.mark.parametrize("factor", [1.0, 0.3])
def test_the_first_step_is_the_rate_times_the_factor(factor: float) -> None:
    """Adam's first step has the length of its rate, whatever the gradient."""
    optimizer = make()
    before = snapshot(optimizer)
    pull(optimizer, strength=1e3)
    optimizer.step(factor, geometry=True, frozen=frozenset())
    for name, value in snapshot(optimizer).items():
        step = value - before[name]
        torch.testing.assert_close(step, torch.full_like(step, factor * getattr(RATES, name)), rtol=0.02, atol=1e-6)


def test_gradients_do_not_pile_up() -> None:
    optimizer = make()
    pull(optimizer)
    optimizer.step(1.0, geometry=False, frozen=frozenset())
    assert all(value.grad is None for value in optimizer.surfels.named().values())
    assert optimizer.environment.grad is None


def test_a_restored_optimizer_takes_the_same_step() -> None:
    first = make()
    for _ in range(4):
        pull(first)
        first.step(1.0, geometry=True, frozen=frozenset({"albedo"}))
    second = SurfelOptimizer(first.surfels.detached(), first.environment.detach(), RATES)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    for optimizer in (first, second):
        pull(optimizer)
        optimizer.step(0.5, geometry=True, frozen=frozenset({"albedo"}))
    for name, value in snapshot(first).items():
        assert torch.equal(value, snapshot(second)[name]), name
