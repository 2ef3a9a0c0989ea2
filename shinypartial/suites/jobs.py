"""Jobs as data: commands and what has to end before each of them."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from shinypartial.core.errors import InputError
from shinypartial.io.files import read_json, write_json
from shinypartial.io.records import read_record

PLAN = "plan.json"


@dataclass(frozen=True)
class Job:
    """A command, and the jobs that have to end before it; `name` is KIND/NAME."""

    name: str
    command: str
    after: tuple[str, ...] = ()


@runtime_checkable
class Plan(Protocol):
    """Jobs in the order in which they are written down, and what is stored beside them."""

    @property
    def jobs(self) -> tuple[Job, ...]:
        """All of them."""

    @property
    def facts(self) -> Mapping[str, Any]:
        """What the jobs are for, as JSON has it."""


@dataclass(frozen=True)
class Size:
    """How large rendered datasets are."""

    resolution: int
    """Pixels per side."""
    train: int
    """Training views."""
    test: int
    """Test views."""

    def rendering(self, scene: str) -> str:
        """The command that renders a scene, but for where to."""
        views = f"--train {self.train} --test {self.test}"
        return f"shinypartial generate --scene {scene} --resolution {self.resolution} {views}"


def require_known(what: str, names: Sequence[str], known: Collection[str]) -> None:
    """Raise InputError for a name that is none of the known ones."""
    for name in names:
        if name not in known:
            raise InputError(expected=f"{what}: {', '.join(known)}", found=repr(name), remedy="Choose some of them.")


def write_jobs(folder: Path, plan: Plan) -> None:
    """Write FOLDER/plan.json; InputError where a job of the same name that is there means another command."""
    if (folder / PLAN).exists():
        require_commands(plan, {job.name: job.command for job in read_jobs(folder)}, folder / PLAN)
    write_json(folder / PLAN, {**plan.facts, "jobs": _table(plan.jobs)})


def require_commands(plan: Plan, begun: Mapping[str, str], where: Path) -> None:
    """Raise InputError for a job of the plan that was begun by another command, as `where` holds."""
    for job in plan.jobs:
        if begun.get(job.name, job.command) != job.command:
            raise InputError(
                expected=f"{job.name} to be `{begun[job.name]}`, as in {where}",
                found=f"`{job.command}`",
                remedy="Choose another --output, another name for the method, or the options of the earlier run.",
            )


def _table(jobs: Sequence[Job]) -> dict[str, dict[str, Any]]:
    return {job.name: {"command": job.command, "after": list(job.after)} for job in jobs}


@dataclass(frozen=True)
class _Stored:
    """What of plan.json every suite has."""

    jobs: dict[str, dict[str, Any]]


def read_jobs(folder: Path) -> tuple[Job, ...]:
    """The jobs that a folder was made by; InputError where its plan is missing or something else."""
    path, remedy = folder / PLAN, "Restore that file, or choose another --output."
    content = read_json(path, "the plan of a suite")
    stored = read_record(_Stored, content, str(path), allow_unknown=True, remedy=remedy).jobs
    return tuple(
        read_record(Job, {**job, "name": name}, f"{name} in {path}", remedy=remedy) for name, job in stored.items()
    )
