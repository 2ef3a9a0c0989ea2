"""Splats: closed forms, gradients of the definition, and a kernel that agrees with it forward and backward."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from panoless.splats.kernels.splats import project_gaussians
from tests.support.splat_scenes import SIZE, blended, random_splats
from tests.support.surfel_scenes import straight_camera, tilted_camera

SCENES = {"few": (3, 1), "many": (60, 2), "opaque": (30, 3), "one": (1, 4)}


def scene(name: str) -> tuple[dict[str, Tensor], Tensor]:
    count, seed = SCENES[name]
    splats = random_splats(count, seed, opacity=1.0 if name == "opaque" else 0.9)
    return splats, torch.rand(count, generator=torch.Generator().manual_seed(seed)).double() + 1


def pulled_back(name: str, backend: str, dtype: torch.dtype) -> dict[str, Tensor]:
    """Gradients of both images against random cotangents."""
    splats, depths = scene(name)
    leaves = {key: value.to(dtype).requires_grad_() for key, value in splats.items()}
    images = blended(leaves, backend, depths.to(dtype))
    generator = torch.Generator().manual_seed(9)
    weights = [torch.randn(each.shape, generator=generator, dtype=torch.float64) for each in vars(images).values()]
    loss = sum((each * weight).sum() for each, weight in zip(vars(images).values(), weights, strict=True))
    gradients = torch.autograd.grad(loss, list(leaves.values()))  # type: ignore[arg-type]
    return {key: gradient.double() for key, gradient in zip(leaves, gradients, strict=True)}


@pytest.mark.parametrize("name", SCENES)
def test_kernel_blends_like_the_definition(name: str) -> None:
    splats, depths = scene(name)
    expected = blended(splats, "reference", depths)
    found = blended({key: value.float() for key, value in splats.items()}, "cpu", depths.float())
    # Float32 rounding; 2e-6 measured.
    assert (found.channels - expected.channels).abs().max() < 2e-5
    assert (found.alpha - expected.alpha).abs().max() < 2e-5


@pytest.mark.parametrize("name", SCENES)
def test_kernel_pulls_back_like_the_definition(name: str) -> None:
    expected, found = (pulled_back(name, *each) for each in (("reference", torch.float64), ("cpu", torch.float32)))
    for key, gradient in expected.items():
        # Float32 rounding; 1e-5 measured.
        assert (found[key] - gradient).abs().max() < 1e-4 * max(1.0, float(gradient.abs().max())), key


def test_gradients_of_the_definition() -> None:
    """By finite differences, of splats so large and faint that no fragment is at an edge."""
    splats = random_splats(3, 5, channels=2, opacity=0.4)
    splats["precisions"] = splats["precisions"] / 400
    depths = torch.arange(1.0, 4.0, dtype=torch.float64)
    leaves = [value.requires_grad_() for value in splats.values()]

    def images(*values: Tensor) -> tuple[Tensor, Tensor]:
        found = blended(dict(zip(splats, values, strict=True)), "reference", depths)
        return found.channels[:, ::9, ::7], found.alpha[::9, ::7]

    assert torch.autograd.gradcheck(images, leaves)


def test_kernel_agrees_with_its_own_differences() -> None:
    """Along one direction of all centers at once."""
    splats = {key: value.float() for key, value in random_splats(4, 6, opacity=0.4).items()}
    splats["precisions"] = splats["precisions"] / 100
    depths, toward = torch.arange(1.0, 5.0), torch.tensor([0.6, -0.8])

    def total(step: float) -> Tensor:
        moved = {**splats, "centers": centers + step * toward}
        return blended(moved, "cpu", depths).channels.square().mean()

    centers = splats["centers"].requires_grad_()
    (gradient,) = torch.autograd.grad(total(0), centers)
    with torch.no_grad():
        difference = float((total(0.5) - total(-0.5)).double())
    assert difference == pytest.approx(float((gradient * toward).sum()), rel=5e-3)


def test_constants_blend_to_alpha_and_the_nearest_is_in_front() -> None:
    splats, depths = scene("many")
    splats["attributes"] = torch.ones_like(splats["attributes"])
    images = blended(splats, "reference", depths)
    assert torch.allclose(images.channels, images.alpha.expand_as(images.channels))
    two = {key: value[:1].expand(2, -1).clone() for key, value in splats.items()}
    two["centers"][:] = torch.tensor([SIZE[1] / 2, SIZE[0] / 2])
    two["opacities"][:] = 0.8
    two["attributes"] = torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    image = blended(two, "reference", torch.tensor([2.0, 1.0], dtype=torch.float64))
    assert (image.channels[1] >= image.channels[0]).all()


def test_a_projected_gaussian_spreads_as_its_points_do() -> None:
    """To first order: the projections of the center moved a little along each axis of the Gaussian."""
    camera = tilted_camera()
    generator = torch.Generator().manual_seed(3)
    means = (torch.rand(6, 3, generator=generator, dtype=torch.float64) - 0.5) * 0.4
    quats = torch.randn(6, 4, generator=generator, dtype=torch.float64)
    scales = 0.05 + 0.1 * torch.rand(6, 3, generator=generator, dtype=torch.float64)
    splats = project_gaussians(means, quats, scales, camera)
    step, spread = 1e-4, torch.zeros(6, 2, 2, dtype=torch.float64)
    from scipy.spatial.transform import Rotation

    axes = torch.from_numpy(Rotation.from_quat(quats[:, [1, 2, 3, 0]].numpy()).as_matrix()) * scales[:, None]
    for axis in axes.unbind(2):
        ends = (project_gaussians(means + sign * step * axis, quats, scales, camera).centers for sign in (1, -1))
        forth, back = ends
        moved = (forth - back) / (2 * step)
        spread += moved[:, :, None] * moved[:, None, :]
    xx, xy, yy = splats.precisions.unbind(1)
    precision = torch.stack([xx, xy, xy, yy], 1).view(6, 2, 2)
    dilated = spread + 0.3 * torch.eye(2, dtype=torch.float64)
    assert torch.allclose(precision @ dilated, torch.eye(2, dtype=torch.float64).expand(6, 2, 2), atol=1e-5)


def test_a_crop_shows_what_the_whole_picture_shows() -> None:
    """Also one that lies wholly to one side of the principal point."""
    whole, left = straight_camera(200, focal=100.0), 150
    crop = replace(whole, cx=whole.cx - left, width=40)
    generator = torch.Generator().manual_seed(4)
    means = torch.rand(20, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.4, 0.1, 0.0])
    means += torch.tensor([0.5, 0.0, 1.0])  # Columns 150 to 190.
    quats = torch.randn(20, 4, generator=generator, dtype=torch.float64)
    scales = 0.05 + 0.1 * torch.rand(20, 3, generator=generator, dtype=torch.float64)
    seen, cropped = (project_gaussians(means, quats, scales, camera) for camera in (whole, crop))
    assert ((cropped.centers[:, 0] > 0) & (cropped.centers[:, 0] < crop.width)).all()
    assert torch.allclose(seen.centers[:, 0] - left, cropped.centers[:, 0])
    assert torch.allclose(seen.precisions, cropped.precisions)


def test_gradients_of_the_projection() -> None:
    camera = tilted_camera()
    generator = torch.Generator().manual_seed(4)
    means = ((torch.rand(3, 3, generator=generator, dtype=torch.float64) - 0.5) * 0.4).requires_grad_()
    quats = torch.randn(3, 4, generator=generator, dtype=torch.float64).requires_grad_()
    scales = (0.05 + 0.1 * torch.rand(3, 3, generator=generator, dtype=torch.float64)).requires_grad_()

    def projected(*values: Tensor) -> tuple[Tensor, Tensor]:
        splats = project_gaussians(*values, camera)
        return splats.centers, splats.precisions

    assert torch.autograd.gradcheck(projected, (means, quats, scales))


def test_what_cannot_be_drawn_passes_no_gradient() -> None:
    camera = straight_camera()
    means = torch.tensor([[0.0, 0, 2], [0, 0, -1], [float("nan"), 0, 2], [0, 0, 2]], requires_grad=True)
    quats = torch.tensor([[1.0, 0, 0, 0]] * 3 + [[0.0, 0, 0, 0]])
    splats = project_gaussians(means, quats, torch.full((4, 3), 0.1), camera)
    assert splats.drawn.tolist() == [True, False, False, False]
    gradient = torch.autograd.grad(splats.centers.sum(), means)[0]
    assert gradient.isfinite().all()
    assert not gradient[1:].any()
