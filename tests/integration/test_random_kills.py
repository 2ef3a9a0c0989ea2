"""Commands that the system kills at random moments: the same command ends with the same files, bit for bit.

`pytest -m slow tests/integration/test_random_kills.py` kills each of four commands 25 times, which takes a quarter of
an hour; KILLS=5 in the environment is a quicker look.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from shinypartial.dataset.bundled import bundled_dataset
from shinypartial.io.files import sha256_of
from tests.support.tiny_scene import write_recipe

ROOT = Path(__file__).resolve().parents[2]
KILLS = int(os.environ.get("KILLS", "25"))
LONGEST_S = 300
DATA = str(bundled_dataset("tiny-vase"))
COMMANDS = {
    "generate": ["shinypartial", "generate", "--scene", "recipe/scene.toml", "--output", "made"],
    "perturb": ["shinypartial", "perturb", DATA, "--sensor.shot-noise", "0.02", "--output", "made"],
    "fit": ["panoless", "fit", DATA, "--preset", "fast", "--config.iterations", "150", "--output", "made"],
    "stability": ["shinypartial", "stability", "--plan", "tiny", "--seeds", "0", "--output", "made"],
}
#: A method that takes a second and fails, so that the suite itself is what is killed.
COMMANDS["stability"] += ["--methods", "--method", "none=sleep 1; echo no method; exit 1 # {dataset}"]
#: What says when, how long or where it was made, or belongs to the work and not to its result.
APART = ("SHA256SUMS", "dataset.json", "prediction.json", "report.html", ".snakemake", "logs", "done", "records")


def start(words: list[str], place: Path) -> subprocess.Popen[bytes]:
    """The command in a group of processes of its own."""
    package, *arguments = words
    return subprocess.Popen(
        [sys.executable, "-m", f"{package}.cli", *arguments],
        cwd=place,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_WAIT_POLICY": "PASSIVE"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


def finish(process: subprocess.Popen[bytes]) -> None:
    output, _ = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 0, output.decode()[-2000:]


def result(folder: Path) -> dict[str, object]:
    """Every file of a result, by its checksum, or without its times."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if not path.is_file() or not set(name.parts).isdisjoint(APART):
            continue
        if path.name == "stability.json":
            cells = json.loads(path.read_text())["cells"]
            found[str(name)] = [{key: value for key, value in cell.items() if key != "seconds"} for cell in cells]
        else:
            found[str(name)] = sha256_of(path)
    return found


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_bears_being_killed(command: str, tmp_path: Path) -> None:
    write_recipe(tmp_path / "recipe")
    words, made = COMMANDS[command], tmp_path / "made"

    def clear() -> None:
        for folder in (made, tmp_path / "runs"):
            shutil.rmtree(folder, ignore_errors=True)

    finish(start(words, tmp_path))  # Kernels are compiled.
    clear()
    begun = time.monotonic()
    finish(start(words, tmp_path))
    whole_s, expected = time.monotonic() - begun, result(made)
    assert expected
    clear()
    chance, kills = random.Random(command), 0
    while kills < KILLS:
        process = start(words, tmp_path)
        try:
            output, _ = process.communicate(timeout=chance.uniform(0, whole_s))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            kills += 1
            continue
        assert process.returncode == 0, output.decode()[-2000:]
        assert result(made) == expected
        clear()
    finish(start(words, tmp_path))
    assert result(made) == expected
    assert not [path for path in made.rglob(".partial-*") if ".snakemake" not in path.parts]
