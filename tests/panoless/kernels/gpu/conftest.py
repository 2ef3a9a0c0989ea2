"""Where the Triton kernels run: in Triton's interpreter on the CPU, or, with `pytest -m gpu`, on a GPU."""

import os

import pytest
import torch

if not torch.cuda.is_available():
    # Read when Triton is first imported, which must not be before. With a GPU in sight kernels are compiled.
    os.environ["TRITON_INTERPRET"] = "1"

INTERPRETED_TILE = 32
"""The interpreter takes as long for a large tile as for a small one."""


@pytest.fixture(params=[pytest.param("cpu", id="interpreter"), pytest.param("cuda", marks=pytest.mark.gpu, id="gpu")])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """A device on which `backend="gpu"` works in this process."""
    pytest.importorskip("triton", reason="Triton is not installed; it exists for Linux only")
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA or ROCm device")
    if request.param == "cpu":
        if torch.cuda.is_available():
            pytest.skip("with a GPU in sight kernels are compiled; set CUDA_VISIBLE_DEVICES= to interpret them")
        from panoless.kernels.gpu import launch

        monkeypatch.setattr(launch, "TILES", launch.TileLaunch(tile=INTERPRETED_TILE))
    return torch.device(request.param)
