"""The Triton blend of splats against the definition, forward and backward."""

import pytest
import torch

from tests.panoless.splats.kernels.test_splats import scene
from tests.support.splat_scenes import blended

# The interpreter computes with numpy, which warns where masked lanes overflow.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


@pytest.mark.parametrize("name", ["few", "opaque", "one"])
def test_kernel_and_definition_agree(name: str, device: torch.device) -> None:
    splats, depths = scene(name)
    images, gradients = [], []
    for backend, dtype, place in (("reference", torch.float64, "cpu"), ("gpu", torch.float32, device)):
        leaves = {key: value.detach().to(place, dtype).requires_grad_() for key, value in splats.items()}
        found = blended(leaves, backend, depths.to(place, dtype))
        generator = torch.Generator().manual_seed(9)
        weights = [torch.randn(each.shape, generator=generator).to(place, dtype) for each in vars(found).values()]
        loss = sum((each * weight).sum() for each, weight in zip(vars(found).values(), weights, strict=True))
        images.append([each.detach().double().cpu() for each in vars(found).values()])
        pulled = torch.autograd.grad(loss, list(leaves.values()))  # type: ignore[arg-type]
        gradients.append([each.double().cpu() for each in pulled])
    for expected, found in zip(images[0] + gradients[0], images[1] + gradients[1], strict=True):
        # Float32 rounding; 1e-5 measured in the interpreter.
        assert (found - expected).abs().max() < 1e-4 * max(1.0, float(expected.abs().max()))
