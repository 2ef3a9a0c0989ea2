"""The suite continues after a kill, outlives methods that fail, and hands arguments to Snakemake."""

import importlib
import importlib.util
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

import pytest

from shinypartial.cli import main
from shinypartial.core.errors import InputError
from shinypartial.io.files import write_json
from shinypartial.suites.attempt import RECORDS, Record, attempt, read_record
from shinypartial.suites.jobs import Job, write_jobs
from shinypartial.suites.run import forget_failures, run_suite, snakemake_arguments
from shinypartial.suites.stability.collect import collect
from shinypartial.suites.stability.plan import SIZE, Cell, Plan, make_plan
from shinypartial.suites.tables.plan import make_plan as make_tables

ROOT = Path(__file__).resolve().parents[3]
CELL = Cell("tiny-vase", "development", "broken", None, None, 0)
needs_snakemake = pytest.mark.skipif(importlib.util.find_spec("snakemake") is None, reason="Snakemake is not installed")


def plan_of(*jobs: Job, cells: tuple[Cell, ...] = ()) -> Plan:
    return Plan(SIZE, cells, jobs)


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "shinypartial.cli", "stability", "--plan", "tiny", "--output", str(folder), *words],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def test_a_failed_method_is_recorded_and_stops_nothing(tmp_path: Path) -> None:
    fit = Job(f"fit/{CELL.name}", "echo begun; echo 'error: no light'; echo bye; exit 3")
    plan = plan_of(fit, Job(f"score/{CELL.name}", "touch scored", (fit.name,)), cells=(CELL,))
    write_jobs(tmp_path, plan)
    assert [attempt(job.name, 1, tmp_path) for job in plan.jobs] == [0, 0]
    record = read_record(tmp_path, fit.name)
    assert record is not None
    assert (record.code, record.reason) == (3, "error: no light")
    assert not (tmp_path / "scored").exists()
    (outcome,) = collect(tmp_path, plan).outcomes
    assert outcome.failure == "error: no light"
    assert outcome.environment_db is None
    forget_failures(tmp_path, plan)
    assert collect(tmp_path, plan).outcomes == ()


def test_a_finished_job_is_not_run_again_and_threads_are_capped(tmp_path: Path) -> None:
    write_jobs(tmp_path, plan_of(Job("fit/a", "echo $OMP_NUM_THREADS $NUMBA_NUM_THREADS >> threads")))
    assert [attempt("fit/a", 1, tmp_path), attempt("fit/a", 1, tmp_path)] == [0, 0]
    assert (tmp_path / "threads").read_text() == "1 1\n"


def test_a_job_that_was_stopped_has_not_failed(tmp_path: Path) -> None:
    write_jobs(tmp_path, plan_of(Job("fit/a", "kill -TERM $$")))
    assert attempt("fit/a", 1, tmp_path) == 128 + signal.SIGTERM
    assert read_record(tmp_path, "fit/a") is None


@pytest.mark.parametrize("interrupted", [False, True])
def test_time_is_added_up_over_attempts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interrupted: bool) -> None:
    """Work of 0.1 s before a stop, of the command or of its attempt, and none after it."""
    work = f"{sys.executable} -c 'import os; [0 for _ in iter(lambda: os.times().user < 0.1, False)]'"
    write_jobs(tmp_path, plan_of(Job("fit/a", f"test -e begun && exit; touch begun; {work}; kill -TERM $$")))

    def interrupt(command: str, threads: int, folder: Path, log: int) -> int:
        subprocess.run(command, shell=True, cwd=folder, check=False)
        raise KeyboardInterrupt

    if interrupted:
        monkeypatch.setattr("shinypartial.suites.attempt._run", interrupt)
        with pytest.raises(KeyboardInterrupt):
            attempt("fit/a", 1, tmp_path)
        monkeypatch.undo()
    else:
        attempt("fit/a", 1, tmp_path)
    assert read_record(tmp_path, "fit/a") is None
    assert attempt("fit/a", 1, tmp_path) == 0
    record = read_record(tmp_path, "fit/a")
    assert record is not None
    assert record.code == 0
    assert min(record.seconds, record.cpu_seconds) >= 0.1
    assert [path.name for path in (tmp_path / RECORDS / "fit").iterdir()] == ["a.json"]


def test_only_results_of_the_same_commands_are_collected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A dataset of another size has another one, though its fits are the plan's; records of other jobs don't count."""
    words = ["tables", "--tables", "main", "--scenes", "vase", "--methods", "ours", "--output", str(tmp_path)]
    plan = make_tables(["main"], [0], scenes=["vase"], methods=["ours"])
    for job in (*plan.jobs, Job("fit/another", "a command")):
        write_record(tmp_path, job, reason="no light")
    assert main([*words, "--collect-only"]) == 0
    capsys.readouterr()
    assert main([*words, "--collect-only", "--resolution", "80"]) == 2
    assert "--resolution 80" in capsys.readouterr().err


def test_a_record_that_is_none_is_named(tmp_path: Path) -> None:
    write_json(tmp_path / RECORDS / "fit/a.json", {"code": 0})
    with pytest.raises(InputError, match=r"fit/a\.json"):
        read_record(tmp_path, "fit/a")


def write_record(folder: Path, job: Job, reason: str = "") -> None:
    write_json(folder / RECORDS / f"{job.name}.json", asdict(Record(job.command, 1, 1.0, reason)))


def test_arguments_of_snakemake(tmp_path: Path) -> None:
    assert snakemake_arguments(tmp_path, 2, [])[-5:] == ["--cores", "2", "--quiet", "all", "--keep-going"]
    words = snakemake_arguments(tmp_path, 2, ["--executor", "slurm", "--jobs", "50"])
    assert "--cores" not in words
    assert words[-4:] == ["--executor", "slurm", "--jobs", "50"]


@needs_snakemake
def test_further_words_may_be_targets(tmp_path: Path) -> None:
    from snakemake.cli import get_argument_parser

    words = snakemake_arguments(tmp_path, 2, ["done/score/a", "done/score/b"])
    assert get_argument_parser().parse_args(words).targets == ["done/score/a", "done/score/b"]


def test_without_snakemake_the_message_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "snakemake.cli", None)
    with pytest.raises(InputError, match=r"pip install 'panoless\[stability\]'"):
        run_suite(tmp_path, plan_of(), 1)


@needs_snakemake
def test_a_killed_suite_continues_and_does_nothing_twice(tmp_path: Path) -> None:
    method = "echo {prediction} >> begun; sleep 1; echo {prediction} >> ended; exit 1 # {dataset}"
    words = ["--methods", "--method", f"slow={method}", "--seeds", "0"]
    killed = start(tmp_path, *words)
    deadline = time.monotonic() + 60
    while not (tmp_path / "begun").exists():
        assert killed.poll() is None, killed.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.02)
    killed.kill()
    killed.wait()
    assert killed.stdout is not None
    killed.stdout.close()
    assert not (tmp_path / "stability.md").exists()
    again = start(tmp_path, *words)
    output = again.communicate(timeout=120)[0]
    assert again.returncode == 0, output
    assert "3 of 3 cells have ended, 3 of them failed" in output
    expected = sorted(f"predictions/{cell.name}" for cell in make_plan("tiny", {"slow": method}, [0]).cells)
    for name in ("begun", "ended"):
        assert sorted((tmp_path / name).read_text().split()) == expected


@needs_snakemake
@pytest.mark.parametrize("executor", ["slurm", "kubernetes"])
def test_a_dry_run_on_a_cluster(tmp_path: Path, executor: str) -> None:
    """Pods see no common folder by themselves: Snakemake's marks need a storage for them."""
    words = ["--executor", executor, "--jobs", "4"]
    needed = [f"snakemake_executor_plugin_{executor}"]
    if executor == "kubernetes":
        words += ["--default-storage-provider", "fs", "--default-storage-prefix", str(tmp_path)]
        needed.append("snakemake_storage_plugin_fs")
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    dry = start(tmp_path, "--seeds", "0", "--", "--dry-run", *words)
    output = dry.communicate(timeout=120)[0]
    assert dry.returncode == 0, output
    assert "rule fit" in output
    assert not (tmp_path / "records").exists()
