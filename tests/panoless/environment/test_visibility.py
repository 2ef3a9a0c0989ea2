"""Visibility: evidence is conserved, and its map to [0, 1] is zero exactly where nothing was seen."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn.functional import normalize

from panoless.environment.rays import Rays
from panoless.environment.visibility import accumulate, agreement, visibility_from_agreement, visibility_from_evidence
from panoless.kernels.cubemap import cubemap_directions, cubemap_solid_angles, sample_cubemap

LENGTH = 8


def rays(seed: int, count: int = 300) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions in a half space, and alphas."""
    generator = torch.Generator().manual_seed(seed)
    directions = normalize(torch.randn(count, 3, generator=generator), dim=1)
    directions[:, 0].abs_()
    return directions, torch.rand(count, generator=generator)


@given(st.integers(0, 1000), st.floats(0.0, 0.9))
def test_evidence_is_the_sum_of_the_alphas_above_the_threshold(seed: int, threshold: float) -> None:
    directions, alpha = rays(seed)
    evidence = torch.zeros(6, LENGTH, LENGTH)
    accumulate(evidence, directions, alpha, threshold)
    kept = alpha[alpha > threshold].sum()
    # Sums of a few hundred single-precision numbers.
    assert float(evidence.sum()) == pytest.approx(float(kept), rel=1e-5, abs=1e-6)


def test_the_threshold_itself_is_left_out() -> None:
    evidence = torch.zeros(6, LENGTH, LENGTH)
    directions = normalize(torch.randn(3, 3), dim=1)
    accumulate(evidence, directions, torch.tensor([0.5, 0.5, 0.2]), 0.5)
    assert float(evidence.abs().max()) == 0.0


def test_evidence_adds_up() -> None:
    directions, alpha = rays(0)
    whole, parts = torch.zeros(6, LENGTH, LENGTH), torch.zeros(6, LENGTH, LENGTH)
    accumulate(whole, directions, alpha, 0.0)
    for piece in (slice(0, 100), slice(100, None)):
        accumulate(parts, directions[piece], alpha[piece], 0.0)
    torch.testing.assert_close(whole, parts)


@given(st.integers(0, 1000))
def test_visibility_is_zero_exactly_where_no_ray_fell(seed: int) -> None:
    directions, alpha = rays(seed, 60)
    evidence = torch.zeros(6, LENGTH, LENGTH)
    accumulate(evidence, directions, alpha, 0.0)
    visibility = visibility_from_evidence(evidence)
    assert float(visibility.min()) >= 0.0
    assert float(visibility.max()) == 1.0
    assert torch.equal(visibility > 0, evidence > 0)


def test_more_evidence_is_never_less_visible() -> None:
    """Compared among the six faces, because texels in the same place of a face have the same solid angle."""
    evidence = torch.rand(6, LENGTH, LENGTH, generator=torch.Generator().manual_seed(0)) * 10
    order = evidence.argsort(0)
    visibility = visibility_from_evidence(evidence).gather(0, order)
    assert (visibility.diff(dim=0) >= 0).all()
    below_saturation = visibility[1:] < 1
    assert below_saturation.float().mean() > 0.8
    assert (visibility.diff(dim=0)[below_saturation] > 0).all()


def test_equal_density_is_equally_visible() -> None:
    """Rays that come evenly from everywhere put less on the small texels at a corner; visibility corrects that."""
    fine = cubemap_directions(256).reshape(-1, 3)
    weight = cubemap_solid_angles(256).expand(6, -1, -1).reshape(-1)
    evidence = torch.zeros(6, LENGTH, LENGTH)
    accumulate(evidence, fine, 1000 * weight, 0.0)
    assert float(evidence.max() / evidence.min()) > 2
    inner = visibility_from_evidence(evidence)
    # Bilinear weights smear the solid angle by a few percent; the logarithm leaves less.
    assert float(inner.min()) > 0.95


def test_nothing_seen_is_nowhere_visible() -> None:
    assert float(visibility_from_evidence(torch.zeros(6, LENGTH, LENGTH)).abs().max()) == 0.0


def agreeing_rays(noise: float) -> tuple[Rays, torch.Tensor]:
    """Rays in a half space that see a constant map, with noise where x > y."""
    directions, _ = rays(3, 4000)
    radiance = torch.full((len(directions), 3), 0.4)
    noisy = directions[:, 0] > directions[:, 1]
    radiance[noisy] += noise * torch.randn(int(noisy.sum()), 3, generator=torch.Generator().manual_seed(1))
    return Rays(directions, radiance), torch.full((6, 3, LENGTH, LENGTH), 0.4)


def test_confidence_lies_in_the_unit_interval_and_is_zero_exactly_where_no_ray_fell() -> None:
    batch, environment = agreeing_rays(0.02)
    found = agreement([batch], environment)
    confidence = visibility_from_agreement(found)
    assert float(confidence.min()) >= 0.0
    assert float(confidence.max()) < 1.0
    assert torch.equal(confidence > 0, found.votes > 0)


def test_directions_in_which_rays_disagree_are_trusted_less() -> None:
    batch, environment = agreeing_rays(0.05)
    confidence = visibility_from_agreement(agreement([batch], environment))
    directions = cubemap_directions(LENGTH)
    inside = directions[..., 0] > 0.3
    noisy = inside & (directions[..., 0] > directions[..., 1] + 0.3)
    quiet = inside & (directions[..., 0] < directions[..., 1] - 0.3)
    assert float(confidence[noisy].max()) < float(confidence[quiet].median())


def test_more_votes_are_never_trusted_less() -> None:
    batch, environment = agreeing_rays(0.0)
    once = visibility_from_agreement(agreement([batch], environment))
    twice = visibility_from_agreement(agreement([batch, batch], environment))
    assert bool((twice >= once).all())
    assert bool((twice > once)[once > 0].all())


def test_rays_split_into_batches_say_the_same() -> None:
    batch, environment = agreeing_rays(0.05)
    halves = [Rays(batch.directions[half::2], batch.radiance[half::2]) for half in (0, 1)]
    whole, split = agreement([batch], environment), agreement(halves, environment)
    torch.testing.assert_close(split.votes, whole.votes, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(split.disagreement, whole.disagreement, rtol=1e-4, atol=1e-5)


def test_directions_beside_an_edge_of_the_map_are_trusted_less() -> None:
    """The rays agree with a step in the map as well as with what is even; a small shift would be wrong there alone."""
    batch, environment = agreeing_rays(0.0)
    environment[:, :, :, LENGTH // 2 :] = 0.8
    seen = replace(batch, radiance=sample_cubemap(environment, batch.directions))
    confidence = visibility_from_agreement(agreement([seen], environment))
    column = confidence.amax((0, 1))
    assert float(column[LENGTH // 2 - 1 : LENGTH // 2 + 1].max()) < 0.5 * float(column[1])


def test_rays_that_the_others_outvote_lower_the_confidence() -> None:
    """The disagreement of those that agree is the same; what part they are of all is not."""
    batch, environment = agreeing_rays(0.0)
    wrong = replace(batch, radiance=batch.radiance + 0.5)
    alone, disputed = (visibility_from_agreement(agreement(rays, environment)) for rays in ([batch], [batch, wrong]))
    seen = alone > 0
    assert bool((disputed[seen] < 0.6 * alone[seen]).all())


def test_a_map_brighter_than_rays_can_show_agrees_with_them() -> None:
    """Rays end at 1. What lies above says nothing against a map: not by votes, nor by disagreement, nor by contrast."""
    batch, environment = agreeing_rays(0.0)
    clipped = replace(batch, radiance=torch.ones_like(batch.radiance))
    environment[:] = 1.0
    brighter = environment + torch.rand(environment.shape, generator=torch.Generator().manual_seed(2))
    ended, bright = (agreement([clipped], each, torch.ones(3)) for each in (environment, brighter))
    for name in vars(ended):
        # The four weights of a look-up add up to one but for rounding, which differs between processors.
        torch.testing.assert_close(getattr(bright, name), getattr(ended, name), atol=1e-6, rtol=0)
    assert float(agreement([clipped], brighter).disagreement.max()) > 0.1
