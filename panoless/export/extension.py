"""The extension for Blender as the file that Blender installs."""

import zipfile
from dataclasses import dataclass
from pathlib import Path

from shinypartial.core.errors import InputError
from shinypartial.io.files import atomic_write

FOLDER, MANIFEST = "blender_extension", "blender_manifest.toml"
#: In a wheel, and in a checkout.
PLACES = (Path(__file__).resolve().parents[1] / FOLDER, Path(__file__).resolve().parents[2] / FOLDER)
#: Of every entry, so that equal sources make equal files.
NO_TIME = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Extension:
    """Write the extension for Blender 4.2 and newer; see docs/how-to/blender-extension.md."""

    output: Path = Path("panoless-blender.zip")
    """File to write."""

    def run(self) -> None:
        """Write and say how it is installed."""
        print(f"Wrote {write_extension(self.output)}")
        print("Drop it into Blender's window, or: Edit > Preferences > Get Extensions > Install from Disk.")


def extension_folder() -> Path:
    """Where its sources are; InputError where this installation lacks them."""
    found = next((folder for folder in PLACES if (folder / MANIFEST).is_file()), None)
    if found is None:
        raise InputError(
            expected=f"the extension's sources at {' or '.join(map(str, PLACES))}",
            found="none",
            remedy="Install panoless again.",
        )
    return found


def write_extension(path: Path) -> Path:
    """Write the zip file; equal sources make equal bytes."""
    if path.suffix != ".zip":
        raise InputError(expected="--output FILE.zip", found=str(path), remedy="Give the file that suffix.")
    folder = extension_folder()
    files = sorted(each for each in folder.iterdir() if each.suffix in (".py", ".toml") or each.name == "LICENSE")
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for each in files:
            archive.writestr(zipfile.ZipInfo(each.name, NO_TIME), each.read_bytes(), zipfile.ZIP_DEFLATED)
    return path
