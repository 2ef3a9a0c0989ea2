"""Which implementation runs where, without any of them running."""

import pytest
import torch

from panoless.kernels import backend
from panoless.kernels.backend import array_kernels, choose_backend

GPU, CPU = torch.device("cuda"), torch.device("cpu")


@pytest.mark.parametrize("installed", [True, False])
def test_auto_takes_the_kernels_of_the_device_and_else_the_definition(
    installed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backend, "gpu_kernels_installed", lambda: installed)
    assert backend._fastest(torch.float32, CPU) == "cpu"
    assert backend._fastest(torch.float32, GPU) == ("gpu" if installed else "reference")
    assert backend._fastest(torch.float64, CPU) == backend._fastest(torch.float16, GPU) == "reference"


def test_what_an_explicit_choice_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    tensor = torch.zeros(1)
    with pytest.raises(ValueError, match=r"float32 tensors on the CPU .* found torch.float64"):
        choose_backend("cpu", tensor=tensor.double())
    with pytest.raises(ValueError, match="one dtype on one device"):
        choose_backend("auto", a=tensor, b=tensor.to("meta"))
    monkeypatch.setattr(backend, "gpu_kernels_installed", lambda: False)
    with pytest.raises(ValueError, match=r"expected Triton .* pip install"):
        choose_backend("gpu", tensor=tensor)


def test_operators_on_arrays_run_on_the_cpu_only() -> None:
    with pytest.raises(ValueError, match='expected the backend "reference" or "cpu"; found \'gpu\''):
        array_kernels("gpu", "revolution")
