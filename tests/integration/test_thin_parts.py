"""Masks whose hull is thin, torn or a speck end in a result with a verdict, or in one message."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import panoless
from panoless.config import FitConfig
from panoless.geometry.free_form.options import FreeFormOptions
from shinypartial.core.errors import InputError
from tests.support.mirror_body import rods_and_speck, write_plain_dataset
from tests.support.mirror_sphere import tiny_config

SURFELS: FitConfig = tiny_config("fast", iterations=2, count=60)
CONFIG = replace(
    SURFELS,
    free_form=FreeFormOptions(starts=False, finest_cells=20),
    corrections=replace(SURFELS.corrections, poses="off", masks="off", exposure="off", lens="off"),
)


@pytest.mark.parametrize(
    ("radius", "model"),
    [
        pytest.param(0.05, "surfels", id="of two pixels, surfels"),
        pytest.param(0.05, "free_form", id="of two pixels, free form", marks=pytest.mark.slow),
        pytest.param(0.025, "surfels", id="of one pixel, surfels"),
        pytest.param(0.025, "free_form", id="of one pixel, free form"),
    ],
)
def test_thin_and_disconnected_parts_end_in_a_verdict_or_in_a_message(
    radius: float, model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rod's diameter is one or two pixels. Some of its hull is lost between voxels then, so that specks are left."""
    monkeypatch.chdir(tmp_path)
    root = write_plain_dataset(tmp_path / "rods", rods_and_speck(radius), count=4, resolution=40)
    try:
        result = panoless.fit(root, config=replace(CONFIG, model=model), output="out")
    except InputError:
        assert not list(Path("out").iterdir())
        return
    assert result.verdict is not None
    assert np.isfinite(result.environment).all()
