"""Which implementation of an operator runs: its definition, or fast kernels."""

from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Literal

import torch
from torch import Tensor

Backend = Literal["reference", "cpu", "gpu", "auto"]
"""`auto` takes the kernels of the device for float32 tensors, and the definition for everything else."""
ArrayBackend = Literal["reference", "cpu"]
"""For operators on numpy arrays in float64: the definition in numpy, or Numba."""


def choose_backend(backend: str, **tensors: Tensor) -> Literal["reference", "cpu", "gpu"]:
    """Resolve `auto`, and refuse inputs that disagree with each other or that the chosen kernels can't take.

    Raises ValueError for an unknown name, mixed dtypes or devices, `cpu` with anything but float32 on the CPU, or `gpu`
    without Triton or with anything but float32 on a GPU (on the CPU in Triton's interpreter).
    """
    kinds = {name: (tensor.dtype, tensor.device) for name, tensor in tensors.items()}
    if len(set(kinds.values())) > 1:
        found = ", ".join(f"{name} {dtype} on {device}" for name, (dtype, device) in kinds.items())
        raise ValueError(f"expected tensors of one dtype on one device; found {found}. Convert them first.")
    dtype, device = next(iter(kinds.values()))
    if backend == "auto":
        return _fastest(dtype, device)
    if backend == "cpu":
        return _require("cpu", "the CPU", dtype, device, device.type == "cpu")
    if backend == "gpu":
        if not gpu_kernels_installed():
            raise ValueError('expected Triton for backend="gpu"; found none. Install it: pip install "panoless[gpu]".')
        from panoless.kernels.gpu.launch import runs_on

        return _require("gpu", "a GPU", dtype, device, runs_on(device))
    if backend != "reference":
        raise ValueError(f'expected the backend "reference", "cpu", "gpu" or "auto"; found {backend!r}.')
    return "reference"


def array_kernels(backend: str, name: str) -> ModuleType:
    """The module `name` of operators on arrays. Raises ValueError for a backend that is none of theirs."""
    if backend not in ("reference", "cpu"):
        raise ValueError(f'expected the backend "reference" or "cpu"; found {backend!r}.')
    return import_module(f"panoless.kernels.{backend}.{name}")


@lru_cache(maxsize=1)
def gpu_kernels_installed() -> bool:
    """Whether Triton, which the GPU kernels are written in, is there; torch for CUDA on Linux brings it."""
    return find_spec("triton") is not None


def _fastest(dtype: torch.dtype, device: torch.device) -> Literal["reference", "cpu", "gpu"]:
    if dtype != torch.float32:
        return "reference"
    if device.type == "cpu":
        return "cpu"
    return "gpu" if device.type == "cuda" and gpu_kernels_installed() else "reference"


def _require(backend: Literal["cpu", "gpu"], place: str, dtype: torch.dtype, device: torch.device, there: bool):
    if dtype == torch.float32 and there:
        return backend
    raise ValueError(
        f'expected float32 tensors on {place} for backend="{backend}"; found {dtype} on {device}. '
        'Use backend="reference" or "auto".'
    )
