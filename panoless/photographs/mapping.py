"""Structure from motion by pycolmap, a program that `structure` starts: `python -m panoless.photographs.mapping JOB`.

What COLMAP says of its steps goes to standard error, and the largest model to a folder. So a crash of COLMAP ends this
process alone.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from panoless.photographs.models import pycolmap_module
from shinypartial.io.files import read_json
from shinypartial.io.records import read_record

SEED = 0
BLOCK_FRAMES = 10
"""Where each frame is matched with each, in blocks of so many by as many: after each block progress is shown."""


@dataclass(frozen=True)
class Job:
    """What is to be matched, and where its results go."""

    frames: Path
    """Folder of pictures…"""
    names: tuple[str, ...]
    """…and their names in it."""
    masks: Path | None
    """Folder of NAME.png for NAME, black where nothing is to be looked at."""
    one_camera: bool
    """Whether all pictures have the same intrinsics."""
    neighbors: int | None
    """Each frame is matched with so many next ones; None: with each."""
    work: Path
    """Folder for the database and all models."""
    model: Path
    """Folder of the largest model; it does not appear where no two frames fit together."""


def find_structure(job: Job) -> None:
    """SIFT, matching and incremental mapping; the model with the most frames is written in COLMAP's binary format."""
    colmap = pycolmap_module()
    colmap.logging.minloglevel = 0  # Progress is read from what it says.
    colmap.set_random_seed(SEED)
    database = job.work / "database.db"
    reader = colmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    if job.masks is not None:
        reader.mask_path = str(job.masks)
    mode = colmap.CameraMode.SINGLE if job.one_camera else colmap.CameraMode.PER_IMAGE
    colmap.extract_features(database, job.frames, image_names=job.names, camera_mode=mode, reader_options=reader)
    if job.neighbors is None:
        blocks = colmap.ExhaustivePairingOptions(block_size=BLOCK_FRAMES)
        colmap.match_exhaustive(database, pairing_options=blocks)
    else:
        pairing = colmap.SequentialPairingOptions(overlap=job.neighbors, loop_detection=False)
        colmap.match_sequential(database, pairing_options=pairing)
    options = colmap.IncrementalPipelineOptions(random_seed=SEED)
    models = colmap.incremental_mapping(database, job.frames, job.work, options=options)
    if models:
        job.model.mkdir()
        max(models.values(), key=lambda one: one.num_reg_images()).write_binary(str(job.model))


if __name__ == "__main__":
    find_structure(read_record(Job, read_json(Path(sys.argv[1]), "the job"), sys.argv[1], remedy="Run it again."))
