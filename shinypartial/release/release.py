"""Make what a researcher uploads from finished datasets, and check a copy of it.

RELEASE/release.json       name, version, and the hash of each dataset; written first, it claims the folder
RELEASE/data/NAME/         the dataset folders, byte for byte
RELEASE/archives/NAME.tar  the same, one file each
RELEASE/README.md croissant.json LICENSES.json
RELEASE/SHA256SUMS         written last: a folder without it is unfinished, and the same command finishes it
"""

import re
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from shinypartial.core.command_line import command_line
from shinypartial.core.errors import InputError
from shinypartial.dataset.plain import is_plain
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import CHECKSUMS, LICENSES, Dataset
from shinypartial.dataset.validate import validate
from shinypartial.dataset.violations import Violation
from shinypartial.io.files import (
    PARTIAL_PREFIX,
    atomic_write,
    folder_lock,
    read_table,
    remove_partial_files,
    sha256_of,
    write_json,
    write_text,
)
from shinypartial.io.progress import Progress
from shinypartial.release.archive import write_archive
from shinypartial.release.card import card, citation, description
from shinypartial.release.checksums import ListedFile, check_sealed, list_files, listed_files, write_sealed_checksums
from shinypartial.release.croissant import croissant
from shinypartial.release.publication import (
    ARCHIVES,
    CARD,
    CROISSANT,
    DATA,
    FORMAT,
    FORMAT_VERSION,
    PORTABLE_NAME,
    RELEASE,
    Archive,
    Publication,
    license_rows,
)

#: As many strangers as a message names.
NAMED = 3
DOCUMENTS = (RELEASE, CARD, CROISSANT, LICENSES)


@dataclass(frozen=True)
class Released:
    """What a run of `release` did; `written` counts data files and archives that were not there yet."""

    root: Path
    written: int
    kept: int


@dataclass(frozen=True)
class _Source:
    """A dataset to be released and its files with their checksums, its own list included."""

    dataset: Dataset
    files: tuple[ListedFile, ...]


def release(
    roots: Sequence[Path], output: Path, publication: Publication, archive_suffix: str = ".tar", progress: bool = False
) -> Released:
    """Make the release folder `output`, or finish what an earlier run began there.

    Raises InputError when a dataset is incomplete or breaks a promise of its format, when two have one name, or when
    `output` holds something else or another run writes there.
    """
    sources = tuple(_open(root, output, progress) for root in roots)
    _check_names([source.dataset.name for source in sources])
    with folder_lock(output):
        _claim(output, publication, archive_suffix, sources)
        return _make(sources, output, publication, archive_suffix, progress)


def _make(
    sources: tuple[_Source, ...], output: Path, publication: Publication, archive_suffix: str, progress: bool
) -> Released:
    """All but the claim, which says what the folder is for."""
    remove_partial_files(output)
    _refuse_strangers(output, archive_suffix, sources)
    (output / CHECKSUMS).unlink(missing_ok=True)
    total = sum(len(source.files) + 1 for source in sources)
    counter = Progress("Releasing", total) if progress else None
    written = 0
    archives = []
    for source in sources:
        folder = output / DATA / source.dataset.name
        for file in source.files:
            written += _copy(source.dataset.root / file.name, folder / file.name, file.sha256)
            if counter:
                counter.advance()
        path = output / ARCHIVES / f"{source.dataset.name}{archive_suffix}"
        written += write_archive(path, folder, [file.name for file in source.files])
        archives.append(Archive(path.relative_to(output).as_posix(), sha256_of(path), path.stat().st_size))
        if counter:
            counter.advance(path.name)
    _write_documents(output, publication, tuple(source.dataset for source in sources), archives)
    _write_checksums(output, sources, archives)
    return Released(output, written, total - written)


def is_release(root: Path) -> bool:
    """Whether a folder is a release, or one that was begun."""
    return (root / RELEASE).is_file()


def recorded_date(root: Path) -> str | None:
    """The date of the release that was begun in a folder, so that finishing it on another day changes nothing."""
    date = read_table(root / RELEASE, "the release").get("date") if is_release(root) else None
    return date if isinstance(date, str) else None


def validate_release(root: Path, progress: bool = False) -> list[Violation]:
    """Every file of a release that is damaged, missing or too many, then every promise that its datasets break."""
    violations = list(check_sealed(root))
    if any(not each.warning for each in violations):
        return sorted(violations, key=lambda each: each.warning)
    for folder in sorted(path for path in (root / DATA).iterdir() if path.is_dir()):
        found = validate(folder, progress)
        violations += [replace(each, file=f"{DATA}/{folder.name}/{each.file}") for each in found]
    return sorted(violations, key=lambda each: each.warning)


def _open(root: Path, output: Path, progress: bool) -> _Source:
    """A dataset that keeps every promise of the format, warnings apart."""
    resolved, target = root.resolve(), output.resolve()
    if target.is_relative_to(resolved) or resolved.is_relative_to(target):
        raise InputError(
            expected=f"an output folder beside the dataset {root}",
            found=f"{output}, which lies in it or holds it",
            remedy="Choose another --output.",
        )
    broken = [each for each in validate(root, progress) if not each.warning]
    if broken:
        first = f"{broken[0].file}: {broken[0].problem}"
        more = f", and {len(broken) - 1} more" if len(broken) > 1 else ""
        raise InputError(
            expected=f"a dataset that keeps every promise of the format in {root}",
            found=f"{first}{more}",
            remedy=f"{broken[0].remedy} `{command_line('shinypartial', 'validate', root)}` lists everything.",
        )
    dataset = open_dataset(root)
    if is_plain(root, dataset.manifest):
        raise InputError(
            expected=f"a rendered dataset in {root}",
            found="the plain layout, without ground truth and with images of another origin",
            remedy="Release what `shinypartial generate` made; of a subset publish the `shinypartial subset` command.",
        )
    files = listed_files((root / CHECKSUMS).read_text(encoding="utf-8"))
    return _Source(dataset, (*files, ListedFile(CHECKSUMS, sha256_of(root / CHECKSUMS))))


def _check_names(names: list[str]) -> None:
    strange = [name for name in names if not re.fullmatch(PORTABLE_NAME, name)]
    if strange:
        raise InputError(
            expected="dataset folders named with letters, digits, `.`, `_` and `-`",
            found=strange[0],
            remedy="Rename the folder.",
        )
    if not names or len({name.lower() for name in names}) < len(names):
        raise InputError(
            expected="at least one dataset, each folder with a name of its own",
            found=", ".join(names) or "none",
            remedy="Name each dataset once; rename folders of the same name.",
        )


def _claim(output: Path, publication: Publication, archive_suffix: str, sources: Sequence[_Source]) -> None:
    """Make `output` the folder of this release; refuse one that holds another release or something else."""
    content: dict[str, Any] = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **asdict(publication),
        "archive": archive_suffix,
        "datasets": [{"name": source.dataset.name, "sha256": source.files[-1].sha256} for source in sources],
    }
    if is_release(output):
        earlier = read_table(output / RELEASE, "the release")
        different = [key for key, value in content.items() if earlier.get(key) != value]
        if different:
            raise InputError(
                expected=f"an output folder that is new or belongs to the same release, at {output}",
                found=f"a release with another {', '.join(different)}",
                remedy="Choose another --output, or delete that folder.",
            )
        return
    if not all(path.name.startswith(PARTIAL_PREFIX) for path in output.iterdir()):
        raise InputError(
            expected=f"a new or empty output folder at {output}",
            found="files that are not a release",
            remedy="Choose another --output.",
        )
    write_json(output / RELEASE, content)


def _refuse_strangers(output: Path, archive_suffix: str, sources: Sequence[_Source]) -> None:
    known = {CHECKSUMS, *DOCUMENTS}
    for source in sources:
        name = source.dataset.name
        known |= {f"{DATA}/{name}/{file.name}" for file in source.files} | {f"{ARCHIVES}/{name}{archive_suffix}"}
    strangers = [name for name in list_files(output) if name not in known]
    if strangers:
        more = f" and {len(strangers) - NAMED} more" if len(strangers) > NAMED else ""
        raise InputError(
            expected=f"only files of this release in {output}",
            found=", ".join(strangers[:NAMED]) + more,
            remedy="Move them elsewhere, or choose another --output.",
        )


def _copy(source: Path, target: Path, sha256: str) -> bool:
    """Copy a file unless its copy is there already; return whether it was copied."""
    if target.is_file() and sha256_of(target) == sha256:
        return False
    with atomic_write(target) as temporary:
        shutil.copyfile(source, temporary)
        if sha256_of(temporary) != sha256:
            raise InputError(
                expected=f"{source} as its {CHECKSUMS} has it",
                found="another content: it changed meanwhile, or the copy is damaged",
                remedy="Validate the dataset, check the disk, and run the same command again.",
            )
    return True


def _write_documents(
    output: Path, publication: Publication, datasets: tuple[Dataset, ...], archives: list[Archive]
) -> None:
    write_json(output / LICENSES, [asdict(row) for dataset in datasets for row in license_rows(dataset)])
    metadata = croissant(publication, description(datasets), citation(publication), datasets, archives)
    write_json(output / CROISSANT, metadata)
    write_text(output / CARD, card(publication, datasets, archives))


def _write_checksums(output: Path, sources: Sequence[_Source], archives: Sequence[Archive]) -> None:
    """Data keeps the checksums that were verified when it was copied."""
    listed = [ListedFile(name, sha256_of(output / name)) for name in DOCUMENTS]
    listed += [ListedFile(archive.name, archive.sha256) for archive in archives]
    for source in sources:
        listed += [replace(file, name=f"{DATA}/{source.dataset.name}/{file.name}") for file in source.files]
    write_sealed_checksums(output, listed)
