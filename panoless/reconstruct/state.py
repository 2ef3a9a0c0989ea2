"""The state of a fit on disk: enough to continue after a kill at any moment, and to export when it is done."""

import io
import json
import pickle
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.object_frame import ObjectFrame
from panoless.config import FitConfig, config_from_dict
from panoless.environment.lobe import Lobe
from panoless.environment.reflectance import Reflectance
from panoless.geometry.base import Geometry, from_plain, to_plain
from panoless.geometry.registry import FAMILIES
from panoless.selection.candidates import Selection, selection_from_plain, selection_to_plain
from panoless.splats.mirror import SurfelMirror
from panoless.splats.training import Training
from shinypartial.core.errors import InputError
from shinypartial.io.files import PARTIAL_PREFIX, atomic_write, read_json, remove_partial_files, write_json
from shinypartial.prediction.format import Trust

CHECKPOINT = "checkpoint.pt"
DESCRIPTION = "fit.json"


@dataclass
class FitState:
    """What changes during a fit. `environment` (linear radiance) and `visibility` in [0, 1] are set when it is done."""

    geometry: Geometry
    frame: ObjectFrame
    selection: Selection
    training: Training | None = None
    """What the steps of a fit of surfels need to continue; None for a kind in closed form."""
    environment: Float[Tensor, "6 3 L L"] | None = None
    visibility: Float[Tensor, "6 L L"] | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    """Of each stage."""
    curves: dict[str, list[float]] = field(default_factory=dict)
    peak_memory_bytes: int = 0
    device: str = "cpu"
    """The name of what computed it."""
    reflectance: Reflectance | None = None
    """Of the object, where held-out views require one; None: it mirrors all light."""
    roughness: float | None = None
    """Of the object, where held-out views require one; None: it is smooth."""
    blur_px: float | None = None
    """Standard deviation of a Gaussian that blurred the pictures, where held-out views require one."""
    verdict: Trust | None = None
    """How far it is to be trusted; None before the end, and in runs of an earlier version."""
    is_preliminary: bool = False
    """Whether the time limit ended its search."""

    @property
    def iteration(self) -> int:
        """Number of finished steps."""
        return 0 if self.training is None else self.training.iteration

    def shown_environment(self) -> Float[Tensor, "6 3 L L"]:
        """The map as the object shows it: blurred where it is rough. Only a finished fit has one."""
        assert self.environment is not None
        if self.roughness is None:
            return self.environment
        return Lobe.of(self.roughness, self.environment.shape[-1]).blurred(self.environment)

    def to(self, device: torch.device) -> "FitState":
        """The same state on a device."""
        return replace(
            self,
            geometry=self.geometry.to(device),
            training=None if self.training is None else self.training.to(device),
            environment=None if self.environment is None else self.environment.to(device),
            visibility=None if self.visibility is None else self.visibility.to(device),
        )


def save_state(folder: Path, state: FitState) -> None:
    """Write the checkpoint whole or not at all."""
    content = {
        **vars(state),
        "kind": state.geometry.kind,
        "geometry": state.geometry.state_dict(),
        "frame": to_plain(state.frame),
        "selection": selection_to_plain(state.selection),
        "training": None if state.training is None else vars(state.training),
        "reflectance": None if state.reflectance is None else to_plain(state.reflectance),
        "verdict": None if state.verdict is None else asdict(state.verdict),
    }
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
        kind = content.pop("kind")
        geometry = SurfelMirror if kind == SurfelMirror.kind else FAMILIES[kind].geometry
        content["geometry"] = geometry.from_state_dict(content["geometry"])
        content["frame"] = from_plain(ObjectFrame, content["frame"])
        content["selection"] = selection_from_plain(**content["selection"])
        content["training"] = None if content["training"] is None else Training(**content["training"])
        reflectance, verdict = content.pop("reflectance", None), content.pop("verdict", None)
        content["reflectance"] = None if reflectance is None else from_plain(Reflectance, reflectance)
        content["verdict"] = None if verdict is None else Trust(**verdict)
        return FitState(**content)
    except MemoryError:
        raise
    except Exception as error:
        # Torch's own words advise to load code without a check.
        is_refused = isinstance(error, pickle.UnpicklingError)
        reason = "no numbers, but other content" if is_refused else next(iter(str(error).splitlines()), "")
        raise InputError(
            expected=f"a checkpoint of this version at {path}",
            found=f"{type(error).__name__}: {reason}",
            remedy="Delete that run folder and fit again.",
        ) from None


def acquire_run(
    folder: Path, dataset: Path, dataset_hash: str, config: FitConfig, photographs_hash: str | None = None
) -> None:
    """Make `folder` the run of this dataset and configuration; InputError when it belongs to another.

    A run that has a checkpoint belongs to its photographs, too; one of an earlier version doesn't know them.
    """
    description = json.loads(json.dumps({"dataset_hash": dataset_hash, "config": asdict(config)}))
    whole = {"dataset": str(dataset.resolve()), "photographs_hash": photographs_hash, **description}
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
        if not (folder / CHECKPOINT).exists():
            write_json(path, whole)
        elif photographs_hash not in (None, found.get("photographs_hash", photographs_hash)):
            raise InputError(
                expected=f"the photographs, masks and cameras from which the run at {folder} began",
                found=f"others in {dataset}",
                remedy="Delete that run folder, or choose another --output.",
            )
        return
    if folder.exists() and (not folder.is_dir() or any(not _is_partial(path) for path in folder.iterdir())):
        raise InputError(
            expected=f"a new or empty run folder at {folder}",
            found="files that are not a run",
            remedy="Choose another --output.",
        )
    write_json(path, whole)


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
