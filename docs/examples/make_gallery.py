"""Run the examples of docs/gallery in build/gallery, and keep the picture of each in docs/images/gallery.

python docs/examples/make_gallery.py            # all; about a quarter of an hour
python docs/examples/make_gallery.py ball vase  # some
"""

import os
import runpy
import shutil
import sys
from contextlib import chdir
from pathlib import Path
from unittest.mock import patch

from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "docs" / "gallery").glob("*.py"))
WIDTH = 960  # Of a picture, in pixels.


def run_example(path: Path, folder: Path) -> Path:
    """Run one in a new folder, and return its picture. The programs of this Python come first."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with chdir(folder), patch.dict(os.environ, PATH=programs):
        return Path(runpy.run_path(str(path))["picture"]).resolve(strict=True)


def keep_picture(picture: Path, name: str) -> None:
    """Copy a drawing; save anything else as a JPEG that is no wider than a page."""
    target = ROOT / "docs" / "images" / "gallery" / name
    target.parent.mkdir(exist_ok=True)
    if picture.suffix == ".svg":
        shutil.copyfile(picture, target.with_suffix(".svg"))
        return
    image = Image.open(picture).convert("RGB")
    image.thumbnail((WIDTH, WIDTH))
    image.save(target.with_suffix(".jpg"), quality=85)


if __name__ == "__main__":
    for each in EXAMPLES:
        if each.stem in sys.argv[1:] or not sys.argv[1:]:
            keep_picture(run_example(each, ROOT / "build" / "gallery" / each.stem), each.stem)
