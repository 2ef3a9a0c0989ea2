"""Write a prediction without shinypartial: a baseline that takes the object for the unit sphere about the origin.

It needs numpy and OpenEXR only, and shows every convention at work, so it can be translated to any language:

    python docs/examples/write_prediction.py DATASET PREDICTION
    shinypartial evaluate PREDICTION
"""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import OpenEXR

HEIGHT = 32  # Of the environment map; it is twice as wide.


def camera_rays(cameras: dict, frame: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origin, unit directions (H, W, 3) and the camera's axis, all in the world (+Z up)."""
    columns, rows = np.meshgrid(np.arange(cameras["w"]) + 0.5, np.arange(cameras["h"]) + 0.5)  # Centers of pixels.
    x, y = (columns - cameras["cx"]) / cameras["fl_x"], (rows - cameras["cy"]) / cameras["fl_y"]
    pose = np.array(frame["transform_matrix"])  # Camera-to-world; OpenGL axes: +x right, +y up, looking along −z.
    directions = np.stack([x, -y, -np.ones_like(x)], -1) @ pose[:3, :3].T
    return pose[:3, 3], directions / np.linalg.norm(directions, axis=-1, keepdims=True), -pose[:3, 2]


def meet_sphere(origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether each ray meets the unit sphere, and where: there the point is also the normal."""
    along = directions @ origin
    root = along**2 - origin @ origin + 1
    distance = -along - np.sqrt(np.maximum(root, 0))
    return root > 0, np.where(root[..., None] > 0, origin + distance[..., None] * directions, 0)


def latlong_pixel(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column: row 0 is +Z, the center of the map looks along +X, azimuth falls to the right."""
    u = 0.5 - np.arctan2(directions[..., 1], directions[..., 0]) / (2 * np.pi)
    v = np.arccos(np.clip(directions[..., 2], -1, 1)) / np.pi
    row = np.minimum((v * HEIGHT).astype(int), HEIGHT - 1)
    return row, (u * 2 * HEIGHT).astype(int) % (2 * HEIGHT)


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Write named channels as 32-bit floats."""
    path.parent.mkdir(parents=True, exist_ok=True)
    planes = {name: np.ascontiguousarray(plane, dtype=np.float32) for name, plane in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, planes).write(str(path))


def learn_environment(dataset: Path) -> tuple[np.ndarray, np.ndarray]:
    """Mean radiance in each direction that training views mirror, and how many pixels did."""
    cameras = json.loads((dataset / "transforms_train.json").read_text())
    total, count = np.zeros((HEIGHT, 2 * HEIGHT, 3)), np.zeros((HEIGHT, 2 * HEIGHT))
    for frame in cameras["frames"]:
        picture = OpenEXR.File(str(dataset / f"{frame['file_path']}.exr"), separate_channels=True).channels()
        red, green, blue, alpha = (picture[name].pixels.astype(float) for name in "RGBA")
        origin, directions, _ = camera_rays(cameras, frame)
        hit, normals = meet_sphere(origin, directions)
        reflect = directions - 2 * (directions * normals).sum(-1, keepdims=True) * normals
        inside = hit & (alpha > 0.99)
        place = latlong_pixel(reflect[inside])
        np.add.at(total, place, np.stack([red, green, blue], -1)[inside])
        np.add.at(count, place, 1)
    mean = total.sum((0, 1)) / max(count.sum(), 1)  # Directions that no view mirrors get the mean of the others.
    return np.where(count[..., None] > 0, total / np.maximum(count, 1)[..., None], mean), count


def main(dataset: Path, prediction: Path) -> None:
    """Write environment, visibility, test views and, last of all, the description."""
    environment, count = learn_environment(dataset)
    write_exr(prediction / "environment.exr", dict(zip("RGB", np.moveaxis(environment, -1, 0), strict=True)))
    write_exr(prediction / "visibility.exr", {"Y": count / (count + 4)})
    cameras = json.loads((dataset / "transforms_test.json").read_text())
    for frame in cameras["frames"]:
        origin, directions, axis = camera_rays(cameras, frame)
        hit, normals = meet_sphere(origin, directions)
        reflect = directions - 2 * (directions * normals).sum(-1, keepdims=True) * normals
        radiance = environment[latlong_pixel(reflect)] * hit[..., None]  # Premultiplied by alpha.
        channels = dict(zip("RGB", np.moveaxis(radiance, -1, 0), strict=True)) | {"A": hit}
        channels |= {f"normal.{name}": normals[..., i] for i, name in enumerate("XYZ")}
        channels["depth.Z"] = ((normals - origin) @ axis) * hit  # Along the camera's axis, not the distance.
        write_exr(prediction / "test" / f"{Path(frame['file_path']).name}.exr", channels)
    description = {
        "format": "shinypartial-prediction",
        "format_version": 1,
        "method": "unit-sphere",
        "dataset": str(dataset.resolve()),
        "dataset_hash": hashlib.sha256((dataset / "SHA256SUMS").read_bytes()).hexdigest(),
        "config": {"height": HEIGHT},
        "seconds": {},
        "hardware": {},
        "parameter_counts": {"environment": environment.size},
        "peak_memory_bytes": 0,
    }
    (prediction / "prediction.json").write_text(json.dumps(description, indent=2) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
