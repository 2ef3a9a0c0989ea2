"""LPIPS: published check values where weights are present; otherwise where they are sought and what is refused."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from shinypartial.core.errors import InputError
from shinypartial.metrics import perceptual
from shinypartial.metrics.perceptual import (
    ENVIRONMENT_VARIABLE,
    find_weights,
    load_lpips,
    read_checkpoint,
    read_weights,
)


@pytest.mark.parametrize(("network", "expected"), [("alex", 0.2000784), ("vgg", 0.1117137)])
def test_the_check_values_of_the_weights(network: str, expected: float) -> None:
    """Zeros against 0.5 in the networks' input range [−1, 1], as the package that ships the weights computes it."""
    path = find_weights(network)
    if path is None:
        pytest.skip("no LPIPS weights: run `shinypartial weights`")
    pytest.importorskip("torch")
    distance = load_lpips(network, path)
    gray, lighter = np.full((64, 64, 3), 0.5), np.full((64, 64, 3), 0.75)
    assert distance(lighter, gray) == pytest.approx(expected, abs=1e-6)  # float32 sums: 2e-7 measured
    assert distance(gray, gray) == 0.0


def test_weights_are_sought_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = {name: tmp_path / name for name in ("explicit", "variable", "cache")}
    for folder in folders.values():
        folder.mkdir()
        (folder / "alexnet.ckpt").touch()
    monkeypatch.setattr(perceptual, "CACHE", folders["cache"])
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    assert find_weights("alex") == folders["cache"] / "alexnet.ckpt"
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(folders["variable"]))
    assert find_weights("alex") == folders["variable"] / "alexnet.ckpt"
    assert find_weights("alex", folders["explicit"]) == folders["explicit"] / "alexnet.ckpt"
    with pytest.raises(InputError, match=r"vgg16\.ckpt"):
        find_weights("vgg")


def test_plain_arrays_come_before_checkpoints(tmp_path: Path) -> None:
    (tmp_path / "alexnet.ckpt").touch()
    (tmp_path / "lpips_alex.npz").touch()
    assert find_weights("alex", tmp_path) == tmp_path / "lpips_alex.npz"


def test_a_pickle_of_anything_but_arrays_is_refused() -> None:
    with pytest.raises(InputError, match="not a numpy array"):
        read_checkpoint(pickle.dumps({"a": Path("x")}), "a")
    with pytest.raises(InputError, match="shinypartial weights"):
        read_checkpoint(pickle.dumps({"a": np.arange(3.0)})[:-20], "a")
    content = pickle.dumps({"a": np.arange(3.0)}, protocol=3)
    assert read_checkpoint(content, "a")["a"].tolist() == [0.0, 1.0, 2.0]


def test_damaged_arrays_say_how_to_get_them_again(tmp_path: Path) -> None:
    path = tmp_path / "lpips_alex.npz"
    for content in (b"", b"PK\x03\x04 not a zip", pickle.dumps([1])):
        path.write_bytes(content)
        with pytest.raises(InputError, match="shinypartial weights"):
            read_weights("alex", path)
