"""Density control: what is cloned, split, pruned and reset, and what happens to the optimizer's moments."""

import math
from dataclasses import replace

import pytest
import torch

from panoless.splats.density import (
    PROPAGATED_OPACITY,
    PROPAGATION_GROWTH,
    RESET_OPACITY,
    DensityStatistics,
    Edit,
    grow_and_prune,
    propagate_normals,
    reset_opacities,
)
from panoless.splats.descent import Rates
from panoless.splats.kernels.reference.rasterize import rotation_matrices
from panoless.splats.model import Surfels
from panoless.splats.optimizer import SurfelOptimizer
from tests.support.mirror_sphere import sphere_surfels

COUNT, LEAST_OPACITY = 10, 0.1
UNIT = 5.0
"""Surfels larger than 0.05 are dense in a scene of this radius, and those larger than 0.5 too large."""


def grow(surfels: Surfels, means: list[float], most: int = 100_000, seed: int = 0) -> Edit:
    """One round, given the mean gradient of each surfel."""
    statistics = DensityStatistics(torch.tensor(means) * 4, torch.full((len(means),), 4.0))
    generator = torch.Generator().manual_seed(seed)
    return grow_and_prune(
        surfels,
        statistics,
        generator,
        max_surfels=most,
        least_opacity=LEAST_OPACITY,
        unit=UNIT,
        threshold=1e-3,
    )


def sized(scales: list[float]) -> Surfels:
    surfels = sphere_surfels(len(scales))
    return replace(surfels, log_scales=torch.tensor(scales).log()[:, None].expand(-1, 2).clone())


HIGH, LOW = 2e-3, 5e-4


def test_small_surfels_are_cloned_and_large_ones_split() -> None:
    surfels = sized([0.01, 0.2, 0.01, 0.2])
    edit = grow(surfels, [HIGH, HIGH, LOW, LOW])
    # Old 0, 2 and 3 stay, 0 is cloned, 1 is replaced by two.
    assert edit.source.tolist() == [0, 2, 3, 0, 1, 1]
    assert edit.unchanged.tolist() == [True] * 3 + [False] * 3
    for name, value in edit.surfels.named().items():
        assert torch.equal(value[:4], surfels.named()[name][edit.source[:4]]), name
    torch.testing.assert_close(edit.surfels.scales[4:], torch.full((2, 2), 0.2 / 1.6))


def test_children_are_drawn_from_their_parent() -> None:
    surfels = replace(sized([0.2] * 400))
    surfels = replace(surfels, log_scales=torch.tensor([0.2, 0.05]).log().expand(400, 2).clone())
    edit = grow(surfels, [HIGH] * 400)
    assert edit.surfels.count == 800
    parents = surfels.select(edit.source)
    frames = rotation_matrices(parents.quats)
    local = torch.einsum("kij,ki->kj", frames, edit.surfels.means - parents.means)
    assert float(local[:, 2].abs().max()) < 1e-5
    in_sigmas = local[:, :2] / parents.scales
    assert float(in_sigmas.abs().max()) < 5
    # 800 draws of a unit normal: mean ± 0.035, deviation ± 0.025.
    torch.testing.assert_close(in_sigmas.mean(0), torch.zeros(2), rtol=0, atol=0.14)
    torch.testing.assert_close(in_sigmas.std(0), torch.ones(2), rtol=0, atol=0.1)


def test_faint_and_huge_surfels_are_removed() -> None:
    surfels = sized([0.01, 0.01, 0.6, 0.01])
    logits = torch.tensor([4.0, math.log(0.05 / 0.95), 4.0, math.log(0.15 / 0.85)])
    edit = grow(replace(surfels, opacity_logits=logits), [LOW] * 4)
    assert edit.source.tolist() == [0, 3]


def test_only_what_is_below_the_threshold_is_faint() -> None:
    logit = math.log(LEAST_OPACITY / (1 - LEAST_OPACITY))
    surfels = sized([0.01] * 2)
    logits = torch.tensor([logit, logit - 1e-3])
    assert grow(replace(surfels, opacity_logits=logits), [LOW] * 2).source.tolist() == [0]


def test_the_set_never_becomes_empty() -> None:
    surfels = replace(sized([0.01] * 3), opacity_logits=torch.tensor([-5.0, -4.0, -6.0]))
    assert grow(surfels, [LOW] * 3).source.tolist() == [1]


@pytest.mark.parametrize("limit", [3, 8, 10, 11, 13, 100])
@pytest.mark.parametrize("size", [0.01, 0.2])
def test_growth_stops_at_the_limit(limit: int, size: float) -> None:
    edit = grow(sized([size] * COUNT), [HIGH] * COUNT, limit)
    assert edit.surfels.count == min(2 * COUNT, max(limit, COUNT))


def test_rounds_are_reproducible() -> None:
    first, again, other = (grow(sized([0.2] * 5), [HIGH] * 5, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(first.surfels.means, again.surfels.means)
    assert not torch.equal(first.surfels.means, other.surfels.means)


def test_the_mean_gradient_counts_visible_steps_only() -> None:
    statistics = DensityStatistics.empty(3)
    gradient = torch.tensor([[3.0, 4.0], [3.0, 4.0], [0.0, 0.0]])
    statistics.observe(gradient, torch.tensor([True, False, True]), image_width=20)
    statistics.observe(torch.zeros(3, 2), torch.tensor([True, False, True]), image_width=20)
    # |(3, 4)| = 5 pixels, times half the width of 20, over two steps.
    assert statistics.mean.tolist() == [25.0, 0.0, 0.0]


def test_a_reset_only_lowers_opacities() -> None:
    surfels = replace(sphere_surfels(3), opacity_logits=torch.tensor([5.0, 0.0, -9.0]))
    after = reset_opacities(surfels)
    torch.testing.assert_close(after.opacities[:2], torch.full((2,), RESET_OPACITY))
    assert after.opacity_logits[2] == -9.0
    changed = {name for name, value in after.named().items() if not torch.equal(value, surfels.named()[name])}
    assert changed == {"opacity_logits"}


def test_propagation_only_raises_opacity_and_size() -> None:
    surfels = replace(sphere_surfels(3), opacity_logits=torch.tensor([5.0, 0.0, -9.0]))
    after = propagate_normals(surfels)
    assert after.opacity_logits[0] == 5.0
    torch.testing.assert_close(after.opacities[1:], torch.full((2,), PROPAGATED_OPACITY))
    torch.testing.assert_close(after.scales, PROPAGATION_GROWTH * surfels.scales)
    changed = {name for name, value in after.named().items() if not torch.equal(value, surfels.named()[name])}
    assert changed == {"opacity_logits", "log_scales"}


def stepped(count: int) -> SurfelOptimizer:
    """An optimizer whose moments differ in every row."""
    optimizer = SurfelOptimizer(sphere_surfels(count), torch.rand(6, 3, 4, 4), Rates())
    for _ in range(3):
        loss = sum(
            (value * torch.arange(1.0, count + 1).view(-1, *[1] * (value.dim() - 1))).square().sum()
            for value in optimizer.surfels.named().values()
        )
        loss.backward()
        optimizer.step(1.0, geometry=True, frozen=frozenset())
    return optimizer


def moments(optimizer: SurfelOptimizer) -> dict[int, dict[str, torch.Tensor]]:
    return optimizer.state_dict()["state"]


def test_kept_rows_keep_their_moments_and_new_rows_start_from_zero() -> None:
    optimizer = stepped(5)
    before = moments(optimizer)
    source, unchanged = torch.tensor([4, 0, 0, 2]), torch.tensor([True, True, False, False])
    optimizer.edit_surfels(optimizer.surfels.detached().select(source), source, unchanged)
    after = moments(optimizer)
    assert set(after) == set(before)
    for index, state in after.items():
        for key in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(state[key][:2], before[index][key][source[:2]])
            assert not state[key][2:].any()
        assert state["step"] == before[index]["step"] == 3
    assert optimizer.surfels.count == 4
    assert all(value.is_leaf and value.requires_grad for value in optimizer.surfels.named().values())


def test_an_edit_before_the_first_step_is_an_edit() -> None:
    optimizer = SurfelOptimizer(sphere_surfels(5), torch.rand(6, 3, 4, 4), Rates())
    index = torch.tensor([1, 1])
    optimizer.edit_surfels(optimizer.surfels.select(index), index, torch.tensor([True, False]))
    assert optimizer.surfels.count == 2
    assert moments(optimizer) == {}


def test_faint_surfels_survive_a_round_that_does_not_prune_them() -> None:
    surfels = replace(sized([0.01, 0.6]), opacity_logits=torch.tensor([-8.0, 4.0]))
    statistics = DensityStatistics.empty(2)
    edit = grow_and_prune(surfels, statistics, torch.Generator(), max_surfels=COUNT, least_opacity=0.0, unit=UNIT)
    assert edit.source.tolist() == [0]
