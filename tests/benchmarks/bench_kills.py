"""What `kill -9` does to commands: `python -m tests.benchmarks.bench_kills --json docs/results/kills.json`.

Each command is killed with all its processes at moments that are drawn evenly over its whole time, and begun again
with the same words, until it has been killed as often as requested; whenever it comes to its end, that is compared with
the end of a run that nobody killed, and it begins again. Runs have one thread; another one with two is compared, too.
An hour on two cores; `--kills 0.1` is a quicker look.

Compared are the bytes of all files, but for pages that state times; JSON files without their times. What a
command had finished at a kill (`once`: files of its result, stages of a fit) must not be written again later.
"""

import argparse
import json
import os
import random
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from panoless.journal import FOLDER as JOURNAL
from shinypartial.dataset.bundled import bundled_dataset
from shinypartial.dataset.read import open_dataset
from shinypartial.io.files import PARTIAL_PREFIX, sha256_of, write_json
from tests.support.synthetic_dataset import make_sphere_dataset
from tests.support.tiny_scene import write_recipe
from tests.support.truth_prediction import write_truth_prediction

ROOT = Path(__file__).resolve().parents[2]
LONGEST_S = 1200
MADE = Path("made")
#: The command line with checkpoints of surfels at every fifth of a second, so that small fits have some.
FIT = f"""{sys.executable} -c
from panoless.reconstruct import recorder; import panoless.cli, sys
recorder.CHECKPOINT_INTERVAL_S = 0.2; sys.exit(panoless.cli.main(sys.argv[1:]))
""".split(maxsplit=2)
SMALL = shlex.split("""
    --preset fast --config.iterations 400 --config.surfels.count 500 --config.environment.rays 100000
    --config.environment.resolution 32 --config.environment.solve-resolution 32
    --set corrections.masks=off corrections.exposure=off corrections.lens=off corrections.poses=off
    surroundings.mode=off
""")
FREE_FORM = shlex.split("--set free_form.concavities=false free_form.starts=false free_form.finest_cells=20")


@dataclass(frozen=True)
class Command:
    """A command, how often it is killed, and the files (as a pattern) that it writes once only."""

    words: list[str]
    kills: int
    once: str


def _program(package: str, *words: str) -> list[str]:
    return [sys.executable, "-m", f"{package}.cli", *words, "--output", str(MADE)]


def _fit(dataset: str, model: str, kills: int, *options: str) -> Command:
    words = [*FIT, "fit", dataset, *SMALL, *options, "--model", model, "--output", str(MADE)]
    return Command(words, kills, f"runs/{MADE}/{JOURNAL}/*.pt")


COMMANDS = {
    "generate": Command(_program("shinypartial", "generate", "--scene", "recipe/scene.toml"), 20, "made/t*/*.exr"),
    "perturb": Command(
        _program("shinypartial", "perturb", "tiny-vase", "--sensor.shot-noise", "0.02"), 10, "made/t*/r_???.png"
    ),
    "fit: sphere": _fit("ball", "sphere", 15),
    "fit: plane": _fit("ball", "plane", 15),
    "fit: height field": _fit("ball", "height_field", 15),
    "fit: revolution": _fit("fewer", "revolution", 15),
    "fit: free form": _fit("fewer", "free_form", 15, *FREE_FORM),
    "fit: surfels": _fit("fewer", "surfels", 20),
    "fit: auto": _fit("fewer", "auto", 15),
    "stability": Command(
        [
            *_program("shinypartial", "stability", "--plan", "tiny", "--seeds", "0", "--cores", "2"),
            "--methods",
            "--method",
            "copy=mkdir -p predictions && cp -rT ../truth {prediction} # {dataset}",
        ],
        20,
        "made/records/*/*.json",
    ),
}
#: Below folders and in files of these names is what states times, or belongs to the work and not to its result.
APART = ("report.html", "scores.html", ".snakemake", "logs", "done")
CIRCUMSTANCES = ("seconds", "peak_memory_bytes", "hardware")
THREAD_VARIABLES = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Bearing:
    """How a command bore its kills."""

    command: str
    kills: int
    ends: int
    """How often it came to its end between them."""
    seconds: float
    """Of a run that nobody killed."""
    cpu_seconds: float
    """Of that run."""
    cpu_seconds_an_end: float
    """Of all runs that were killed and ended, over the number of ends."""
    kills_with_work: int
    """Kills at which something lay there already: files of the result, or a run to continue."""
    different: list[str]
    """Files of an end that differed from the run that nobody killed."""
    different_by_threads: list[str]
    """Files of a run with two threads that differed from those of one with one."""
    done_twice: list[str]
    """Files that a command had finished before a kill and wrote again after it."""
    left_over: list[str]
    """Temporary files at an end."""


def prepare(place: Path) -> None:
    """What the commands read: a recipe, a ball, twelve views of the vase, and a prediction to copy."""
    make_sphere_dataset(place / "ball")
    scene = {"resolution": 48, "train": 4, "test": 2, "samples": 16}
    write_recipe(place / "recipe", **scene)
    write_truth_prediction(place / "truth", open_dataset(bundled_dataset("tiny-vase")))
    few = [sys.executable, "-m", "shinypartial.cli", "perturb", "tiny-vase", "--views.keep", "12", "--output", "fewer"]
    subprocess.run(few, cwd=place, env=_environment(), check=True, stdout=subprocess.DEVNULL)


def bear_kills(name: str, kills: int, place: Path, seed: int = 0) -> Bearing:
    """Kill a command so many times in a prepared folder."""
    command, made = COMMANDS[name], place / MADE
    _clear(place)
    _finish(_start(command, place))  # Kernels are compiled, and the bits of that run may differ.
    _clear(place)
    _finish(_start(command, place, threads=2))
    by_two = result(made)
    _clear(place)
    begun, cpu_begun = time.monotonic(), _cpu_seconds()
    _finish(_start(command, place))
    whole_s, cpu_s, expected = time.monotonic() - begun, _cpu_seconds() - cpu_begun, result(made)
    cpu_begun = _cpu_seconds()
    assert expected
    _clear(place)
    chance, finished = random.Random(f"{name} {seed}"), dict[Path, tuple[int, int]]()
    killed, ends, with_work = 0, 0, 0
    different, done_twice, left_over = set[str](), set[str](), set[str]()
    while True:
        process = _start(command, place)
        try:
            _finish(process, chance.uniform(0, whole_s) if killed < kills else LONGEST_S)
            ended = True
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            killed, ended = killed + 1, False
            with_work += any(path.is_file() for folder in (made, place / "runs") for path in folder.rglob("*"))
        now = {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in place.glob(command.once)}
        done_twice |= {str(path.relative_to(place)) for path in now if finished.get(path, now[path]) != now[path]}
        finished |= now
        if ended:
            ends += 1
            found = result(made)
            different |= _different(expected, found)
            left_over |= {str(path.relative_to(place)) for path in _partial_files(place)}
            _clear(place)
            finished = {}
            if killed >= kills:
                break
    sets = different, _different(expected, by_two), done_twice, left_over
    seconds = whole_s, cpu_s, (_cpu_seconds() - cpu_begun) / ends
    return Bearing(name, killed, ends, *(round(each, 1) for each in seconds), with_work, *map(sorted, sets))


def _cpu_seconds() -> float:
    """Of all processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def result(folder: Path) -> dict[str, object]:
    """Every file of a result by its checksum, JSON files by their content without times."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if path.is_file() and set(name.parts).isdisjoint(APART):
            found[str(name)] = _bare(json.loads(path.read_text())) if path.suffix == ".json" else sha256_of(path)
    return found


def _different(first: dict[str, object], second: dict[str, object]) -> set[str]:
    return {name for name in first.keys() | second.keys() if first.get(name) != second.get(name)}


def _bare(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _bare(value) for key, value in content.items() if key not in CIRCUMSTANCES}
    return [_bare(each) for each in content] if isinstance(content, list) else content


def _environment(threads: int = 1) -> dict[str, str]:
    capped = dict.fromkeys(THREAD_VARIABLES, str(threads))
    return {**os.environ, **capped, "PYTHONPATH": str(ROOT), "OMP_WAIT_POLICY": "PASSIVE"}


def _start(command: Command, place: Path, threads: int = 1) -> subprocess.Popen[bytes]:
    """The command in a group of processes of its own."""
    return subprocess.Popen(
        command.words,
        cwd=place,
        env=_environment(threads),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


def _finish(process: subprocess.Popen[bytes], timeout: float = LONGEST_S) -> None:
    """Raises TimeoutExpired when it takes longer."""
    output, _ = process.communicate(timeout=timeout)
    assert process.returncode == 0, output.decode()[-2000:]


def _partial_files(place: Path) -> Iterator[Path]:
    yield from (path for path in place.rglob(f"{PARTIAL_PREFIX}*") if ".snakemake" not in path.parts)


def _clear(place: Path) -> None:
    for folder in (place / MADE, place / "runs"):
        shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    """Kill every command, and write what became of it after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--kills", type=float, default=1.0, help="share of the kills of each command")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    options = parser.parse_args()
    found: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as place:
        prepare(Path(place))
        for name in options.commands:
            kills = max(1, round(options.kills * COMMANDS[name].kills))
            found.append(asdict(bear_kills(name, kills, Path(place), options.seed)))
            print(json.dumps(found[-1]), flush=True)
            write_json(options.json, {"seed": options.seed, "commands": found})


if __name__ == "__main__":
    main()
