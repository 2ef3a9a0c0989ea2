"""Stages that need not be repeated: what a stage was given and what it found lie in one file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from shinypartial.io.events import StageBegun, begin_stage, emit
from shinypartial.io.files import read_json, write_json
from shinypartial.io.records import read_record, write_record

Found = TypeVar("Found")


def stage(folder: Path, name: str, given: dict[str, Any], found_type: type[Found], work: Callable[[], Found]) -> Found:
    """What `work` returns, a dataclass, or what it returned when it was given the same before.

    `folder`/`name`.json holds both, as `given` and `found`. `given` holds what JSON does.
    """
    path = folder / f"{name}.json"
    if path.exists():
        stored = read_json(path, f"what the stage {name} found")
        if isinstance(stored, dict) and stored.get("given") == given:
            begin_stage(name, found_before=True)
            return read_record(found_type, stored.get("found"), str(path), remedy="Delete that file.")
        path.unlink()
    emit(StageBegun(name, False))
    found = work()
    write_json(path, {"given": given, "found": write_record(found)})
    return found
