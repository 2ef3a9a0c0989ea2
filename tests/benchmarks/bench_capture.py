"""How fast photographs become a dataset: `python -m tests.benchmarks.bench_capture --json out.json`; three minutes.

Photographs of 12 megapixels (JPEG) of a ball before a wall, with a radial distortion in a transforms.json beside them,
and masks. Measured are `make_frames` alone (read, averaged over blocks, judged by blur, brightness and standstill,
written) and all of `capture`, which also undistorts them, reads the masks and judges these by their hull. Each is a
process of its own, so its peak memory is its own.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from shinypartial.io.system import peak_memory_bytes

WIDTH, HEIGHT = 4000, 3000
K1 = -0.1
JPEG_QUALITY = 92


@dataclass(frozen=True)
class Cost:
    """Of one piece of work."""

    work: str
    photographs: int
    seconds: float
    processor_seconds: float
    """Of all threads."""
    peak_mib: float


def make_input(folder: Path, count: int) -> None:
    """Photographs, masks and cameras around a ball of radius 1; the wall moves from view to view."""
    from shinypartial.core.camera import opencv_to_opengl
    from shinypartial.io.images import write_jpeg, write_png
    from tests.support.synthetic_dataset import sphere_cameras

    random = np.random.default_rng(0)
    wall = random.integers(0, 256, (HEIGHT // 12, WIDTH // 12 + 8 * count, 3), np.uint8)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    frames = []
    cameras = sphere_cameras("train", count, HEIGHT)
    focal = cameras[0].fx
    radius_px = focal / np.sqrt(4.0**2 - 1)
    ball = np.hypot(columns + 0.5 - WIDTH / 2, rows + 0.5 - HEIGHT / 2) < radius_px
    for index, camera in enumerate(cameras):
        seen = wall[:, 8 * index : 8 * index + WIDTH // 12 + 1].repeat(12, 0).repeat(12, 1)[:HEIGHT, :WIDTH].copy()
        seen[ball] = (200, 180, 160)
        noisy = seen.astype(np.int16) // 2 + 60 + random.integers(-6, 7, (HEIGHT, WIDTH, 1), np.int16)
        write_jpeg(folder / "images" / f"p_{index:03d}.jpg", noisy.astype(np.uint8), JPEG_QUALITY)
        write_png(folder / "masks" / f"p_{index:03d}.png", ball.astype(np.uint8) * 255, quick=True)
        pose = opencv_to_opengl(camera.camera_to_world).tolist()
        frames.append({"file_path": f"images/p_{index:03d}.jpg", "transform_matrix": pose})
    content = {"fl_x": focal, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT, "k1": K1, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


def frames_alone(source: Path, output: Path) -> None:
    """Only reading and judging."""
    from panoless.photographs.frames import make_frames, source_files
    from panoless.photographs.options import CaptureOptions

    make_frames(source_files(source), output, True, CaptureOptions())


def whole_capture(source: Path, output: Path) -> None:
    """From photographs to the dataset."""
    from panoless.photographs.make import Request, capture

    capture(Request(source, output))


def measured(work: Callable[[Path, Path], None], source: Path, output: Path, count: int) -> Cost:
    """Wall time with all that is loaded, and the peak memory of this process."""
    start = time.monotonic()
    work(source, output)
    seconds = time.monotonic() - start
    costs = round(seconds, 1), round(time.process_time(), 1), round(peak_memory_bytes() / 2**20)
    return Cost(work.__name__.replace("_", " "), count, *costs)


def main() -> None:
    """Make the input, then measure both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--photographs", type=int, default=100)
    options = parser.parse_args()
    found = []
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "source"
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            pool.submit(make_input, source, options.photographs).result()
        for work in (frames_alone, whole_capture):
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                output = Path(folder) / work.__name__
                found.append(asdict(pool.submit(measured, work, source, output, options.photographs).result()))
            print(json.dumps(found[-1]), flush=True)
    options.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
