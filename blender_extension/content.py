# SPDX-License-Identifier: GPL-3.0-or-later
"""`scene.json` and the files beside it, which `shinypartial convert --to extension` writes. Without Blender."""

import json
import zlib
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from .program import SCENE_VERSION, Problem

SCENE = "scene.json"
PREDICTION = "prediction.json"


class Content:
    """What a prediction has for Blender, all numbers in Blender's own conventions."""

    def __init__(self, folder: Path) -> None:
        """Problem where files are missing, damaged or of another version."""
        self.folder = folder
        try:
            self.table: dict[str, Any] = json.loads((folder / SCENE).read_text(encoding="utf-8"))
            version = self.table["format_version"]
            missing = [name for name in self.table["files"] if not (folder / name).is_file()]
        except (OSError, ValueError, KeyError, TypeError):
            raise Problem(f"{folder / SCENE} is missing or damaged. Import the prediction again") from None
        if version != SCENE_VERSION:
            raise Problem(
                f"This extension reads version {SCENE_VERSION} of scene.json, and panoless wrote version "
                f"{version}. Update the extension"
            )
        if missing:
            raise Problem(f"{', '.join(missing)} is missing in {folder}. Import the prediction again")

    @property
    def name(self) -> str:
        """Of the prediction's folder."""
        return Path(self.table["prediction"]).name

    def arrays(self, name: str) -> dict[str, np.ndarray] | None:
        """Those of an .npz; None where the prediction has none."""
        if name not in self.table["files"]:
            return None
        try:
            with (self.folder / name).open("rb") as stream, np.load(stream) as file:
                found = dict(file)
            if not {"vertices", "corners", "sizes"} <= set(found):
                raise ValueError("it holds no mesh")
            return found
        except (OSError, ValueError, BadZipFile, zlib.error) as error:
            raise Problem(f"{self.folder / name} is damaged ({error}). Import the prediction again") from None


def check_prediction(folder: Path) -> None:
    """Problem unless the folder looks like a whole prediction."""
    if not (folder / PREDICTION).is_file():
        raise Problem(
            f"There is no prediction in {folder}: {PREDICTION} is missing. Choose the folder that a fit wrote"
        )
