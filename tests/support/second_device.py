"""A device that is not there: tensors on it hold ordinary numbers, and whatever mixes it with main memory fails.

So a machine without a GPU can prove that code places its tensors once and keeps them there. Its name is torch's "meta",
the only device that a build of torch without GPUs still knows.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map

SECOND_DEVICE = torch.device("meta")


class SecondDeviceTensor(torch.Tensor):
    """Numbers in main memory under another device's name."""

    @staticmethod
    def __new__(cls, num_parameters: torch.Tensor) -> "SecondDeviceTensor":
        """Wrap plain numbers."""
        return torch.Tensor._make_wrapper_subclass(
            cls,
            num_parameters.shape,
            strides=num_parameters.stride(),
            storage_offset=num_parameters.storage_offset(),
            dtype=num_parameters.dtype,
            device=SECOND_DEVICE,
        )

    def __init__(self, num_parameters: torch.Tensor) -> None:
        """Keep them."""
        self.num_parameters = num_parameters

    @classmethod
    def __torch_dispatch__(cls, function, types, arguments=(), options=None):
        """Compute in main memory; the mode may have been left by an engine thread."""
        return _computed(function, arguments, options or {})


class _SecondDevice(TorchDispatchMode):
    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        return _computed(function, arguments, options or {})


class _NumbersFromPython(TorchFunctionMode):
    """Make tensors from Python's numbers in main memory first, because torch drops numbers that are to be "meta"."""

    def __torch_function__(self, function, types, arguments=(), options=None):
        options = dict(options or {})
        if function is torch.Tensor.new_tensor:
            options = {"dtype": arguments[0].dtype, "device": arguments[0].device, **options}
            function, arguments = torch.tensor, arguments[1:]
        if function is torch.tensor and options.get("device") is not None:
            device = options.pop("device")
            return torch.tensor(*arguments, **options).to(device)
        return function(*arguments, **options)


@contextmanager
def second_device() -> Iterator[torch.device]:
    """Within this, the device can be used."""
    with _SecondDevice(), _NumbersFromPython():
        yield SECOND_DEVICE


def _computed(function, arguments, options):
    tensors: list[torch.Tensor] = []
    tree_map(lambda item: tensors.append(item) if isinstance(item, torch.Tensor) else None, (arguments, options))
    there = [tensor for tensor in tensors if isinstance(tensor, SecondDeviceTensor)]
    target = options.get("device")
    if there and function not in (torch.ops.aten.copy_.default,):
        strangers = [tensor for tensor in tensors if not isinstance(tensor, SecondDeviceTensor) and tensor.ndim > 0]
        if strangers:
            raise RuntimeError(f"{function} mixes main memory {tuple(strangers[0].shape)} with the second device")
    if target is not None:
        options = {**options, "device": torch.device("cpu")}
    placed = torch.device(target).type == SECOND_DEVICE.type if target is not None else bool(there)
    plain = tree_map(
        lambda item: item.num_parameters if isinstance(item, SecondDeviceTensor) else item, (arguments, options)
    )
    result = function(*plain[0], **plain[1])
    originals = {id(tensor.num_parameters): tensor for tensor in there}
    return tree_map(lambda item: _wrapped(item, originals), result) if placed else result


def _wrapped(item, originals):
    """A plain tensor on the second device; one that was there before stays the same object."""
    if not isinstance(item, torch.Tensor) or isinstance(item, SecondDeviceTensor):
        return item
    return originals[id(item)] if id(item) in originals else SecondDeviceTensor(item)
