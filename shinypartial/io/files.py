"""Files appear whole or not at all: temporary names, renames, one writer a folder, checksums, the newest of a kind."""

import contextlib
import errno
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from shinypartial.core.errors import InputError
from shinypartial.io.system import lock_folder

PARTIAL_PREFIX = ".partial-"


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
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


def copy_or_link(old: Path, new: Path, link: bool) -> None:
    """Copy or hard-link a file, whole or not at all; InputError where the file system can't link."""
    if not link:
        with atomic_write(new) as temporary:
            shutil.copyfile(old, temporary)
        return
    new.parent.mkdir(parents=True, exist_ok=True)
    temporary = new.with_name(f"{PARTIAL_PREFIX}{new.name}")
    temporary.unlink(missing_ok=True)
    try:
        os.link(old, temporary)
    except OSError as error:
        if error.errno not in (errno.EXDEV, errno.EPERM, errno.ENOTSUP, errno.EMLINK):
            raise
        raise InputError(
            expected=f"a file system that can link {old} into {new.parent}",
            found=error.strerror or "a failed link",
            remedy="Leave out --link, so that files are copied.",
        ) from None
    temporary.replace(new)


def link_or_copy(old: Path, new: Path) -> None:
    """Hard-link a file, or copy it where the file system can't link, whole or not at all."""
    try:
        copy_or_link(old, new, link=True)
    except InputError:
        copy_or_link(old, new, link=False)


def remove_partial_files(root: Path) -> None:
    """Delete the temporary files of a process that was killed while it wrote below `root`."""
    for path in root.rglob(f"{PARTIAL_PREFIX}*"):
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold `folder`, made where it is missing, against every other run that writes to it.

    `lock_folder` says what keeps it. Raises InputError when another run holds the folder or a file is in its place.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(expected=f"a folder at {folder}", found="a file", remedy="Choose another --output.")
    folder.mkdir(parents=True, exist_ok=True)
    try:
        unlock = lock_folder(folder)
    except BlockingIOError:
        raise InputError(
            expected=f"to be the only run that writes to {folder}",
            found="another run that is writing there",
            remedy="Wait until it ends, or choose another --output.",
        ) from None
    try:
        yield
    finally:
        unlock()


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_between(page: Path, name: str, lines: Iterable[str]) -> bool:
    """Replace the lines between `<!-- NAME:begin -->` and `<!-- NAME:end -->` of a page; False without these marks."""
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    before, begin, rest = text.partition(f"<!-- {name}:begin -->")
    _, end, after = rest.partition(f"<!-- {name}:end -->")
    if not end:
        return False
    write_text(page, "\n".join([before + begin, "", *lines, "", end + after]))
    return True


def write_json(path: Path, content: Any) -> None:
    """Write strict JSON (no NaN or infinity), whole or not at all."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: Path, what: str) -> Any:
    """Read a JSON file; `what` names it in the message when it is missing, broken or nested too deeply."""
    if not path.is_file():
        raise InputError(expected=f"{what} at {path}", found="no such file", remedy="Check the path of the folder.")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # Of text, of JSON, and of a number with thousands of digits.
        raise InputError(
            expected=f"{what} in {path} to be JSON",
            found=str(error),
            remedy="Restore the file, or make the folder again.",
        ) from None


def read_table(path: Path, what: str) -> dict[str, Any]:
    """Read a JSON file that holds a table; raises InputError, as `read_json` does, also for anything else in it."""
    content = read_json(path, what)
    if not isinstance(content, dict):
        raise InputError(
            expected=f"{what} in {path} to be a table",
            found="something else",
            remedy="Restore the file, or make the folder again.",
        )
    return content


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes, as lower-case hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sha256_of_files(paths: Iterable[Path]) -> str:
    """SHA-256 of the names and contents of files, in their order."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(f"{path.name} {sha256_of(path)}\n".encode())
    return digest.hexdigest()


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
