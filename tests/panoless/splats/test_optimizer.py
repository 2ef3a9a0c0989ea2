"""The optimizer: what moves, how far, and that a restored one takes the same next step."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from panoless.splats.descent import Rates
from panoless.splats.kernels.adam import AdamTensor, adam_step
from panoless.splats.optimizer import EPSILON, MOMENTUM, SurfelOptimizer
from tests.support.mirror_sphere import sphere_surfels

RATES = Rates()
BETAS = (MOMENTUM, RATES.square_memory)


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
        torch.testing.assert_close(step, torch.full_like(step, factor * RATES.by_name[name]), rtol=0.02, atol=1e-6)


@pytest.mark.parametrize("square_memory", [0.9, 0.99, 0.999])
def test_a_restarted_moment_steps_farther_the_longer_squares_are_remembered(square_memory: float) -> None:
    """Long after the start, when no bias is corrected any more, the first step is (1 − β₁)/√(1 − β₂) rates long.

    So with 0.999 opacities come back from a reset three times as fast as with 0.99.
    """
    rates = replace(RATES, square_memory=square_memory)
    optimizer = SurfelOptimizer(sphere_surfels(5), torch.rand(6, 3, 4, 4), rates)
    pull(optimizer)
    optimizer.step(1.0, geometry=True, frozen=frozenset())
    for state in optimizer.state_dict()["state"].values():
        state["step"].fill_(1e6)
    surfels = optimizer.surfels.detached()
    reset = replace(surfels, opacity_logits=surfels.opacity_logits - 3)
    optimizer.set_values(reset)
    pull(optimizer)
    optimizer.step(1.0, geometry=True, frozen=frozenset())
    step = optimizer.surfels.opacity_logits - reset.opacity_logits
    expected = rates.by_name["opacity_logits"] * (1 - MOMENTUM) / math.sqrt(1 - square_memory)
    torch.testing.assert_close(step, torch.full_like(step, expected), rtol=1e-3, atol=1e-6)


def test_only_the_means_take_the_factor_of_the_means() -> None:
    optimizer = make()
    before = snapshot(optimizer)
    pull(optimizer)
    optimizer.step(1.0, geometry=True, frozen=frozenset(), means_factor=0.25)
    for name, value in snapshot(optimizer).items():
        factor = 0.25 if name == "means" else 1.0
        step = value - before[name]
        torch.testing.assert_close(step, torch.full_like(step, factor * RATES.by_name[name]), rtol=0.02, atol=1e-6)


def test_values_that_stay_keep_their_moments_and_others_restart() -> None:
    optimizer = make()
    for _ in range(3):
        pull(optimizer)
        optimizer.step(1.0, geometry=True, frozen=frozenset({"albedo"}))
    before = copy.deepcopy(optimizer.state_dict()["state"])
    surfels = optimizer.surfels.detached()
    optimizer.set_values(replace(surfels, opacity_logits=surfels.opacity_logits - 3))
    assert torch.equal(optimizer.surfels.opacity_logits, surfels.opacity_logits - 3)
    for name, state in optimizer.state_dict()["state"].items():
        for key in ("exp_avg", "exp_avg_sq"):
            if name == "opacity_logits":
                assert not state[key].any()
            else:
                assert torch.equal(state[key], before[name][key]), name
        assert state["step"] == 3


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


def test_checkpoints_with_numbered_groups_are_read() -> None:
    first = make()
    pull(first)
    first.step(1.0, geometry=True, frozen=frozenset())
    named = first.state_dict()["state"]
    groups = [{"name": name} for name in named]
    second = SurfelOptimizer(first.surfels.detached(), first.environment.detach(), RATES)
    second.load_state_dict({"state": dict(enumerate(named.values())), "param_groups": groups})
    for optimizer in (first, second):
        pull(optimizer)
        optimizer.step(0.5, geometry=True, frozen=frozenset())
    for name, value in snapshot(first).items():
        assert torch.equal(value, snapshot(second)[name]), name


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_steps_are_those_of_torch(backend: str) -> None:
    """Tensors of several sizes and rates, gradients over many decades, against `torch.optim.Adam`."""
    generator = torch.Generator().manual_seed(0)
    rates, shapes = (0.1, 1e-3, 1.0), ((7,), (40_000,), (3, 5, 2))
    values = [torch.randn(shape, generator=generator) for shape in shapes]
    leaves = [value.clone().requires_grad_() for value in values]
    groups = [{"params": [leaf], "lr": rate} for leaf, rate in zip(leaves, rates, strict=True)]
    expected = torch.optim.Adam(groups, betas=BETAS, eps=EPSILON)
    moments = [(torch.zeros_like(value), torch.zeros_like(value)) for value in values]
    for step in range(1, 6):
        gradients = [
            torch.randn(s, generator=generator) * 10.0 ** torch.randint(-9, 3, s, generator=generator) for s in shapes
        ]
        for leaf, gradient in zip(leaves, gradients, strict=True):
            leaf.grad = gradient.clone()
        expected.step()
        columns = zip(values, gradients, moments, rates, strict=True)
        tensors = [AdamTensor(value, gradient, *pair, rate, step) for value, gradient, pair, rate in columns]
        adam_step(tensors, BETAS, EPSILON, backend=backend)
        for value, leaf in zip(values, leaves, strict=True):
            torch.testing.assert_close(value, leaf.detach(), rtol=1e-5, atol=1e-6)
