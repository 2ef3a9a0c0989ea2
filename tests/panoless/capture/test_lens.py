"""A radial distortion, as its formula has it, taken back from rays and from pictures."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.lens import LensChange, undistorted_rays, undistorted_view
from panoless.capture.views import TrainView
from tests.support.distortion import distorted_view
from tests.support.mirror_plane import arc

AXES = np.tile([0.0, 0.0, 1.0], (200, 1))


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("k1", [-0.3, 0.05, 0.4])
def test_rays_come_back_from_where_the_formula_puts_them(k1: float) -> None:
    """q (1 + k₁ |q|²), by hand."""
    true = np.random.default_rng(2).uniform(-0.6, 0.6, (200, 2))
    seen = true * (1 + k1 * (true**2).sum(1, keepdims=True))
    found = undistorted_rays(unit(np.column_stack([seen, np.ones(200)])), AXES, k1)
    np.testing.assert_allclose(found[:, :2] / found[:, 2:], true, atol=1e-10)


@pytest.mark.parametrize("unknown", [LensChange(0.0), LensChange(k1=0.0)])
def test_motions_are_the_derivatives_of_rays(unknown: LensChange) -> None:
    """By central differences."""
    random = np.random.default_rng(3)
    origins, axes = random.normal(size=(200, 3)), unit(random.normal(size=(200, 3)))
    directions = unit(axes + 0.3 * random.normal(size=(200, 3)))
    motions = unknown.motions(origins, directions, axes)
    assert motions.shape == (200, 6, 1)
    name = "k1" if unknown.focal is None else "focal"
    (o1, d1), (o0, d0) = (replace(unknown, **{name: step}).rays(origins, directions, axes) for step in (1e-5, -1e-5))
    np.testing.assert_allclose((d1 - d0) / 2e-5, np.cross(motions[:, :3, 0], directions), atol=1e-8)
    np.testing.assert_allclose((o1 - o0) / 2e-5, motions[:, 3:, 0], atol=1e-8)


def smooth_view(size: int = 96) -> TrainView:
    """A disk with waves."""
    y, x = np.indices((size, size)) + 0.5 - size / 2
    waves = [0.5 + 0.4 * np.sin(0.15 * x + phase) * np.cos(0.12 * y) for phase in (0.0, 1.0, 2.0)]
    mask = np.clip(0.42 * size - np.hypot(x, y) + 0.5, 0, 1)
    planes = torch.from_numpy(np.stack([*(wave * mask for wave in waves), mask])).float()
    solid = torch.nonzero(planes[3].flatten() >= 1)[:, 0]
    camera = replace(arc(1, size=size)[0], fx=1.2 * size, fy=1.2 * size)
    return TrainView(camera, planes[:3].contiguous(), planes[3], solid)


@pytest.mark.parametrize("k1", [-0.3, 0.3])
def test_a_distorted_view_is_undistorted(k1: float) -> None:
    """Bilinear warp by the benchmark, bicubic one back; what is solid shows the object alone."""
    view = smooth_view()
    bent = distorted_view(view, k1)
    found = undistorted_view(bent, k1)
    inner = found.solid[torch.isin(found.solid, view.solid)]
    assert len(inner) > 0.95 * len(view.solid)
    left = (found.radiance_at(inner) - view.radiance_at(inner)).abs().mean()
    assert left < 0.003 < 5 * left < (bent.radiance_at(inner) - view.radiance_at(inner)).abs().mean()
    assert (found.mask - view.mask).abs().sum() < 0.4 * (bent.mask - view.mask).abs().sum()
    assert found.mask.max() <= 1


def test_nothing_is_made_up_where_nothing_bends() -> None:
    view = smooth_view()
    same = undistorted_view(view, 0.0)
    np.testing.assert_allclose(same.radiance.numpy(), view.radiance.numpy(), atol=1e-5)
    assert math.isclose(float(same.mask.sum()), float(view.mask.sum()), rel_tol=1e-5)
