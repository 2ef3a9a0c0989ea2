"""Archives with the same bytes wherever and whenever they are made: sorted names, fixed owner, mode and time."""

import gzip
import hashlib
import io
import tarfile
from collections.abc import Sequence
from pathlib import Path

from shinypartial.io.files import atomic_write, sha256_of

#: 1980-01-01: GNU tar warns about files from 1970, and zip knows no earlier year.
FIXED_TIME_S = 315532800
FILE_MODE = 0o644
GZIP_LEVEL = 6
GZIP_SUFFIX = ".gz"


class _Digest(io.RawIOBase):
    """A stream that keeps nothing of what is written but its SHA-256."""

    def __init__(self) -> None:
        self.sha256 = hashlib.sha256()

    def writable(self) -> bool:
        return True

    def write(self, data: object) -> int:
        view = memoryview(data)  # type: ignore[arg-type]
        self.sha256.update(view)
        return view.nbytes


def write_archive(path: Path, folder: Path, files: Sequence[str]) -> bool:
    """Archive the files of a folder under the folder's name; return whether the archive had to be written.

    `path` ends with `.tar` or `.tar.gz`. An archive that is there and would be the same is kept. The bytes depend on
    names and contents only (`.tar.gz` also on the version of zlib).
    """
    compressed = path.suffix == GZIP_SUFFIX
    if path.is_file():
        digest = _Digest()
        _write(digest, folder, files, compressed)
        if digest.sha256.hexdigest() == sha256_of(path):
            return False
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        _write(stream, folder, files, compressed)
    return True


def _write(stream: io.RawIOBase | io.BufferedIOBase, folder: Path, files: Sequence[str], compressed: bool) -> None:
    if not compressed:
        _write_tar(stream, folder, files)
        return
    with gzip.GzipFile(filename="", mode="wb", compresslevel=GZIP_LEVEL, fileobj=stream, mtime=0) as packed:  # type: ignore[call-overload]
        _write_tar(packed, folder, files)


def _write_tar(stream: io.RawIOBase | io.BufferedIOBase, folder: Path, files: Sequence[str]) -> None:
    with tarfile.open(fileobj=stream, mode="w|", format=tarfile.PAX_FORMAT) as archive:  # type: ignore[call-overload]
        for name in sorted(files):
            source = folder / name
            entry = tarfile.TarInfo(f"{folder.name}/{name}")
            entry.size, entry.mtime, entry.mode = source.stat().st_size, FIXED_TIME_S, FILE_MODE
            with source.open("rb") as content:
                archive.addfile(entry, content)
