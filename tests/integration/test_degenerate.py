"""Photographs from which nothing can be recovered end in one clear message, or in finite numbers and a doubt."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import panoless
from panoless.config import FitConfig
from panoless.presets import PRESETS
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import Dataset, View
from shinypartial.dataset.write import write_view
from tests.support.mirror_sphere import tiny_config
from tests.support.synthetic_dataset import make_sphere_dataset

CONFIG: FitConfig = replace(tiny_config("fast", iterations=20, count=150), material=PRESETS["fast"].material)
Change = Callable[[Path], None]


@pytest.fixture
def photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Dataset:
    """Twelve views of a mirror sphere, to be damaged; runs go below the same folder."""
    monkeypatch.chdir(tmp_path)
    return make_sphere_dataset(tmp_path / "photographs", resolution=32, train=12, test=1)


def cameras(change: Callable[[list[dict]], object]) -> Change:
    def damage(root: Path) -> None:
        path = root / "transforms_train.json"
        content = json.loads(path.read_text())
        change(content["frames"])
        path.write_text(json.dumps(content))

    return damage


def pictures(change: Callable[[View], View]) -> Change:
    def damage(root: Path) -> None:
        for frame in open_dataset(root).train:
            write_view(frame, change(read_view(frame)))

    return damage


def beside_each_other(frames: list[dict]) -> None:
    """Cameras a thousandth of their distance apart."""
    pose, jitter = np.array(frames[0]["transform_matrix"]), np.random.default_rng(0)
    for frame in frames:
        moved = pose.copy()
        moved[:3, 3] += 1e-3 * jitter.normal(size=3)
        frame["transform_matrix"] = moved.tolist()


def cut_by_the_frame(view: View) -> View:
    """The object moved to the right until half of it is outside."""
    side = view.alpha.shape[1]
    kept = np.arange(side) >= side // 2
    moved = {name: np.roll(getattr(view, name), side // 2, 1) for name in ("alpha", "radiance")}
    return replace(view, alpha=moved["alpha"] * kept, radiance=moved["radiance"] * kept[:, None])


def twice_in_the_picture(view: View) -> View:
    """The object at half its size in two corners."""
    alpha, radiance = np.zeros_like(view.alpha), np.zeros_like(view.radiance)
    half = len(alpha) // 2
    for corner in (slice(half), slice(half, None)):
        alpha[corner, corner], radiance[corner, corner] = view.alpha[::2, ::2], view.radiance[::2, ::2]
    return replace(view, alpha=alpha, radiance=radiance)


def few_pixels_wide(view: View) -> View:
    """The object at a quarter of its size: six pixels across."""
    alpha, radiance = np.zeros_like(view.alpha), np.zeros_like(view.radiance)
    side = len(alpha) // 4
    middle = slice((len(alpha) - side) // 2, (len(alpha) + side) // 2)
    alpha[middle, middle] = view.alpha.reshape(side, 4, side, 4).mean((1, 3))
    radiance[middle, middle] = view.radiance.reshape(side, 4, side, 4, 3).mean((1, 3))
    return replace(view, alpha=alpha, radiance=radiance)


def half_without_object(root: Path) -> None:
    for frame in open_dataset(root).train[::2]:
        view = read_view(frame)
        write_view(frame, replace(view, alpha=np.zeros_like(view.alpha), radiance=np.zeros_like(view.radiance)))


def about_turn(frames: list[dict]) -> None:
    """Cameras that look the other way, as poses of OpenCV taken for those of OpenGL do."""
    for frame in frames:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist()


def lit_by(radiance: Callable[[View], np.ndarray]) -> Callable[[View], View]:
    return lambda view: replace(view, radiance=(radiance(view) * view.alpha[..., None]).astype(np.float32))


DOUBTED: dict[str, Change] = {
    "two views": cameras(lambda frames: frames.__delitem__(slice(2, None))),
    "an object cut by the frame": pictures(cut_by_the_frame),
    "two objects": pictures(twice_in_the_picture),
    "an object of six pixels": pictures(few_pixels_wide),
    "too much light": pictures(lit_by(lambda view: np.ones_like(view.radiance))),
    "noise": pictures(lit_by(lambda view: np.random.default_rng(0).random(view.radiance.shape))),
    "no light": pictures(lit_by(lambda view: np.zeros_like(view.radiance))),
    "one color": pictures(lit_by(lambda view: np.full_like(view.radiance, 0.5))),
}
REFUSED: dict[str, Change] = {
    "one view": cameras(lambda frames: frames.__delitem__(slice(1, None))),
    "one place": cameras(lambda frames: [frame.update(frames[0]) for frame in frames]),
    "cameras that look away": cameras(about_turn),
    "cameras beside each other": cameras(beside_each_other),
    "half of the views without the object": half_without_object,
    "no object anywhere": pictures(lambda view: replace(view, alpha=np.zeros_like(view.alpha))),
}


@pytest.mark.parametrize("name", DOUBTED)
def test_a_fit_of_little_is_finite_and_doubted(name: str, photographs: Dataset) -> None:
    DOUBTED[name](photographs.root)
    result = panoless.fit(photographs.root, config=CONFIG, output="out")
    assert np.isfinite(result.environment).all()
    assert result.verdict is not None
    assert result.verdict.verdict != "trust"
    assert np.isfinite(result.verdict.risk)


@pytest.mark.parametrize("name", REFUSED)
def test_nothing_to_fit_is_refused_in_a_message(name: str, photographs: Dataset) -> None:
    REFUSED[name](photographs.root)
    with pytest.raises(InputError):
        panoless.fit(photographs.root, config=CONFIG, output="out")
    assert not list(Path("out").iterdir())
