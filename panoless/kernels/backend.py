"""Which implementation of an operator runs: the definition in torch, or the Numba kernel."""

from typing import Literal

import torch
from torch import Tensor

Backend = Literal["reference", "cpu", "auto"]
"""`auto` takes the Numba kernel for float32 tensors on the CPU, and the definition for everything else."""


def choose_backend(backend: str, **tensors: Tensor) -> Literal["reference", "cpu"]:
    """Resolve `auto`, and refuse inputs that disagree with each other or that the Numba kernels can't take.

    Raises ValueError for an unknown name, mixed dtypes or devices, or `cpu` with anything but float32 on the CPU.
    """
    kinds = {name: (tensor.dtype, tensor.device) for name, tensor in tensors.items()}
    if len(set(kinds.values())) > 1:
        found = ", ".join(f"{name} {dtype} on {device}" for name, (dtype, device) in kinds.items())
        raise ValueError(f"expected tensors of one dtype on one device; found {found}. Convert them first.")
    dtype, device = next(iter(kinds.values()))
    fits = dtype == torch.float32 and device.type == "cpu"
    if backend == "auto":
        return "cpu" if fits else "reference"
    if backend == "cpu" and not fits:
        raise ValueError(
            f'expected float32 tensors on the CPU for backend="cpu"; found {dtype} on {device}. '
            'Use backend="reference" or "auto".'
        )
    if backend not in ("reference", "cpu"):
        raise ValueError(f'expected the backend "reference", "cpu" or "auto"; found {backend!r}.')
    return "cpu" if backend == "cpu" else "reference"
