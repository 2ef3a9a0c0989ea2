"""The cubemap lookup in Triton: adjointness, and values and gradients of the definition."""

import pytest
import torch

from panoless.kernels.cubemap import cubemap_directions, sample_cubemap, scatter_cubemap
from panoless.kernels.reference.cubemap import project_to_face
from tests.panoless.kernels.test_cubemap import hard_directions, random_cubemap

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


@pytest.mark.parametrize("resolution", [1, 2, 5, 16])
def test_scatter_is_the_adjoint_of_the_lookup(resolution: int, device: torch.device):
    cubemap, directions = random_cubemap(resolution, torch.float32), hard_directions(torch.float32, count=300)
    weights = torch.randn(len(directions), 3, generator=torch.Generator().manual_seed(2))
    cubemap, directions, weights = cubemap.to(device), directions.to(device), weights.to(device)
    looked_up = sample_cubemap(cubemap, directions, backend="gpu").double() * weights.double()
    scattered = scatter_cubemap(weights, directions, resolution, backend="gpu").double() * cubemap.double()
    assert abs(looked_up.sum() - scattered.sum()) < 5e-6 * looked_up.abs().sum()


@pytest.mark.parametrize("resolution", [1, 2, 5, 16])
def test_a_texel_center_returns_its_texel(resolution: int, device: torch.device):
    cubemap = random_cubemap(resolution, torch.float32)
    directions = cubemap_directions(resolution).reshape(-1, 3).to(device)
    found = sample_cubemap(cubemap.to(device), directions, backend="gpu").cpu()
    torch.testing.assert_close(found, cubemap.movedim(1, -1).reshape(-1, 3), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("resolution", "channels"), [(1, 3), (2, 1), (5, 4), (33, 3)])
def test_the_kernel_pulls_back_as_the_definition(resolution: int, channels: int, device: torch.device):
    directions = hard_directions(torch.float32, count=300)
    # Exactly on a line between cells either side's derivative is right, and rounding chooses; keep off those lines.
    _, st, _ = project_to_face(directions.double())
    position = (st + 1) * resolution / 2 - 0.5
    away = ((position - position.round()).abs().amin(-1) > 1e-5) & (st.abs().amax(-1) < 1 - 1e-6)
    directions = directions[away]
    assert len(directions) > 500
    cotangent = torch.randn(len(directions), channels, generator=torch.Generator().manual_seed(4))
    results = []
    for backend, place, dtype in (("reference", torch.device("cpu"), torch.float64), ("gpu", device, torch.float32)):
        cubemap = random_cubemap(resolution, torch.float32, channels).to(place, dtype).requires_grad_()
        inputs = directions.to(place, dtype).requires_grad_()
        values = sample_cubemap(cubemap, inputs, backend=backend)
        values.backward(cotangent.to(place, dtype))
        results.append([tensor.detach().cpu() for tensor in (values, cubemap.grad, inputs.grad)])
    for expected, found in zip(*results, strict=True):
        assert (found - expected).abs().max() < 1e-5 * expected.abs().max()


def test_directions_that_look_nowhere_give_zero_and_pass_no_gradient(device: torch.device):
    nan, inf = float("nan"), float("inf")
    nowhere = [[0, 0, 0], [nan, 1, 1], [1, 1, nan], [inf, 0, 0], [1, -inf, 2], [1e-42, 0, 0]]
    directions = torch.tensor(nowhere, device=device).requires_grad_()
    cubemap = random_cubemap(4, torch.float32).to(device).requires_grad_()
    values = sample_cubemap(cubemap, directions, backend="gpu")
    values.sum().backward()
    assert (values == 0).all()
    assert (cubemap.grad == 0).all()
    assert (directions.grad == 0).all()


def test_no_directions_are_fine(device: torch.device):
    cubemap = random_cubemap(4, torch.float32).to(device).requires_grad_()
    none = torch.empty(0, 3, device=device).requires_grad_()
    values = sample_cubemap(cubemap, none, backend="gpu")
    values.sum().backward()
    assert values.shape == (0, 3)
    assert (cubemap.grad == 0).all()
    assert none.grad.shape == (0, 3)
