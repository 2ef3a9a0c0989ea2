"""The newest folder stands in for one that was not named."""

from pathlib import Path


def announce_newest(what: str, folder: Path) -> Path:
    """Say which folder was taken because none was named; return it."""
    print(f"Newest {what}: {folder}")
    return folder
