"""Run a plan by Snakemake: it continues after any stop, and says how far it is."""

import os
import threading
from collections.abc import Sequence
from pathlib import Path

from shinypartial.core.errors import InputError
from shinypartial.io.files import folder_lock, write_text
from shinypartial.io.progress import Progress
from shinypartial.suites.attempt import RECORDS, read_record
from shinypartial.suites.jobs import Plan, write_jobs

SNAKEFILE = Path(__file__).parent / "Snakefile"
DONE = Path("done")
DRY_RUN = {"-n", "--dry-run", "--dryrun"}
EXECUTOR = ("-e", "--executor", "--profile", "--workflow-profile")
WATCH_INTERVAL_S = 1.0


def run_suite(folder: Path, plan: Plan, cores: int, arguments: Sequence[str] = (), *, retry: bool = False) -> bool:
    """Make what is missing of a plan in `folder`; whether it is complete. `arguments` go to Snakemake.

    The folder is locked as others are, by a lock that ends with the process, so that Snakemake's own is left out.
    Raises InputError when Snakemake is missing or stops, or the folder holds another plan or is in use.
    """
    snakemake = _snakemake()
    words = snakemake_arguments(folder, cores, arguments)
    dry_run = not DRY_RUN.isdisjoint(arguments)
    with folder_lock(folder):
        write_jobs(folder, plan)
        write_text(folder / ".gitignore", "*\n")
        if retry and not dry_run:
            forget_failures(folder, plan)
        ended = threading.Event()
        watcher = threading.Thread(target=_watch, args=(folder.resolve(), plan, ended), daemon=True)
        if not dry_run:
            watcher.start()
        place = Path.cwd()
        try:
            code = _call(snakemake, words)
        finally:
            os.chdir(place)
            ended.set()
            if not dry_run:
                watcher.join()
    if code:
        raise InputError(
            expected="Snakemake to run every job",
            found=f"it ended with code {code}",
            remedy=f"Read what it said above and in {folder / '.snakemake' / 'log'}, then run the same command again.",
        )
    return not dry_run


def snakemake_arguments(folder: Path, cores: int, arguments: Sequence[str]) -> list[str]:
    """The command line of Snakemake; cores are those of this machine, unless an executor has machines of its own."""
    words = ["--snakefile", str(SNAKEFILE), "--directory", str(folder.resolve()), "--nolock", "--rerun-incomplete"]
    words += ["--config", f"folder={folder.resolve()}", "--rerun-triggers", "mtime"]
    if not any(word.partition("=")[0] in EXECUTOR for word in arguments):
        words += ["--cores", str(cores)]
    if DRY_RUN.isdisjoint(arguments):
        words += ["--quiet", "all"]
    # Targets may follow, which an option that takes several values before them would swallow.
    return [*words, "--keep-going", *arguments]


def forget_failures(folder: Path, plan: Plan) -> None:
    """Delete the records of jobs that failed, so that they are run again."""
    for job in plan.jobs:
        record = read_record(folder, job.name)
        if record is not None and record.reason:
            (folder / DONE / job.name).unlink(missing_ok=True)
            (folder / RECORDS / f"{job.name}.json").unlink()


def _snakemake():  # type: ignore[no-untyped-def]
    try:
        from snakemake.cli import main
    except ImportError:
        raise InputError(
            expected="Snakemake, which runs the suite",
            found="no module snakemake",
            remedy="Install it: pip install 'panoless[stability]'",
        ) from None
    return main


def _call(snakemake, words: list[str]) -> int:  # type: ignore[no-untyped-def]
    try:
        snakemake(words)
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def _watch(folder: Path, plan: Plan, ended: threading.Event) -> None:
    """Report the scores that are done; those of earlier runs don't count in the speed."""
    marks = [folder / RECORDS / f"{job.name}.json" for job in plan.jobs if job.name.startswith("score/")]
    progress = Progress("Scores", len(marks), sum(mark.exists() for mark in marks))
    while not ended.wait(WATCH_INTERVAL_S):
        _report(progress, marks)
    _report(progress, marks)


def _report(progress: Progress, marks: Sequence[Path]) -> None:
    new = sum(mark.exists() for mark in marks) - progress.done
    if new > 0:
        progress.advance(steps=new)
