"""A few steps of a fit with the Triton kernels end where the CPU's kernels end."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from panoless.environment import solve as cubemap
from panoless.kernels import backend
from panoless.reconstruct.fit import fit
from shinypartial.dataset.schema import Dataset
from tests.support.mirror_sphere import tiny_config

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


@pytest.mark.slow
@pytest.mark.parametrize("preset", [pytest.param("default", marks=pytest.mark.slow), "paper"])
def test_a_fit_ends_as_on_the_cpu(
    preset: str, tmp_path: Path, sphere_dataset: Dataset, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = replace(sphere_dataset, train=sphere_dataset.train[:2])
    config = tiny_config(preset, iterations=2, count=30)
    config = replace(
        config,
        splats=replace(
            config.splats,
            density=replace(config.splats.density, enabled=False),
        ),
        model="surfels",
        first_surface=replace(config.first_surface, hull_resolution=16),
        downscale=2,
        environment=replace(config.environment, resolution=8, solve_resolution=8, warmup=0.0),
    )
    monkeypatch.setattr(cubemap, "ROBUST_SCALES", (None,))
    monkeypatch.setattr(cubemap, "REFINING_SCALES", (0.05,))
    expected = fit(dataset, config, tmp_path / "cpu")
    monkeypatch.setattr(backend, "_fastest", lambda dtype, _: "gpu" if dtype == torch.float32 else "reference")
    found = fit(dataset, config, tmp_path / "gpu", device=device)
    surfels = found.geometry.state_dict()["surfels"]
    for name, value in expected.geometry.state_dict()["surfels"].items():
        # Adam's first steps go by the sign of a gradient: a handful of numbers with gradients near zero may differ by
        # whole steps, all others by rounding.
        apart = (surfels[name] - value).abs() > 1e-4 * value.abs().max() + 1e-6
        assert apart.float().mean() < 0.05, name
    torch.testing.assert_close(found.environment, expected.environment, rtol=0, atol=0.02)
    for name, series in expected.curves.items():
        assert found.curves[name] == pytest.approx(series, rel=1e-4), name
