"""The devices of the other Triton kernels."""

from tests.panoless.kernels.gpu.conftest import device as device
