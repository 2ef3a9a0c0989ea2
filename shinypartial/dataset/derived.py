"""A dataset folder made from another one: the same files, copied, linked or made again.

A run that is killed continues when it is started again, and a folder that holds anything else is refused.
"""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from shinypartial import __version__
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import CHECKSUMS, LICENSES, Dataset
from shinypartial.dataset.write import claim_folder, complete_dataset, is_complete
from shinypartial.io.files import copy_or_link, folder_lock, read_json, remove_partial_files
from shinypartial.io.progress import Progress


@dataclass(frozen=True)
class Job:
    """Files of the new folder that come into being together, and what makes them."""

    files: tuple[Path, ...]
    make: Callable[[], None]

    @classmethod
    def copy(cls, old: Path, new: Path, link: bool) -> "Job":
        """A file that stays the same, as a copy or as a hard link."""
        return cls((new,), partial(copy_or_link, old, new, link))

    @property
    def done(self) -> bool:
        """Whether all of its files are there; each is written whole."""
        return all(path.exists() for path in self.files)


def open_source(source: Path, root: Path, *, shared_names: bool = False) -> Dataset:
    """The dataset to derive from, as `open_dataset` opens it; InputError where the new folder is that or lies in it."""
    if source.resolve() in (root.resolve(), *root.resolve().parents):
        raise InputError(
            expected=f"an output folder apart from the source {source}", found=str(root), remedy="Change --output."
        )
    return open_dataset(source, shared_names=shared_names)


def place_of(path: Path, source: Dataset, root: Path) -> Path:
    """Where a file of the source has its counterpart in the new folder; InputError for one that lies elsewhere."""
    below = Path(os.path.relpath(path, source.root))
    if ".." in below.parts:
        raise InputError(
            expected=f"all pictures of {source.root} within that folder",
            found=str(path),
            remedy="Move it there and correct the transforms.",
        )
    return root / below


def write_derived(
    root: Path,
    licenses: list[dict[str, str]],
    recipe: dict[str, Any],
    jobs: Iterable[Job],
    title: str,
    finish: Callable[[], dict[str, Any]],
) -> int:
    """Do the jobs that are not done, then `finish`, which gives the manifest's statistics; return how many files came.

    Raises InputError when the folder holds something else.
    """
    every = list({job.files: job for job in jobs}.values())
    with folder_lock(root):
        claim_folder(root, recipe, {"shinypartial": __version__})
        missing = [job for job in every if not job.done]
        if is_complete(root) and not missing:
            return 0
        (root / CHECKSUMS).unlink(missing_ok=True)
        remove_partial_files(root)
        progress = Progress(title, len(every), len(every) - len(missing))
        for job in missing:
            job.make()
            progress.advance()
        complete_dataset(root, licenses, finish())
    return sum(len(job.files) for job in missing)


def licenses_of(source: Dataset) -> list[dict[str, str]]:
    """A row for each asset of a dataset, also of one that states none."""
    path = source.root / LICENSES
    if path.exists():
        rows = read_json(path, "the licenses")
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise InputError(
                expected=f"a list with a row for each asset in {path}",
                found="something else",
                remedy="Restore the file, or delete it: the copy then says that its license is that of the source.",
            )
        return rows
    return [{"asset": "images", "license": "that of the source", "source": f"dataset {source.name}"}]
