"""What a release is called, who made it, and which datasets it holds: the facts that its documents are written from."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import LICENSES, Dataset
from shinypartial.io.files import read_json

RELEASE = "release.json"
CARD = "README.md"
CROISSANT = "croissant.json"
DATA = "data"
ARCHIVES = "archives"
FORMAT = "shinypartial-release"
FORMAT_VERSION = 1
DATE = r"\d{4}-\d{2}-\d{2}"
VERSION = r"\d+\.\d+\.\d+"
#: Names that every host, archive and URL takes as they are.
PORTABLE_NAME = r"[A-Za-z0-9][A-Za-z0-9._-]*"
#: Identifiers of https://spdx.org/licenses, as far as words go.
SPDX_IDENTIFIER = r"[A-Za-z0-9][A-Za-z0-9.+-]*"


@dataclass(frozen=True)
class Publication:
    """Name, version (MAJOR.MINOR.PATCH), date (YYYY-MM-DD) and creator of a release, and where it will be found."""

    name: str
    version: str
    date: str
    creator: str
    url: str | None

    def __post_init__(self) -> None:
        for value, pattern, what in (
            (self.version, VERSION, "a version such as 1.0.0"),
            (self.date, DATE, "a date such as 2030-12-31"),
            (self.name, PORTABLE_NAME, "a name of letters, digits, `.`, `_` and `-`"),
            (self.creator, r"[^\n]*\S[^\n]*", "the name of the creator in one line"),
            (self.url or "https://", r"https?://\S*", "an address that begins with https://"),
        ):
            if not re.fullmatch(pattern, value):
                raise InputError(expected=f"{what} for the release", found=repr(value), remedy="Correct the option.")


@dataclass(frozen=True)
class LicenseRow:
    """An asset of a dataset, its license (an SPDX identifier where there is one) and where it comes from."""

    dataset: str
    asset: str
    license: str
    source: str


@dataclass(frozen=True)
class Archive:
    """A file below the release that holds one dataset; `name` is its path with forward slashes."""

    name: str
    sha256: str
    size: int


def license_rows(dataset: Dataset) -> tuple[LicenseRow, ...]:
    """The rows of a valid dataset's LICENSES.json; an asset without a name is called by its file."""
    rows: list[dict[str, Any]] = read_json(dataset.root / LICENSES, "the licenses")
    assets = [str(row.get("asset") or row.get("file") or "everything") for row in rows]
    return tuple(
        LicenseRow(dataset.name, asset, row["license"], row["source"]) for asset, row in zip(assets, rows, strict=True)
    )


def license_names(datasets: tuple[Dataset, ...]) -> list[str]:
    """Every license that occurs, once."""
    return sorted({row.license for dataset in datasets for row in license_rows(dataset)})


def top_pictures(root: Path) -> list[str]:
    """Pictures directly in a dataset folder, such as an overview of its views."""
    return sorted(path.name for path in root.glob("*.png"))
