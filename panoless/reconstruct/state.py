"""The state of a fit on disk: enough to continue after a kill at any moment, and to export when it is done."""

import io
import json
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from panoless.config import FitConfig, config_from_dict
from panoless.geometry.height_field.model import HeightField
from panoless.geometry.plane.model import Plane
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.surfels.model import Surfels
from shinypartial.core.errors import InputError
from shinypartial.io.files import PARTIAL_PREFIX, atomic_write, read_json, remove_partial_files, write_json

CHECKPOINT = "checkpoint.pt"
DESCRIPTION = "fit.json"
SHAPES: dict[str, Any] = {"plane": Plane, "height_field": HeightField, "surface": SurfaceOfRevolution}
"""What a state may be made of beside surfels, by the name of its field."""


@dataclass
class FitState:
    """What changes during a fit. `iteration` counts finished steps; `environment` is as the optimizer holds it.

    `evidence` is what online visibility has accumulated. `final_environment` (radiance) and `visibility` in [0, 1] are
    set when the fit is complete.
    """

    surfels: Surfels
    environment: Tensor
    iteration: int
    optimizer: dict[str, Any]
    gradient_sum: Tensor
    gradient_count: Tensor
    evidence: Tensor
    center: list[float]
    radius: float
    final_environment: Tensor | None = None
    visibility: Tensor | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    curves: dict[str, list[float]] = field(default_factory=dict)
    peak_memory_bytes: int = 0
    plane: Plane | None = None
    """The plane of the outline, where there is one."""
    flat: bool = False
    """Whether that plane is the geometry; there are no surfels then."""
    surface: SurfaceOfRevolution | None = None
    """The surface of revolution of the outlines, where there is one."""
    turned: bool = False
    """Whether that surface is the geometry; no steps are taken with it then."""
    height_field: HeightField | None = None
    """The heights over the plane, where it bends."""
    bent: bool = False
    """Whether that bent plane is the geometry; no steps are taken with it then."""
    rung: str = ""
    """Which rung of the ladder was taken, and why."""

    @property
    def stepless(self) -> bool:
        """Whether the geometry is not made of free surfels, so that no steps of the optimization are taken."""
        return self.flat or self.bent or self.turned

    @property
    def geometry(self) -> Surfels | Plane | HeightField | SurfaceOfRevolution:
        """What mirrors the environment."""
        if self.bent and self.height_field is not None:
            return self.height_field
        if self.turned and self.surface is not None:
            return self.surface
        return self.plane if self.flat and self.plane is not None else self.surfels

    def to(self, device: torch.device) -> "FitState":
        """The same state on a device; the optimizer's part follows its parameters when it is loaded."""
        moved: dict[str, Any] = {"surfels": self.surfels.to(device)}
        moved |= {name: value.to(device) for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **moved)


def save_state(folder: Path, state: FitState) -> None:
    """Write the checkpoint whole or not at all."""
    content = {**vars(state), "surfels": {name: value.detach() for name, value in state.surfels.named().items()}}
    content["environment"] = state.environment.detach()
    for name in SHAPES:
        content[name] = _listed(getattr(state, name))
    # Through memory, because torch reports a full disk as an internal error of its own.
    buffer = io.BytesIO()
    torch.save(content, buffer)
    with atomic_write(folder / CHECKPOINT) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def load_state(folder: Path) -> FitState | None:
    """Read the checkpoint into main memory, or None when there is none yet; InputError when it is damaged."""
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    try:
        content = torch.load(path, weights_only=True, map_location="cpu")
        for name in SHAPES:
            content[name] = _shape(name, content[name])
        return FitState(**{**content, "surfels": Surfels(**content["surfels"])})
    except Exception as error:
        raise InputError(
            expected=f"a checkpoint of this version at {path}",
            found=f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}",
            remedy="Delete that run folder and fit again.",
        ) from None


def _listed(shape: Any) -> Any:
    """A shape as lists and numbers, which torch reads without running code."""
    if not is_dataclass(shape):
        return None if shape is None else np.asarray(shape).tolist()
    return {item.name: _listed(getattr(shape, item.name)) for item in fields(shape)}


def _shape(name: str, listed: Any) -> Any:
    """The shape of that name from its lists."""
    if listed is None:
        return None
    values = {key: np.array(value) if isinstance(value, list) else value for key, value in listed.items()}
    return SHAPES[name](
        **{key: _shape(key, value) if isinstance(value, dict) else value for key, value in values.items()}
    )


def acquire_run(folder: Path, dataset: Path, dataset_hash: str, config: FitConfig) -> None:
    """Make `folder` the run of this dataset and configuration; InputError when it belongs to another."""
    description = json.loads(json.dumps({"dataset_hash": dataset_hash, "config": asdict(config)}))
    path = folder / DESCRIPTION
    if path.exists():
        found = read_json(path, "the description of a run")
        if not isinstance(found, dict) or any(found.get(key) != value for key, value in description.items()):
            raise InputError(
                expected=f"a run folder that is new or belongs to the same dataset and configuration, at {folder}",
                found="a run of another dataset or configuration",
                remedy="Choose another --output, or delete that folder.",
            )
        remove_partial_files(folder)
        return
    if folder.exists() and (not folder.is_dir() or any(not _is_partial(path) for path in folder.iterdir())):
        raise InputError(
            expected=f"a new or empty run folder at {folder}",
            found="files that are not a run",
            remedy="Choose another --output.",
        )
    write_json(path, {"dataset": str(dataset.resolve()), **description})


def _is_partial(path: Path) -> bool:
    """A run that is killed while it writes its first file leaves nothing else."""
    return path.name.startswith(PARTIAL_PREFIX)


@dataclass(frozen=True)
class RunDescription:
    """What a run folder says about itself."""

    dataset: Path
    config: FitConfig


def read_description(folder: Path) -> RunDescription:
    """Read which dataset and configuration a run folder belongs to; InputError when it is no run of this version."""
    content = read_json(folder / DESCRIPTION, "the description of a run")
    if not isinstance(content, dict) or not {"dataset", "config"} <= content.keys():
        raise InputError(
            expected=f"the dataset and the configuration of a run in {folder / DESCRIPTION}",
            found="other content",
            remedy="Delete that run folder and fit again.",
        )
    return RunDescription(Path(content["dataset"]), config_from_dict(content["config"]))
