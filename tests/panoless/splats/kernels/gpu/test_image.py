"""Depth normals and SSIM in Triton: values and gradients of the definition."""

import pytest
import torch

from panoless.splats.kernels.image import depth_normals, ssim
from tests.panoless.splats.kernels.test_image import CAMERA, random_images, rough_depth

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (3, 3), (17, 2), (20, 17)])
@pytest.mark.parametrize("hole", [0.0, -1.0, float("nan"), float("inf")])
def test_the_normal_kernel_agrees_with_the_definition(shape: tuple[int, int], hole: float, device: torch.device):
    depth = rough_depth(*shape).float()
    depth[shape[0] // 2, shape[1] // 3] = hole
    cotangent = torch.randn(3, *shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    results = []
    for backend, place, dtype in (("reference", torch.device("cpu"), torch.float64), ("gpu", device, torch.float32)):
        inputs = depth.to(place, dtype).requires_grad_()
        normals = depth_normals(inputs, *CAMERA, backend=backend)
        if normals.requires_grad:
            (normals * cotangent.to(place, dtype)).sum().backward()
        gradient = torch.zeros_like(inputs) if inputs.grad is None else inputs.grad
        results.append((normals.detach().cpu(), gradient.cpu()))
    for expected, found in zip(*results, strict=True):
        assert found.isfinite().all()
        assert (found - expected.nan_to_num(0)).abs().max() <= 2e-6 * expected.nan_to_num(0).abs().max()


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 4, 7), (2, 23, 1), (3, 15, 26)])
def test_the_similarity_kernel_agrees_with_the_definition(shape: tuple[int, int, int], device: torch.device):
    image, target = random_images(*shape)
    results = []
    for backend, place, dtype in (("reference", torch.device("cpu"), torch.float64), ("gpu", device, torch.float32)):
        inputs = image.clone().to(place, dtype).requires_grad_()
        value = ssim(inputs, target.to(place, dtype), backend=backend)
        (3 * value).backward()
        results.append((value.detach().cpu(), inputs.grad.cpu()))
    for expected, found in zip(*results, strict=True):
        assert (found - expected).abs().max() <= 5e-6 * expected.abs().max()


def test_an_image_without_gradient_has_the_same_similarity(device: torch.device):
    image, target = (each.float().to(device) for each in random_images(3, 9, 11))
    value = ssim(image.clone().requires_grad_(), target, backend="gpu")
    torch.testing.assert_close(ssim(image, target, backend="gpu"), value.detach())
