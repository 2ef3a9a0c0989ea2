"""One job of the suite: run its command, and record how it ended in place of stopping the suite.

    python -m shinypartial.suites.attempt fit/vase.0.fast --threads 1 --folder stability

The log is locked while the command or anything that it started lives. So after a kill the next attempt waits for what
is still at work, and does not begin it a second time.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from shinypartial.core.errors import EXIT_BAD_INPUT, EXIT_INTERRUPTED, InputError
from shinypartial.io.files import read_json, write_json
from shinypartial.io.records import read_record as record_of
from shinypartial.io.system import locked_log
from shinypartial.suites.jobs import Job, Plan, read_jobs, require_commands

RECORDS, LOGS = Path("records"), Path("logs")
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
STOPPED = (signal.SIGINT, signal.SIGTERM)
#: Codes of a command that was stopped from outside, which says nothing about it.
STOP_CODES = tuple(code for number in STOPPED for code in (-number, 128 + number))
REASON_CHARACTERS = 300


@dataclass(frozen=True)
class Record:
    """How a command ended; `reason` is empty unless it failed, `code` None where it was not begun or was stopped.

    Times are those of all attempts, for a fit goes on where it was stopped.
    """

    command: str
    code: int | None
    seconds: float
    reason: str = ""
    cpu_seconds: float | None = None
    """Processor time in the programs themselves, of all that the command waited for."""


def read_record(folder: Path, job: str) -> Record | None:
    """The record of a job, or None; InputError where the file is something else."""
    path = _record_path(folder, job)
    if not path.exists():
        return None
    content = read_json(path, "the record of a job")
    return record_of(Record, content, str(path), remedy="Restore that file, or choose another --output.")


def _record_path(folder: Path, job: str) -> Path:
    return folder / RECORDS / f"{job}.json"


def _write_record(folder: Path, job: str, record: Record) -> None:
    write_json(_record_path(folder, job), asdict(record))


def require_records(folder: Path, plan: Plan) -> None:
    """Raise InputError where a job of the plan has ended by another command: its result is not the plan's."""
    records = ((job.name, read_record(folder, job.name)) for job in plan.jobs)
    require_commands(plan, {name: record.command for name, record in records if record}, folder / RECORDS)


def attempt(job: str, threads: int, folder: Path = Path()) -> int:
    """Run a job of the folder's plan unless its record is there; 0 unless it was stopped."""
    planned = next(each for each in read_jobs(folder) if each.name == job)
    log = folder / LOGS / f"{job}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as stream, locked_log(stream):
        earlier = read_record(folder, job)
        if earlier is not None and earlier.command == planned.command:
            return 0
        befores = ((name, read_record(folder, name)) for name in planned.after)
        failed = next(((name, record) for name, record in befores if record and record.reason), None)
        if failed is not None:
            record = Record(planned.command, None, 0.0, f"{failed[0]}: {failed[1].reason}"[:REASON_CHARACTERS])
        else:
            begun = stream.tell()
            record = _timed(planned, threads, folder, stream.fileno())
            code = record.code or 0
            if code in STOP_CODES:
                return code if code > 0 else 128 - code
            if code:
                record = replace(record, reason=_reason(log.read_bytes()[begun:].decode(errors="replace"), code))
        _write_record(folder, job, record)
        _record_path(folder, _stopped(job)).unlink(missing_ok=True)
    return 0


def _stopped(job: str) -> str:
    """Whose record says how long the attempts at a job took that were stopped."""
    return f"{job}.stopped"


def _timed(job: Job, threads: int, folder: Path, log: int) -> Record:
    """Run a command; its times are added to those of earlier attempts, and kept for the next one if it is stopped."""
    before = read_record(folder, _stopped(job.name))
    if before is None or before.command != job.command:
        before = Record(job.command, None, 0.0, cpu_seconds=0.0)
    started, code = time.monotonic() - before.seconds, None
    worked = os.times().children_user - (before.cpu_seconds or 0.0)
    try:
        code = _run(job.command, threads, folder, log)
    finally:
        seconds, cpu_seconds = round(time.monotonic() - started, 3), round(os.times().children_user - worked, 3)
        record = Record(job.command, code, seconds, cpu_seconds=cpu_seconds)
        if code is None or code in STOP_CODES:
            _write_record(folder, _stopped(job.name), replace(record, code=None))
    return record


def _run(command: str, threads: int, folder: Path, log: int) -> int:
    """In a shell that finds the programs of this environment first, with capped threads."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    caps = {name: str(threads) for name in THREAD_VARIABLES}
    environment = {**os.environ, **caps, "PATH": path, "OMP_WAIT_POLICY": "PASSIVE"}
    return subprocess.run(command, shell=True, cwd=folder, env=environment, stdout=log, stderr=log).returncode


def _reason(log: str, code: int) -> str:
    """The last line that speaks of an error, else the last line, else the code."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    errors = [line for line in lines if "error" in line.lower()]
    return ([f"ended with code {code}", *lines[-1:], *errors[-1:]])[-1][:REASON_CHARACTERS]


def main(arguments: Sequence[str] | None = None) -> int:
    """Attempt the job that is named."""
    parser = argparse.ArgumentParser(description="Run one job of a suite.")
    parser.add_argument("job", help="KIND/NAME")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path(), help="of the suite; the working directory by default")
    options = parser.parse_args(arguments)
    try:
        return attempt(options.job, options.threads, options.folder)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
