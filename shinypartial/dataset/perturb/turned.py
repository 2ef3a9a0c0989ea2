"""Ground truth turned with the world: normals, the environment and how far it is.

Cameras are turned where they are planned.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from shinypartial.core.sphere import latlong_directions, sample_latlong
from shinypartial.dataset.read import read_inverse_distance_map
from shinypartial.dataset.schema import (
    ENVIRONMENT_CUBE,
    ENVIRONMENT_INVERSE_DISTANCE,
    ENVIRONMENT_LATLONG,
    NORMAL_CHANNELS,
)
from shinypartial.dataset.write import encode_normals, write_environment, write_inverse_distance
from shinypartial.io.files import read_json, write_json
from shinypartial.io.images import EXR, read_exr, read_exr_rgb, read_png, write_exr, write_png

Turn = Float[np.ndarray, "3 3"]


def turned_latlong(latlong: Float[np.ndarray, "H W C"], turn: Turn) -> Float[np.ndarray, "H W C"]:
    """The map whose values at T d are those of the given map at d."""
    return sample_latlong(latlong, latlong_directions(latlong.shape[0]) @ turn).astype(latlong.dtype)


def write_turned_environment(source: Path, root: Path, turn: Turn) -> None:
    """The environment of a dataset in all its forms, turned."""
    faces = sorted((source / ENVIRONMENT_CUBE).glob("*.exr"))
    resolution = {"cube_resolution": len(read_exr_rgb(faces[0]))} if faces else {}
    write_environment(root, turned_latlong(read_exr_rgb(source / ENVIRONMENT_LATLONG), turn), **resolution)


def write_turned_inverse_distance(source: Path, root: Path, turn: Turn) -> None:
    """How far the surroundings of a dataset are, turned about the origin."""
    inverse = read_inverse_distance_map(source / ENVIRONMENT_INVERSE_DISTANCE)
    write_inverse_distance(root, turned_latlong(inverse[..., None], turn)[..., 0])


def write_turned_normals(old: Path, new: Path, turn: Turn) -> None:
    """An EXR with normals, or a picture of normals, with these turned and all else as it is."""
    if old.suffix.lower() == EXR:
        channels = read_exr(old)
        if all(name in channels for name in NORMAL_CHANNELS):
            normals = np.stack([channels[name] for name in NORMAL_CHANNELS], -1) @ turn.T
            channels |= {name: normals[..., i].astype(channels[name].dtype) for i, name in enumerate(NORMAL_CHANNELS)}
        write_exr(new, channels)
        return
    codes = read_png(old)
    normals = codes[..., :3] * (2 / 255) - 1
    known = np.linalg.norm(normals, axis=-1, keepdims=True) > 0.5
    turned = np.where(known, encode_normals(normals @ turn.T), codes[..., :3])
    write_png(new, np.concatenate([turned, codes[..., 3:]], -1))


def write_turned_transforms(old: Path, new: Path, turn: Turn) -> None:
    """Cameras turned about the origin, everything else as stored."""
    content = read_json(old, "the cameras")
    whole = np.eye(4)
    whole[:3, :3] = turn
    frames = [
        entry | {"transform_matrix": (whole @ np.array(entry["transform_matrix"])).tolist()}
        for entry in content["frames"]
    ]
    write_json(new, content | {"frames": frames})
