"""Files appear whole or not at all: temporary names, renames, checksums, and the newest folder of a kind."""

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from shinypartial.errors import InputError

PARTIAL_PREFIX = ".partial-"


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` on success, delete it on any failure.

    The temporary name keeps the suffix, because image writers choose their format by it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=PARTIAL_PREFIX, suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def remove_partial_files(root: Path) -> None:
    """Delete the temporary files of a process that was killed while it wrote below `root`."""
    for path in root.rglob(f"{PARTIAL_PREFIX}*"):
        path.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Any) -> None:
    """Write strict JSON (no NaN or infinity), whole or not at all."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: Path, what: str) -> Any:
    """Read a JSON file; `what` names it in the message when it is missing or broken."""
    if not path.is_file():
        raise InputError(expected=f"{what} at {path}", found="no such file", remedy="Check the path of the folder.")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(
            expected=f"{what} in {path} to be JSON",
            found=str(error),
            remedy="Restore the file, or make the folder again.",
        ) from None


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes, as lower-case hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def newest_folder(parent: Path, marker: str, what: str, remedy: str, unless_suffix: str | None = None) -> Path:
    """The folder directly below `parent` whose file `marker` was written last; names with that ending don't count."""
    found = [path.parent for path in parent.glob(f"*/{marker}")]
    found = [folder for folder in found if unless_suffix is None or not folder.name.endswith(unless_suffix)]
    if not found:
        raise InputError(
            expected=f"{what} below {parent.resolve()}",
            found="none (no folder holds " + marker + ")",
            remedy=remedy,
        )
    return max(found, key=lambda folder: (folder / marker).stat().st_mtime)
