"""A dataset with enough views for a hull, its views, and one finished fit; made once, only read by tests."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.reconstruct.state import FitState
from shinypartial.dataset.schema import Dataset


@dataclass(frozen=True)
class FinishedFit:
    """A fit with everything that went in."""

    dataset: Dataset
    config: FitConfig
    folder: Path
    state: FitState


@pytest.fixture(scope="session")
def many_views_dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The synthetic sphere in 14 training views."""
    from tests.support.synthetic_dataset import make_sphere_dataset

    return make_sphere_dataset(tmp_path_factory.mktemp("datasets") / "sphere-14", resolution=40, train=14, test=3)


@pytest.fixture(scope="session")
def views(many_views_dataset: Dataset) -> Views:
    """Its views, cropped."""
    from panoless.capture.views import load_views

    return load_views(many_views_dataset, crop_margin_px=3)


@pytest.fixture(scope="session")
def finished(many_views_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> FinishedFit:
    """A fit of the default preset, a second long."""
    from panoless.reconstruct.fit import fit
    from tests.support.mirror_sphere import tiny_config

    config, folder = tiny_config(), tmp_path_factory.mktemp("runs") / "sphere"
    return FinishedFit(many_views_dataset, config, folder, fit(many_views_dataset, config, folder))


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Density control acts within a short fit."""
    from tests.support.mirror_sphere import control_density_often

    control_density_often(monkeypatch)
