"""Theorems about depth to normals and structural similarity, for the definition in torch and the Numba kernels."""

from inspect import unwrap

import pytest
import torch

from panoless.splats.kernels.image import depth_normals, ssim

IMPLEMENTATIONS = [("reference", torch.float64, 1e-12), ("cpu", torch.float32, 1e-5)]
every_implementation = pytest.mark.parametrize(("backend", "dtype", "tolerance"), IMPLEMENTATIONS)
CAMERA = (60.0, 55.0, 21.3, 17.6)


def pixel_rays(height, width):
    """Rays (X/fx, Y/fy, 1) through the pixel centers of CAMERA."""
    fx, fy, cx, cy = CAMERA
    x = (torch.arange(width, dtype=torch.float64) + 0.5 - cx) / fx
    y = (torch.arange(height, dtype=torch.float64) + 0.5 - cy) / fy
    return torch.stack([x.expand(height, width), y[:, None].expand(height, width), torch.ones(height, width)])


def random_images(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(2, *shape, generator=generator, dtype=torch.float64).unbind()


def rough_depth(height, width, seed=1):
    return 2 + random_images(height, width, seed=seed)[0]


@every_implementation
@pytest.mark.parametrize("normal", [[0.0, 0.0, -1.0], [0.3, -0.2, -1.0], [-0.6, 0.5, -0.4]])
def test_a_plane_has_its_own_normal_everywhere(backend, dtype, tolerance, normal):
    normal = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    rays = pixel_rays(36, 44)
    depth = -2.0 / torch.einsum("c,chw->hw", normal, rays)
    # Rays that nearly graze the plane see it very far away, where float32 differences of depths mean little.
    depth = torch.where((depth > 0) & (depth < 20), depth, 0)
    found = depth_normals(depth.to(dtype), *CAMERA, backend=backend)
    seen = found.norm(dim=0) > 0
    assert seen.sum() > 300
    torch.testing.assert_close(
        found[:, seen], normal.to(dtype)[:, None].expand(-1, int(seen.sum())), rtol=0, atol=tolerance
    )


@every_implementation
def test_a_sphere_has_radial_normals(backend, dtype, tolerance):
    center, radius = torch.tensor([0.1, -0.05, 4.0], dtype=torch.float64), 1.0
    rays = pixel_rays(36, 44)
    a, b = (rays * rays).sum(0), torch.einsum("c,chw->hw", center, rays)
    discriminant = b * b - a * (center @ center - radius**2)
    depth = torch.where(discriminant > 0, (b - discriminant.clamp(min=0).sqrt()) / a, 0)
    radial = (rays * depth - center[:, None, None]) / radius
    found = depth_normals(depth.to(dtype), *CAMERA, backend=backend).double()
    facing = (found.norm(dim=0) > 0) & (-(radial * rays).sum(0) / a.sqrt() > 0.6)
    assert facing.sum() > 200
    # Central differences err by h²·f‴/6 with h ≈ 4/55: measured 0.0075 rad where the sphere faces the camera.
    assert (found - radial).norm(dim=0)[facing].max() < 0.012


@every_implementation
def test_normals_are_unit_and_face_the_camera(backend, dtype, tolerance):
    normals = depth_normals(rough_depth(30, 41).to(dtype), *CAMERA, backend=backend).double()
    inner = normals[:, 1:-1, 1:-1]
    torch.testing.assert_close(inner.norm(dim=0), torch.ones_like(inner[0]), rtol=0, atol=tolerance)
    assert ((inner * pixel_rays(30, 41)[:, 1:-1, 1:-1]).sum(0) < 0).all()
    border = torch.ones(30, 41, dtype=torch.bool)
    border[1:-1, 1:-1] = False
    assert (normals[:, border] == 0).all()


@every_implementation
@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_normals_do_not_depend_on_the_unit_of_length(backend, dtype, tolerance, scale):
    depth = rough_depth(12, 15).to(dtype)
    expected = depth_normals(depth, *CAMERA, backend=backend)
    found = depth_normals(depth * scale, *CAMERA, backend=backend)
    torch.testing.assert_close(found, expected, rtol=0, atol=10 * tolerance)


@every_implementation
@pytest.mark.parametrize("hole", [0.0, -1.0, float("nan"), float("inf")])
def test_a_hole_takes_away_the_normals_around_it_and_their_gradient(backend, dtype, tolerance, hole):
    depth = rough_depth(9, 11).to(dtype)
    intact = depth_normals(depth, *CAMERA, backend=backend)
    depth[4, 5] = hole
    depth.requires_grad_()
    normals = depth_normals(depth, *CAMERA, backend=backend)
    around = torch.zeros(9, 11, dtype=torch.bool)
    around[[3, 5, 4, 4], [5, 5, 4, 6]] = True
    assert (normals[:, around] == 0).all()
    torch.testing.assert_close(normals[:, ~around].detach(), intact[:, ~around], rtol=0, atol=tolerance)
    (normals * torch.randn(3, 9, 11, generator=torch.Generator().manual_seed(0)).to(dtype)).sum().backward()
    assert depth.grad.isfinite().all()
    assert depth.grad[4, 5] == 0
    depth.grad = None
    depth_normals(depth, *CAMERA, backend=backend)[:, around].sum().backward()
    assert (depth.grad == 0).all()


def test_gradcheck_of_the_definition_of_normals():
    depth = rough_depth(6, 7).requires_grad_()
    assert torch.autograd.gradcheck(lambda depth: depth_normals(depth, *CAMERA), depth)


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (3, 3), (17, 2), (40, 17), (33, 70)])
def test_the_normal_kernel_agrees_with_the_definition(shape):
    depth = rough_depth(*shape).float()
    depth[shape[0] // 2, shape[1] // 3] = 0
    cotangent = torch.randn(3, *shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    results = []
    for backend, dtype in (("reference", torch.float64), ("cpu", torch.float32)):
        inputs = depth.to(dtype).requires_grad_()
        normals = depth_normals(inputs, *CAMERA, backend=backend)
        (normals * cotangent.to(dtype)).sum().backward() if normals.requires_grad else None
        results.append((normals, torch.zeros_like(inputs) if inputs.grad is None else inputs.grad))
    for expected, found in zip(*results, strict=True):
        # Measured: 2e-7 of the largest entry.
        assert (found - expected).abs().max() <= 2e-6 * expected.abs().max()


@every_implementation
@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 4, 7), (3, 40, 50), (2, 23, 1)])
def test_an_image_is_entirely_similar_to_itself_and_nothing_is_more(backend, dtype, tolerance, shape):
    image = random_images(*shape)[0].to(dtype).requires_grad_()
    value = ssim(image, image.detach(), backend=backend)
    value.backward()
    assert value.item() == pytest.approx(1, abs=tolerance)
    # 1 is the maximum, so the gradient vanishes; compare it with that of a dissimilar image.
    other = torch.zeros_like(image).requires_grad_()
    ssim(other, image.detach(), backend=backend).backward()
    assert image.grad.abs().max() <= 10 * tolerance * other.grad.abs().max()


@every_implementation
def test_similarity_is_symmetric(backend, dtype, tolerance):
    first, second = (image.to(dtype) for image in random_images(3, 20, 33))
    forth, back = ssim(first, second, backend=backend), ssim(second, first, backend=backend)
    assert forth.item() == pytest.approx(back.item(), abs=tolerance)


@every_implementation
def test_similarity_agrees_with_skimage_away_from_the_border(backend, dtype, tolerance):
    from skimage.metrics import structural_similarity

    content = random_images(3, 40, 52)
    # A margin of zeros around both images makes the window see the same zeros whichever way the border is handled.
    first, second = (torch.nn.functional.pad(image, (12, 12, 12, 12)) for image in content)
    _, similarity = structural_similarity(
        first.numpy(),
        second.numpy(),
        channel_axis=0,
        data_range=1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    found = ssim(first.to(dtype), second.to(dtype), backend=backend)
    assert found.item() == pytest.approx(similarity.mean(), abs=tolerance)
    # Zeros beyond the border of the content itself are part of this definition.
    without_margin = ssim(content[0].to(dtype), content[1].to(dtype), backend=backend)
    inside = similarity[:, 12:-12, 12:-12].mean()
    assert without_margin.item() == pytest.approx(inside, abs=tolerance)


@every_implementation
def test_the_gradient_of_similarity_is_that_of_finite_differences(backend, dtype, tolerance):
    image, target = random_images(2, 15, 13)
    image = image.to(dtype).requires_grad_()
    ssim(image, target.to(dtype), backend=backend).backward()
    step = 1e-5
    numeric = torch.empty_like(image, dtype=torch.float64)
    for index in range(image.numel()):
        ends = []
        for sign in (-1, 1):
            moved = image.detach().double().clone()
            moved.view(-1)[index] += sign * step
            ends.append(ssim(moved, target, backend="reference"))
        numeric.view(-1)[index] = (ends[1] - ends[0]) / (2 * step)
    # The differences themselves are good to 1e-8 of the largest; the kernel adds its own rounding.
    assert (image.grad - numeric).abs().max() < (tolerance + 1e-7) * numeric.abs().max()


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 2, 40), (1, 3, 5), (3, 70, 90), (2, 64, 33), (4, 11, 11)])
@pytest.mark.parametrize("threads", [1, 2])
def test_the_similarity_kernel_agrees_with_the_definition(shape, threads):
    image, target = (image.float() for image in random_images(*shape))
    exact = image.double().requires_grad_()
    expected = ssim(exact, target.double())
    expected.backward()
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        inputs = image.clone().requires_grad_()
        value = ssim(inputs, target, backend="cpu")
        ssim(target, image, backend="cpu")
        (3 * value).backward()
        without_gradient = ssim(image, target, backend="cpu")
    finally:
        torch.set_num_threads(before)
    # Measured: 1e-7 on the value, 5e-7 of the norm on the gradient.
    assert value.item() == pytest.approx(expected.item(), abs=1e-6)
    assert without_gradient.item() == pytest.approx(value.item(), abs=1e-6)
    assert (inputs.grad - 3 * exact.grad).norm() < 3e-6 * (3 * exact.grad).norm()


def test_similarity_of_flat_bright_images_survives_float32():
    # Variances of 1e-6 under means near 1 are where E[x²] − E[x]² cancels worst.
    noise, other_noise = random_images(3, 60, 60)
    image, target = 0.97 + 1e-3 * noise, 0.97 + 1e-3 * other_noise
    expected = ssim(image, target)
    # Measured 5e-7; a rounding of 1e-7 in one variance is 1e-4 of C₂ = 9e-4, and the mean over pixels evens it out.
    assert ssim(image.float(), target.float(), backend="cpu").item() == pytest.approx(expected.item(), abs=5e-6)


@pytest.mark.parametrize(
    ("image", "target"),
    [
        (torch.zeros(3, 4, 5), torch.zeros(3, 5, 4)),
        (torch.zeros(4, 5), torch.zeros(4, 5)),
        (torch.zeros(3, 0, 5), torch.zeros(3, 0, 5)),
        (torch.zeros(3, 4, 5), torch.zeros(3, 4, 5, dtype=torch.float64)),
        (torch.zeros(3, 4, 5), torch.zeros(3, 4, 5, requires_grad=True)),
    ],
)
def test_similarity_refuses_what_it_can_not_compare(image, target):
    with pytest.raises(ValueError, match=r"expected .*; found "):
        # While testing, annotations are checked before the function runs; users meet what is inside.
        unwrap(ssim)(image, target)


def test_normals_refuse_a_batch():
    with pytest.raises(ValueError, match=r"expected a depth map \(H, W\); found \(1, 4, 5\)"):
        unwrap(depth_normals)(torch.ones(1, 4, 5), *CAMERA)
