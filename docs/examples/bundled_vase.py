"""Make the bundled dataset shinypartial/data/tiny-vase from a rendered one: all that a fit and its scores need.

    shinypartial generate --scene vase --resolution 128 --train 28 --test 4 --output datasets/vase-128
    python docs/examples/bundled_vase.py datasets/vase-128 shinypartial/data/tiny-vase

Training views keep their pictures and normals, as a plain folder has them; test views keep everything, so that they are
scored exactly. The environment is averaged to 128 × 256.
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np

from shinypartial.dataset.read import open_dataset, read_environment
from shinypartial.dataset.schema import LICENSES, MANIFEST, SPLITS
from shinypartial.dataset.write import complete_dataset, write_environment
from shinypartial.io.files import write_json

ENVIRONMENT_HEIGHT = 128


def main(source: Path, target: Path) -> None:
    """Write the folder from scratch."""
    dataset = open_dataset(source)
    shutil.rmtree(target, ignore_errors=True)
    for split in SPLITS:
        (target / split).mkdir(parents=True)
        shutil.copyfile(source / f"transforms_{split}.json", target / f"transforms_{split}.json")
        for frame in dataset.split(split):
            for path in (frame.png, frame.normal_png) if split == "train" else (*frame.files, frame.self_png):
                shutil.copyfile(path, target / split / path.name)
    environment = read_environment(dataset)
    block = environment.shape[0] // ENVIRONMENT_HEIGHT
    smaller = environment.reshape(ENVIRONMENT_HEIGHT, block, 2 * ENVIRONMENT_HEIGHT, block, 3).mean((1, 3))
    write_environment(target, smaller.astype(np.float32), cube_resolution=ENVIRONMENT_HEIGHT // 2)
    manifest = dataset.manifest
    recipe = {
        "subset_of": {"name": "vase", "recipe": manifest["recipe"]},
        "hemisphere_axis": manifest["recipe"]["hemisphere_axis"],
    }
    write_json(target / MANIFEST, {**manifest, "complete": False, "recipe": recipe})
    licenses = json.loads((source / LICENSES).read_text(encoding="utf-8"))
    complete_dataset(target, licenses, manifest["statistics"])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
