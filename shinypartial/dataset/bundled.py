"""Datasets that come with the package, and which folder a name means."""

from pathlib import Path

from shinypartial.core.errors import InputError
from shinypartial.dataset.read import DEFAULT_FOLDER, newest_dataset

BUNDLED = Path(__file__).resolve().parents[1] / "data"


def bundled_names() -> list[str]:
    """Names of the datasets that come with the package."""
    return sorted(path.parent.name for path in BUNDLED.glob("*/transforms_train.json"))


def bundled_dataset(name: str) -> Path:
    """Folder of a dataset that comes with the package; InputError when there is none of that name."""
    if name not in bundled_names():
        raise InputError(
            expected=f"the name of a bundled dataset: {', '.join(bundled_names())}",
            found=repr(name),
            remedy="Choose one of them, or name a folder.",
        )
    return BUNDLED / name


def bundled_photographs(name: str) -> tuple[Path, ...]:
    """Photographs that come with the package by the name of their folder, `lobby-ball`; empty where none have it."""
    return tuple(sorted((BUNDLED / name).glob("*.jpg"))) if name == Path(name).name else ()


def resolve_dataset(dataset: str | Path | None = None) -> Path:
    """The folder that a user means: a path that exists, a bundled name, or without either the newest below ./datasets.

    Raises InputError when there is nothing below ./datasets.
    """
    if dataset is not None:
        path = Path(dataset)
        return bundled_dataset(path.name) if not path.exists() and str(path) in bundled_names() else path
    if not any(DEFAULT_FOLDER.glob("*/transforms_train.json")):
        names = " or ".join(f"`panoless fit {name}`" for name in bundled_names())
        raise InputError(
            expected=f"a dataset below ./{DEFAULT_FOLDER}",
            found="none",
            remedy=f"Try a bundled one: {names}; make one: `shinypartial generate --scene vase`; or name a folder.",
        )
    newest = newest_dataset()
    print(f"No dataset named; taking the newest one: {newest}")
    return newest
