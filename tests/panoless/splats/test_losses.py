"""Terms of the objective against hand values and scikit-image (paper Eqs. 9–13)."""

import math

import pytest
import torch
from skimage.metrics import structural_similarity

from panoless.kernels.camera import RasterCamera
from panoless.splats.kernels.image import depth_normals
from panoless.splats.kernels.reference.objective import (
    normal_consistency,
    photometric_masked,
    silhouette,
    surface_depth,
)
from panoless.splats.losses import photometric_paper
from panoless.splats.rendering import rasterize_surfels
from tests.support.mirror_sphere import sphere_surfels

CAMERA = RasterCamera(torch.eye(4), 30.0, 30.0, 12.0, 12.0, 24, 24)
FRAME = 12


def images_in_a_dark_frame() -> tuple[torch.Tensor, torch.Tensor]:
    """Two images that are zero near their border, where definitions of SSIM differ."""
    generator = torch.Generator().manual_seed(0)
    pair = torch.zeros(2, 3, 40, 44)
    pair[:, :, FRAME:-FRAME, FRAME:-FRAME] = torch.rand(2, 3, 16, 20, generator=generator)
    return pair[0], pair[1]


@pytest.mark.parametrize("lambda_ssim", [0.0, 0.2, 1.0])
def test_the_photometric_loss_is_that_of_scikit_image(lambda_ssim: float) -> None:
    """Eqs. 9–11, D-SSIM not halved."""
    image, target = images_in_a_dark_frame()
    _, similarity = structural_similarity(
        image.double().numpy(),
        target.double().numpy(),
        channel_axis=0,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    l1 = float((image - target).abs().mean())
    expected = (1 - lambda_ssim) * l1 + lambda_ssim * (1 - similarity.mean())
    # Single against double precision.
    assert float(photometric_paper(image, target, lambda_ssim)) == pytest.approx(expected, abs=1e-5)


def test_equal_images_lose_nothing() -> None:
    image, _ = images_in_a_dark_frame()
    assert float(photometric_paper(image, image.clone(), 0.2)) == pytest.approx(0.0, abs=1e-6)


def test_the_masked_loss_by_hand() -> None:
    color, target = torch.tensor([[0.3, 0.0, 0.4], [0.0, 0.0, 0.0]]), torch.zeros(2, 3)
    far = math.sqrt(0.25 + 1e-4)
    assert float(photometric_masked(color, target, 0.0)) == pytest.approx((far + 0.01) / 2, rel=1e-6)
    # At a residual of the robust scale itself, ‖e‖ = s = 0.5, the weight is a quarter.
    assert float(photometric_masked(color, target, 0.5)) == pytest.approx((far / 4 + 0.01) / 2, rel=1e-6)


@pytest.mark.parametrize("robust_scale", [0.0, 0.3])
def test_an_outlier_pulls_no_harder_than_any_other_pixel(robust_scale: float) -> None:
    """The gradient is bounded by one over the number of pixels, and vanishes far out when the loss is robust."""
    color = torch.tensor([[0.02, 0.0, 0.0], [0.2, 0.0, 0.0], [5.0, 0.0, 0.0]], requires_grad=True)
    photometric_masked(color, torch.zeros(3, 3), robust_scale).backward()
    small, medium, large = color.grad[:, 0].tolist()
    assert 0 <= large <= 1 / 3
    assert 0 < small <= 1 / 3
    if robust_scale:
        assert large < 0.001 * medium < 0.001 * small
    else:
        assert large == pytest.approx(1 / 3, rel=1e-4)


@pytest.mark.parametrize("robust_scale", [0.0, 0.3])
def test_a_view_without_a_solid_pixel_adds_nothing(robust_scale: float) -> None:
    color = torch.zeros(0, 3, requires_grad=True)
    loss = photometric_masked(color, torch.zeros(0, 3), robust_scale)
    loss.backward()
    assert loss.item() == 0.0


def test_cross_entropy_known_values() -> None:
    """Eq. 13."""
    alpha = torch.tensor([[0.5, 0.25]])
    mask = torch.tensor([[1.0, 0.0]])
    assert float(silhouette(alpha, mask)) == pytest.approx((math.log(2) - math.log(0.75)) / 2, rel=1e-6)
    assert float(silhouette(mask, mask)) == pytest.approx(0.0, abs=2e-4)


def test_the_silhouette_pulls_alpha_toward_the_mask() -> None:
    alpha = torch.tensor([[0.3, 0.3, 0.9, 0.9]], requires_grad=True)
    silhouette(alpha, torch.tensor([[1.0, 0.0, 1.0, 0.0]])).backward()
    assert torch.sign(alpha.grad).tolist() == [[-1.0, 1.0, -1.0, 1.0]]


def inconsistency(normal: torch.Tensor, normals_camera: torch.Tensor, weight: torch.Tensor) -> float:
    """Eq. 12 for the opaque plane normal·P = −3 with other rasterized normals."""
    distance = 3.0
    step = (torch.arange(24) + 0.5 - 12.0) / 30.0
    y, x = torch.meshgrid(step, step, indexing="ij")
    depth = -distance / (normal[0] * x + normal[1] * y + normal[2])
    from_depth = depth_normals(depth, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
    return float(normal_consistency(normals_camera, torch.ones(24, 24), from_depth, weight))


def everywhere(normal: torch.Tensor) -> torch.Tensor:
    return normal[:, None, None].expand(3, 24, 24).clone()


def tilted(angle_deg: float) -> torch.Tensor:
    angle = math.radians(angle_deg)
    return torch.tensor([math.sin(angle), 0.0, -math.cos(angle)])


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, -50.0])
@pytest.mark.parametrize("length", [0.2, 1.0])
def test_normals_of_a_plane_agree_with_its_depth(tilt_deg: float, length: float) -> None:
    """Eq. 12 is zero whatever the length of the blended normals."""
    found = inconsistency(tilted(tilt_deg), everywhere(length * tilted(tilt_deg)), torch.ones(24, 24))
    # Differences of single-precision depths: 1e-6.
    assert found == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("angle_deg", [10.0, 45.0, 120.0])
def test_a_wrong_normal_costs_one_minus_the_cosine(angle_deg: float) -> None:
    found = inconsistency(tilted(0.0), everywhere(tilted(angle_deg)), torch.ones(24, 24))
    expected = 1 - math.cos(math.radians(angle_deg))
    assert found == pytest.approx(expected, abs=1e-5)


def test_only_chosen_pixels_count() -> None:
    normals = everywhere(tilted(0.0))
    normals[:, :, 12:] = tilted(90.0)[:, None, None]
    left = torch.zeros(24, 24)
    left[:, :12] = 1
    assert inconsistency(tilted(0.0), normals, left) == pytest.approx(0.0, abs=1e-5)
    assert inconsistency(tilted(0.0), normals, 1 - left) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("distance", [3.0, -3.0], ids=["a sphere", "nothing in view"])
@pytest.mark.parametrize("curved", [True, False])
def test_every_gradient_is_finite(distance: float, curved: bool) -> None:
    surfels = sphere_surfels(200, opacity_logit=1.0)
    leaves = {name: value.clone().requires_grad_() for name, value in surfels.named().items()}
    matrix = torch.eye(4)
    matrix[2, 3] = distance
    camera = RasterCamera(matrix, 30.0, 30.0, 12.0, 12.0, 24, 24)
    buffers = rasterize_surfels(type(surfels)(**leaves), camera, curved=curved)
    depth = surface_depth(buffers.accumulated_depth, buffers.median_depth, buffers.alpha, 0.5)
    from_depth = depth_normals(depth, camera.fx, camera.fy, camera.cx, camera.cy)
    assert bool((buffers.alpha > 0).any()) == (distance > 0)
    mask = torch.ones(24, 24)
    target = torch.rand(3, 24, 24)
    terms = [
        photometric_paper(buffers.colors, target, 0.2),
        photometric_masked(buffers.colors.flatten(1).T, target.flatten(1).T, 0.3),
        silhouette(buffers.alpha, mask),
        normal_consistency(buffers.normals_camera, buffers.alpha, from_depth, mask),
        buffers.distortion.mean(),
    ]
    total = torch.stack(terms).sum()
    assert torch.isfinite(total)
    total.backward()
    for name, leaf in leaves.items():
        assert leaf.grad is None or torch.isfinite(leaf.grad).all(), name
