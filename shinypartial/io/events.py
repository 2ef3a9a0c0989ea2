"""What a long command does, for other programs: JSON objects, one a line on standard output.

`docs/reference/json-progress.md` documents the lines, and `schema` is what they satisfy.
"""

import contextlib
import json
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TextIO

import msgspec

from shinypartial import __version__
from shinypartial.core.errors import InputError, as_input_error
from shinypartial.io.records import Natural, NonNegative, Text

FORMAT = "panoless-progress"
FORMAT_VERSION = 1


@dataclass(frozen=True)
class Started:
    """The first line."""

    command: Text
    """Its name, such as `fit`."""
    version: Text
    """Of the package."""
    event: Literal["start"] = "start"
    format: Literal["panoless-progress"] = "panoless-progress"
    format_version: Literal[1] = 1


@dataclass(frozen=True)
class StageBegun:
    """A stage begins, or was found finished by an earlier run."""

    stage: Text
    found_before: bool
    event: Literal["stage"] = "stage"


@dataclass(frozen=True)
class StepsDone:
    """How far a stage has come; at most two lines a second."""

    stage: Text
    done: Natural
    total: Natural
    seconds_left: NonNegative | None
    """Of this stage, by its speed up to now; null before the first step."""
    note: str
    event: Literal["progress"] = "progress"


@dataclass(frozen=True)
class Noted:
    """A sentence for a log."""

    text: Text
    event: Literal["note"] = "note"


@dataclass(frozen=True)
class Warned:
    """A sentence that a person should see; the command goes on."""

    text: Text
    event: Literal["warning"] = "warning"


@dataclass(frozen=True)
class Stated:
    """How far a fit is to be trusted, as prediction.json has it."""

    verdict: Literal["trust", "partly", "do not trust"]
    reason: Text
    remedy: str


@dataclass(frozen=True)
class Finished:
    """The last line of a command that ended well."""

    paths: dict[str, str]
    """Absolute paths of what was made, by what they are."""
    lines: tuple[str, ...]
    """What was found, for a person."""
    next: tuple[str, ...]
    """Words of the command that continues from there, its program first; empty where none does."""
    verdict: Stated | None = None
    event: Literal["result"] = "result"


@dataclass(frozen=True)
class Failed:
    """The last line of a command that could not do it."""

    expected: Text
    found: Text
    remedy: Text
    event: Literal["error"] = "error"


@dataclass(frozen=True)
class Cancelled:
    """The last line of a command that was interrupted; the same command continues later."""

    event: Literal["cancelled"] = "cancelled"


Event = Started | StageBegun | StepsDone | Noted | Warned | Finished | Failed | Cancelled
_stream: TextIO | None = None


def schema() -> dict[str, Any]:
    """JSON Schema (2020-12) of a line."""
    kinds = list(Event.__args__)
    choices, parts = msgspec.json.schema_components(kinds, ref_template="#/$defs/{name}")
    for kind in kinds:  # Every key is there, also those that Python fills in.
        parts[kind.__name__]["required"] = list(parts[kind.__name__]["properties"])
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"A line of --json-progress, {FORMAT} version {FORMAT_VERSION}",
        "oneOf": list(choices),
        "$defs": parts,
    }


def reporting() -> bool:
    """Whether another program reads events."""
    return _stream is not None


def emit(event: Event) -> None:
    """Write a line, if a program reads them; raises KeyboardInterrupt when it no longer does."""
    global _stream
    if _stream is None:
        return
    try:
        _stream.write(json.dumps(msgspec.to_builtins(event)) + "\n")  # ASCII, whatever the pipe's encoding is.
        _stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), _stream.fileno())
        _stream = None
        raise KeyboardInterrupt from None


def report_result(
    paths: Mapping[str, Path],
    lines: Sequence[str] = (),
    *,
    verdict: tuple[Any, str, str] | None = None,
    following: Sequence[str | Path] = (),
) -> None:
    """Say what a command made; `verdict` is the word, its reason and its remedy."""
    whole = {name: str(path.resolve()) for name, path in paths.items()}
    stated = None if verdict is None else Stated(*verdict)
    emit(Finished(whole, tuple(lines), tuple(map(str, following)), stated))


def note(text: str) -> None:
    """A line on standard error, and an event."""
    print(text, file=sys.stderr)
    emit(Noted(text))


def warn(text: str) -> None:
    """The same of something that a person should see."""
    print(f"warning: {text}", file=sys.stderr)
    emit(Warned(text))


def begin_stage(title: str, *, found_before: bool = False) -> None:
    """The same of a stage; of one without a title nothing is said."""
    if title:
        print(f"{title}: found before" if found_before else title, file=sys.stderr)
        emit(StageBegun(title, found_before))


@contextlib.contextmanager
def json_lines(command: str) -> Iterator[None]:
    """Within this block standard output holds events alone; what is printed goes to standard error."""
    global _stream
    _stream = sys.stdout
    try:
        with redirect_stdout(sys.stderr):
            emit(Started(command, __version__))
            try:
                yield
            except KeyboardInterrupt:
                emit(Cancelled())
                raise
            except Exception as error:
                known = as_input_error(error) or InputError(
                    expected="a command that runs to its end",
                    found=f"{type(error).__name__}: {error}",
                    remedy="Report it with what standard error says.",
                )
                emit(Failed(known.expected, known.found, known.remedy))
                raise
    finally:
        _stream = None


@dataclass(frozen=True)
class LongCommand(ABC):
    """A command that other programs may start."""

    json_progress: bool = field(default=False, kw_only=True)
    """Write what happens to standard output, a JSON object a line; see docs/reference/json-progress.md."""

    def run(self) -> None:
        """Do the work."""
        with json_lines(type(self).__name__.lower()) if self.json_progress else nullcontext():
            self.work()

    @abstractmethod
    def work(self) -> None:
        """What the command does."""
        ...
