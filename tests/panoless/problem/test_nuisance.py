"""What every block of unknowns keeps to, and the decision which of them are needed."""

from dataclasses import replace

import numpy as np
import pytest

from panoless.environment.surroundings import Floor, Surroundings
from panoless.problem.blocks import BLOCKS, Block, FocalLength, Lens
from panoless.problem.corrected import Corrected
from panoless.problem.evidence import decided
from panoless.problem.nuisance import Nuisance, nuisance_of
from panoless.problem.rays import PixelRays
from panoless.problem.rows import BlockRows
from tests.support.mirror_body import body_views, sphere

VIEWS = 6


@pytest.fixture(scope="module")
def nuisance() -> Nuisance:
    """Every block at its prior."""
    around = Surroundings(np.zeros(1), Floor(np.array([0.0, 0.0, 1.0]), 1.2, 4.0))
    return nuisance_of(body_views(sphere(), VIEWS, 16), around=around)


def rays(count: int = 40) -> tuple[PixelRays, np.ndarray]:
    """Rays from all around toward the origin, and the optical axes of their cameras."""
    rng = np.random.default_rng(0)
    origins = 3 * rng.normal(size=(count, 3))
    axes = -origins / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = axes + 0.1 * rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    view = np.arange(count) % VIEWS
    return PixelRays(origins, directions, np.zeros((count, 2, 3)), np.full(count, 1e-3), view), axes


@pytest.mark.parametrize("kind", BLOCKS, ids=[kind.name for kind in BLOCKS])
def test_a_block_moves_rays_and_gains_as_its_derivatives_state(kind: type[Block], nuisance: Nuisance) -> None:
    """(ω, τ): directions change by ω × d and origins by τ, and log gains by their rows."""
    block, (seen, axes) = nuisance.get(kind), rays()
    assert block is not None
    step = 1e-6 * np.random.default_rng(1).normal(size=block.values.shape)
    step -= step.mean(0) if block.by_view and block.size < 6 else 0
    ahead, behind = (block.stepped(sign * step) for sign in (1, -1))
    own = step[seen.view] if block.by_view else np.broadcast_to(step[0], (len(seen.size), block.size))
    motions = block.motions(seen, axes)
    moved = np.zeros((len(seen.size), 6)) if motions is None else np.einsum("pim,pm->pi", motions, own)
    there, back = (each.moved(seen, axes) for each in (ahead, behind))
    turned = np.cross(moved[:, :3], seen.directions)
    np.testing.assert_allclose((there.directions - back.directions) / 2, turned, atol=1e-11)
    np.testing.assert_allclose((there.origins - back.origins) / 2, moved[:, 3:], atol=1e-11)
    rows, gains = block.gain_rows(), ahead.log_gains()
    assert (rows is None) == (gains is None)
    if rows is not None:
        np.testing.assert_allclose(gains, step @ rows.T, atol=1e-12)


@pytest.mark.parametrize("kind", BLOCKS, ids=[kind.name for kind in BLOCKS])
def test_a_block_costs_nothing_at_its_prior_and_half_a_square_a_deviation_beside(
    kind: type[Block], nuisance: Nuisance
) -> None:
    block = nuisance.get(kind)
    assert block is not None
    assert Nuisance((block,)).prior_cost == 0
    sigmas = np.sqrt(np.linalg.inv(block.precision)[:, 0, 0])
    off = np.zeros_like(block.values)
    off[:, 0] = sigmas
    assert Nuisance((replace(block, values=off),)).prior_cost == pytest.approx(len(off) / 2)


def test_views_of_a_block_come_back_in_their_order(nuisance: Nuisance) -> None:
    rng = np.random.default_rng(2)
    for block in nuisance.blocks:
        if block.by_view:
            whole = replace(block, values=rng.normal(size=block.values.shape))
            parts = [Nuisance((whole,)).of_views(part).blocks[0] for part in ([0, 2, 5], [1, 3, 4])]
            again = parts[0].joined(parts[1], np.argsort([0, 2, 5, 1, 3, 4]))
            np.testing.assert_array_equal(again.values, whole.values)


def test_rows_and_their_adjoint_agree_with_a_dense_matrix() -> None:
    """Runs of a block may lie apart."""
    rng = np.random.default_rng(3)
    block = np.repeat([0, 2, 1, 0], [3, 4, 2, 5])
    rows = BlockRows(block, rng.normal(size=(14, 2, 3)), rng.uniform(0.1, 1, 14))
    dense = np.zeros((28, 9))
    for index, of in enumerate(block):
        dense[2 * index : 2 * index + 2, 3 * of : 3 * of + 3] = rows.rows[index]
    change, residual = rng.normal(size=(3, 3)), rng.normal(size=(14, 2))
    weights = np.repeat(rows.weights, 2)
    np.testing.assert_allclose(rows.forward(change).ravel(), dense @ change.ravel())
    np.testing.assert_allclose(rows.backward(residual, 3).ravel(), dense.T @ (weights * residual.ravel()))
    matrix = dense.T @ (weights[:, None] * dense)
    for of, found in enumerate(rows.blocks(3)):
        np.testing.assert_allclose(found, matrix[3 * of : 3 * of + 3, 3 * of : 3 * of + 3])


@pytest.mark.parametrize("kind", BLOCKS, ids=[kind.name for kind in BLOCKS])
def test_a_block_is_needed_where_its_values_exceed_their_noise(kind: type[Block], nuisance: Nuisance) -> None:
    """Of a hundred of noise at most three, of those five times as large nearly all, or half of single numbers."""
    block, rng = nuisance.get(kind), np.random.default_rng(4)
    assert block is not None
    sigmas = 0.002 * rng.uniform(0.5, 2.0, block.values.shape)
    kept = {1: 0, 5: 0}
    for factor in kept:
        for _ in range(100):
            values = factor * sigmas * rng.normal(size=sigmas.shape)
            of = replace(block, values=values * np.sqrt(1 + (block.floor / sigmas) ** 2))
            kept[factor] += decided(of, sigmas**2).kept
    assert kept[1] <= 3
    assert kept[5] >= {1: 40, 3: 85}.get(block.values.size, 97)


@pytest.mark.parametrize("kind", [kind for kind in BLOCKS if issubclass(kind, Lens)], ids=lambda kind: kind.name)
def test_no_lens_explains_what_lenses_are_not_made_as(kind: type[Lens], nuisance: Nuisance) -> None:
    block, variances = nuisance.get(kind), np.full((1, 1), 1e-8)
    assert block is not None
    for deviations, kept in ((4.0, True), (6.0, False)):
        of = replace(block, values=np.full((1, 1), deviations * kind.sigma))
        assert decided(of, variances).kept is kept
        assert decided(of, variances, required=True).kept


def test_what_is_decided_is_left_out_and_what_is_required_stays(nuisance: Nuisance) -> None:
    known = {each.name: np.ones_like(each.values) for each in nuisance.blocks}
    decisions = [decided(each, known[each.name], required=each.name == "poses") for each in nuisance.blocks]
    left = nuisance.without([each.name for each in decisions if not each.kept])
    assert [each.name for each in left.blocks] == ["poses"] == list(left.free)
    assert {each.score for each in decisions} == {0.0}


def test_cameras_farther_away_are_those_of_a_smaller_world(nuisance: Nuisance) -> None:
    """eˢ times the distance and the focal length: the stated world is e⁻ˢ as large, shifts included."""
    blocks = [each.stepped(np.full_like(each.values, 0.01)) for each in nuisance.blocks]
    found = Corrected.by(
        nuisance.replaced(blocks), {name: np.full((1, 1), 1e-6) for name in ("focal length", "distortion")}
    )
    sigma = np.hypot(0.001, FocalLength.model_error)
    assert found.corrections.focal_uncertainty == pytest.approx(sigma * np.exp(0.01))
    assert found.scale == pytest.approx(np.exp(-0.01))
    assert found.corrections.focal_factor == pytest.approx(np.exp(0.01))
    assert found.poses is not None
    np.testing.assert_allclose(found.poses.shifts, 0.01 * np.exp(-0.01))
    assert found.corrections.mask_offset_px == pytest.approx(-0.01)
