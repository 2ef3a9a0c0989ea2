"""Lists of SHA-256 sums in the format of sha256sum, and what a folder that differs from its list has lost or gained."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from shinypartial.dataset.schema import CHECKSUMS
from shinypartial.dataset.violations import Violation
from shinypartial.io.files import PARTIAL_PREFIX, sha256_of, write_text

#: A comment to sha256sum; it distinguishes damage of the list itself from damage of a file.
SEAL = "# sha256 of the lines below: "
RESTORE = "Download or copy it again."
#: What hosts and download tools add beside a release.
HIDDEN = "."


@dataclass(frozen=True)
class ListedFile:
    """A file of a folder, by its path with forward slashes, and the SHA-256 that it has or should have."""

    name: str
    sha256: str


def list_files(root: Path) -> list[str]:
    """Every file below `root` but its own list of checksums, sorted, relative, with forward slashes."""
    files = (path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
    return sorted(name for name in files if name != CHECKSUMS)


def write_sealed_checksums(root: Path, files: Sequence[ListedFile]) -> None:
    """Write the list with a first line that is the checksum of the rest."""
    body = "".join(f"{file.sha256}  {file.name}\n" for file in sorted(files, key=lambda file: file.name))
    write_text(root / CHECKSUMS, f"{SEAL}{hashlib.sha256(body.encode()).hexdigest()}\n{body}")


def check_sealed(root: Path) -> Iterator[Violation]:
    """Each file that is damaged, missing or not listed; the list itself when it is the damaged one.

    Files in hidden folders at the top are named as warnings: hosts and download tools leave such behind.
    """
    listed = _read_sealed(root / CHECKSUMS)
    if listed is None:
        yield Violation(
            CHECKSUMS, "the list of checksums is missing or damaged, so nothing else can be judged", RESTORE
        )
        return
    present = set(list_files(root))
    for file in listed:
        if file.name not in present:
            yield Violation(file.name, f"the file is listed in {CHECKSUMS} but missing", RESTORE)
        elif sha256_of(root / file.name) != file.sha256:
            yield Violation(file.name, "the content has changed since the release was made", RESTORE)
    for name in sorted(present - {file.name for file in listed}):
        hidden = name.startswith(HIDDEN) and not name.startswith(PARTIAL_PREFIX)
        remedy = "Delete it if it doesn't belong there."
        yield Violation(name, f"the file is not listed in {CHECKSUMS}", remedy, warning=hidden)


def _read_sealed(path: Path) -> list[ListedFile] | None:
    """The listed files; None when the list is missing, or not the one that was written."""
    if not path.is_file():
        return None
    first, _, body = path.read_bytes().partition(b"\n")
    if first != f"{SEAL}{hashlib.sha256(body).hexdigest()}".encode():
        return None
    return listed_files(body.decode())


def listed_files(text: str) -> list[ListedFile]:
    """The files of a list, which has a line each."""
    lines = text.removesuffix("\n").split("\n")
    return [ListedFile(name, digest) for digest, _, name in (line.partition("  ") for line in lines)]
