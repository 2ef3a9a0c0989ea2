"""Photographs are fitted at one brightness: their common exposure changes nothing but the units of the map."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from panoless.capture import configured
from panoless.capture.configured import configured_views
from panoless.capture.contrast import BRIGHTNESS, DARK
from panoless.capture.encoding import encoding_of
from panoless.capture.views import load_views
from panoless.config import FitConfig
from panoless.presets import PRESETS
from panoless.reconstruct.fit import fit
from panoless.reconstruct.state import FitState
from panoless.selection.options import CorrectionOptions
from panoless.splats.mirror import SurfelMirror
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import BallEvidence, Dataset
from shinypartial.dataset.write import write_transforms, write_view
from tests.support.mirror_sphere import tiny_config
from tests.support.synthetic_dataset import make_sphere_dataset

UNSATURATED = 0.2
"""So exposed, the sun of the synthetic world is below 1, and photographs are dark."""


def exposed_dataset(root: Path, factor: float, train: int = 6) -> Dataset:
    """The synthetic sphere, its training views that many times as bright."""
    dataset = make_sphere_dataset(root, resolution=40, train=train, test=1)
    for frame in dataset.train:
        view = read_view(frame)
        write_view(frame, replace(view, radiance=factor * view.radiance))
    return open_dataset(root)


def test_views_are_as_bright_as_asked_however_they_were_exposed(tmp_path: Path) -> None:
    bright, dark = (exposed_dataset(tmp_path / str(factor), factor) for factor in (UNSATURATED, UNSATURATED / 16))
    (views, completed), (others, of_others) = (configured_views(each, FitConfig()) for each in (bright, dark))
    mean = torch.cat([view.radiance_at(view.solid) for view in views.train]).mean()
    assert float(mean) == pytest.approx(BRIGHTNESS, rel=1e-5)
    assert of_others.exposure == pytest.approx(16 * completed.exposure, rel=1e-3)
    for view, other in zip(views.train, others.train, strict=True):
        # Half floats in the files keep three digits.
        torch.testing.assert_close(view.radiance, other.radiance, rtol=2e-3, atol=1e-4)


def test_photographs_that_are_not_dark_stay_as_they_are(sphere_dataset: Dataset) -> None:
    views, completed = configured_views(sphere_dataset, FitConfig())
    assert completed.exposure == 1
    for view, other in zip(views.train, load_views(sphere_dataset, FitConfig().crop_margin_px).train, strict=True):
        assert torch.equal(view.radiance, other.radiance)


def test_masks_stay_as_they_are_where_repairs_are_off(sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(configured, "with_repaired_masks", lambda _: pytest.fail("a mask may be mended"))
    configured_views(sphere_dataset, FitConfig(corrections=CorrectionOptions(repair="off")))


def test_black_photographs_stay_black(tmp_path: Path) -> None:
    views, config = configured_views(exposed_dataset(tmp_path / "black", 0.0), FitConfig())
    assert config.exposure == 1
    assert all(float(view.radiance.max()) == 0 for view in views.train)


@pytest.mark.parametrize("preset", ["paper", "3dgs-dr"])
def test_methods_that_work_between_zero_and_one_take_photographs_as_they_are(preset: str, tmp_path: Path) -> None:
    dataset, config = exposed_dataset(tmp_path / "dark", UNSATURATED), replace(PRESETS[preset], crop_margin_px=2)
    views, completed = configured_views(dataset, config)
    plain = load_views(dataset, 2, encoding=encoding_of(config))
    assert float(torch.cat([view.radiance_at(view.solid) for view in load_views(dataset, 2).train]).mean()) < DARK
    assert torch.equal(views.train[0].radiance, plain.train[0].radiance)
    assert completed.exposure == 1


@pytest.mark.slow
def test_a_darker_exposure_gives_the_same_surface_and_a_darker_map(tmp_path: Path) -> None:
    def fitted(factor: float) -> FitState:
        dataset = exposed_dataset(tmp_path / f"data-{factor}", factor, train=14)
        return fit(dataset, tiny_config(), tmp_path / f"run-{factor}")

    bright, dark = fitted(UNSATURATED), fitted(UNSATURATED / 16)
    assert isinstance(bright.geometry, SurfelMirror)
    assert isinstance(dark.geometry, SurfelMirror)
    moved = (dark.geometry.surfels.means - bright.geometry.surfels.means).norm(dim=1)
    # In radii of the object. As they are exposed by a power of two, none is measured; unexposed 2e-3.
    assert float(moved.max()) < 1e-4
    assert bright.environment is not None
    assert dark.environment is not None
    assert dark.verdict is not None
    assert bright.verdict is not None
    assert dark.verdict.risk == pytest.approx(bright.verdict.risk, rel=0.05)
    difference = (16 * dark.environment - bright.environment).abs().mean()
    # Files of half floats and steps of single precision leave 0.2 %.
    assert float(difference) < 0.01 * float(bright.environment.mean())


def test_a_capture_of_a_ball_knows_its_shape_and_cameras(sphere_dataset: Dataset, damaged_dataset: Path) -> None:
    """Its fit takes a sphere, and no correction of cameras, lens or masks; another kind that is requested stays."""
    evidence = BallEvidence(0.2, 0.9, 0.02, 0.1, 0.1, 0.5)
    write_transforms(damaged_dataset, "train", sphere_dataset.train, ball=evidence)
    captured = open_dataset(damaged_dataset)
    _, config = configured_views(captured, FitConfig())
    assert config.model == "sphere"
    assert config.corrections.poses == "off"
    assert (config.corrections.masks, config.corrections.lens) == ("off", "off")
    assert (config.material.roughness, config.material.blur) == ("off", "off")
    assert config.material.reflectance == FitConfig().material.reflectance
    assert config.sphere.operator_deg > FitConfig().sphere.operator_deg
    for dataset, model in ((captured, "surfels"), (sphere_dataset, "auto")):
        _, config = configured_views(dataset, FitConfig(model=model))
        assert config.model == model
        assert config.corrections == FitConfig().corrections
