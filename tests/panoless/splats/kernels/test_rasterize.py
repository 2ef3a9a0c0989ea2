"""What the rasterizer computes: closed forms, three implementations that agree, and laws that any of them must obey."""

import dataclasses
import inspect
import itertools
import math

import numpy as np
import pytest
import torch

from panoless.splats.kernels.rasterize import Channels, RasterBuffers, rasterize, tile_shape
from tests.support.loops import LoopImages, rasterize_loops
from tests.support.surfel_scenes import (
    IMAGES,
    SurfelScene,
    edge_on_quat,
    facing_surfel,
    merged,
    random_scene,
    rotation,
    straight_camera,
    tilted_camera,
)

BACKENDS = ("reference", "cpu")
FLOAT_TYPE = {"reference": torch.float64, "cpu": torch.float32}
# Largest difference over the largest value of an image: double rounding alone, and float32 rounding of projected
# slopes (5e-5 measured).
AGREEMENT = {"reference": 1e-9, "cpu": 2e-4}


def rendered(scene: SurfelScene, backend: str) -> RasterBuffers:
    return scene.cast(FLOAT_TYPE[backend]).render(backend)


def looped(scene: SurfelScene) -> LoopImages:
    arrays = {name: value.detach().double().numpy() for name, value in scene.parameters().items()}
    arrays.pop("screen_offsets")
    return rasterize_loops(**{"curvatures": None, **arrays}, camera=scene.camera)


def assert_agree(found, expected, tolerance: float) -> None:
    for name in IMAGES:
        a = torch.as_tensor(getattr(found, name)).detach().double()
        b = torch.as_tensor(getattr(expected, name)).detach().double()
        assert (a - b).abs().max() <= tolerance * max(1.0, float(b.abs().max())), name


def special_scenes() -> dict[str, SurfelScene]:
    straight, tilted = straight_camera(), tilted_camera()
    scenes = {
        f"{count} {'curved' if curved else 'flat'}": random_scene(count, count, curved, tilted)
        for count in (1, 2, 5, 20)
        for curved in (False, True)
    }
    facing = facing_surfel(straight, 2.0, 0.9)
    scenes["none"] = random_scene(0, 0, False, tilted)
    scenes["behind the camera"] = merged(facing.replace(means=-facing.means), facing)
    scenes["all behind the camera"] = facing.replace(means=-facing.means)
    # Half the cosine below which a surfel counts as edge-on: enough to say which way the normal faces.
    aside = torch.tensor([[1e-4, 0.0, 0.0]], dtype=torch.float64)
    edge_on = facing.replace(means=facing.means + aside, quats=edge_on_quat()[None])
    scenes["edge-on"] = merged(edge_on, facing_surfel(straight, 3.0, 0.5))
    scenes["saturated"] = merged(*(facing_surfel(straight, 2.0 + 0.1 * i, 1.0) for i in range(6)))
    red_first = facing.replace(colors=torch.tensor([[1.0, 0, 0]], dtype=torch.float64))
    scenes["equal depth"] = merged(red_first, facing.replace(scales=2 * facing.scales), red_first)
    scenes["smaller than a pixel"] = random_scene(20, 3, False, tilted, size=0.003)
    scenes["across the camera plane"] = facing_surfel(straight, 0.5, 0.6, size=2.0).replace(
        quats=torch.tensor([[1.0, 0.5, 0.3, 0.0]], dtype=torch.float64)
    )
    return scenes


SCENES = special_scenes()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", SCENES)
def test_loops_reference_and_kernel_agree(name: str, backend: str):
    assert_agree(rendered(SCENES[name], backend), looped(SCENES[name]), AGREEMENT[backend])


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_facing_surfel_by_hand(backend: str):
    camera = straight_camera()
    buffers = rendered(facing_surfel(camera, depth=2.0, opacity=0.8), backend)
    row, column = 8, 15
    along_u = (column + 0.5 - camera.cx) / camera.fx * 2.0 / 0.5
    along_v = (row + 0.5 - camera.cy) / camera.fy * 2.0 / 0.25
    alpha = 0.8 * math.exp(-0.5 * (along_u**2 + along_v**2))
    assert buffers.alpha[row, column].item() == pytest.approx(alpha, rel=1e-5)
    assert buffers.accumulated_depth[row, column].item() == pytest.approx(2 * alpha, rel=1e-5)
    assert buffers.median_depth[row, column].item() == pytest.approx(2.0, rel=1e-6)
    expected_normal = alpha * np.array([0.0, 0.0, -1.0])
    np.testing.assert_allclose(buffers.normals_camera[:, row, column].detach(), expected_normal, atol=1e-6)
    expected_color = alpha * np.array([0.2, 0.5, 3.0])
    np.testing.assert_allclose(buffers.colors[:, row, column].detach(), expected_color, rtol=1e-5)
    assert buffers.distortion[row, column].item() == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_surfels_blend_front_to_back(backend: str):
    camera = straight_camera(width=23, height=19)
    near, far = facing_surfel(camera, 2.0, 0.6), facing_surfel(camera, 3.0, 0.7)
    buffers = rendered(merged(far, near.replace(colors=torch.ones(1, 3, dtype=torch.float64))), backend)
    first, second = 0.6, 0.4 * 0.7
    assert buffers.alpha[9, 11].item() == pytest.approx(first + second, rel=1e-5)
    np.testing.assert_allclose(buffers.colors[:, 9, 11].detach(), first + second * np.array([0.2, 0.5, 3.0]), rtol=1e-5)
    assert buffers.accumulated_depth[9, 11].item() == pytest.approx(first * 2 + second * 3, rel=1e-5)
    # After the first surfel the transmittance is 0.4, so the second comes too late for the median.
    assert buffers.median_depth[9, 11].item() == pytest.approx(2.0, rel=1e-6)
    apart = 100 / 99.8 * (0.2 / 2 - 0.2 / 3)
    assert buffers.distortion[9, 11].item() == pytest.approx(first * second * apart**2, rel=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_curved_normal_by_hand(backend: str):
    camera = straight_camera()
    scene = facing_surfel(camera, 2.0, 0.8).replace(curvatures=torch.tensor([[0.7, -0.2, 0.4]], dtype=torch.float64))
    buffers = rendered(scene, backend)
    row, column = 8, 15
    x = (column + 0.5 - camera.cx) / camera.fx * 2.0
    y = (row + 0.5 - camera.cy) / camera.fy * 2.0
    normal = np.array([0.7 * x - 0.2 * y, -0.2 * x + 0.4 * y, -1.0])
    np.testing.assert_allclose(
        buffers.normals_camera[:, row, column].detach() / buffers.alpha[row, column].item(), normal, atol=2e-6
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_color_one_blends_to_alpha_and_transmittance_to_the_rest(backend: str):
    """Colors of one make the color image Σ w, which must be 1 − Π (1 − alpha_i)."""
    scene = random_scene(20, 7, False, tilted_camera())
    buffers = rendered(scene.replace(colors=torch.ones(20, 3, dtype=torch.float64)), backend)
    assert (buffers.colors - buffers.alpha).abs().max() < 3e-6
    assert buffers.alpha.min() >= 0
    assert buffers.alpha.max() <= 1


@pytest.mark.parametrize("backend", BACKENDS)
def test_images_do_not_change_when_world_and_camera_turn_together(backend: str):
    scene = random_scene(20, 11, True, tilted_camera())
    quat = torch.tensor([0.4, -0.7, 0.2, 0.5], dtype=torch.float64)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = rotation(quat)
    w, axis = quat[:1], quat[1:].expand(20, 3)
    scalars, vectors = scene.quats[:, :1], scene.quats[:, 1:]
    turned_quats = torch.cat(
        [
            w * scalars - (axis * vectors).sum(-1, keepdim=True),
            w * vectors + scalars * axis + torch.linalg.cross(axis, vectors),
        ],
        -1,
    )
    camera = dataclasses.replace(scene.camera, world_to_camera=scene.camera.world_to_camera @ turn.T)
    turned = scene.replace(means=scene.means @ turn[:3, :3].T, quats=turned_quats, camera=camera)
    assert_agree(rendered(turned, backend), rendered(scene, backend), AGREEMENT[backend])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("parameter", ["means", "quats", "scales", "opacities", "colors", "curvatures"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_surfel_that_is_not_finite_is_culled(backend: str, parameter: str, value: float):
    scene = random_scene(6, 5, True, tilted_camera())
    broken = scene.parameters()[parameter].clone()
    broken[2] = value
    scene = scene.replace(**{parameter: broken}).cast(FLOAT_TYPE[backend])
    others = [0, 1, 3, 4, 5]
    expected = scene.replace(**{name: p[others] for name, p in scene.parameters().items()}).render(backend)
    buffers = scene.render(backend)
    assert_agree(buffers, expected, 1e-7)
    assert not buffers.in_frustum[2]
    sum(getattr(buffers, name).sum() for name in IMAGES).backward()
    for name, leaf in scene.parameters().items():
        assert leaf.grad.isfinite().all(), name
        assert (leaf.grad[2] == 0).all(), name


@pytest.mark.parametrize("count", [20, 200])
def test_backends_cull_the_same_surfels(count: int):
    scene = random_scene(count, 2, False, tilted_camera())
    scene = scene.replace(means=3 * scene.means, opacities=scene.opacities - 0.3)
    found = [rendered(scene, backend).in_frustum for backend in BACKENDS]
    assert found[0].equal(found[1])
    assert 0 < found[0].sum() < count


#: In the first two each image is wanted once and unwanted once; a kernel for each choice takes seconds to compile.
CHOICES = [
    (False, Channels(True, False, False)),
    (True, Channels(False, True, True)),
    *(
        pytest.param(curved, Channels(*wanted), marks=pytest.mark.slow)
        for curved, *wanted in itertools.product((False, True), repeat=4)
        if (curved, *wanted) not in ((False, True, False, False), (True, False, True, True))
    ),
]
IMAGES_OF = {
    "colors": ("colors",),
    "depth": ("accumulated_depth", "median_depth"),
    "distortion": ("distortion",),
}


def weighted_gradients(scene: SurfelScene, names: list[str], backend: str, **options) -> dict[str, torch.Tensor]:
    """Gradients of a random linear function of the named images."""
    leaves = scene.cast(FLOAT_TYPE[backend])
    buffers = leaves.render(backend, **options)
    generator = torch.Generator().manual_seed(7)
    image = (scene.camera.height, scene.camera.width)
    weights = {
        name: torch.randn(*((3, *image) if name in IMAGES[:2] else image), generator=generator) for name in IMAGES
    }
    sum((getattr(buffers, name) * weights[name]).sum() for name in names).backward()
    return {
        name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.parameters().items()
    }


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("curved", "channels"), CHOICES)
def test_channels_that_are_not_wanted_change_nothing_else(curved: bool, channels: Channels, backend: str):
    """They are zero; the other images and their gradients are those of the full computation."""
    scene = random_scene(20, 21, curved, tilted_camera())
    whole = rendered(scene, backend)
    buffers = scene.cast(FLOAT_TYPE[backend]).render(backend, channels=channels)
    unwanted = {image for name, images in IMAGES_OF.items() if not getattr(channels, name) for image in images}
    for image in IMAGES:
        expected = torch.zeros_like(getattr(whole, image)) if image in unwanted else getattr(whole, image)
        assert (getattr(buffers, image) - expected).abs().max() < 1e-6 * max(1.0, expected.abs().max().item()), image
    wanted = [image for image in IMAGES if image not in unwanted]
    expected_gradients = weighted_gradients(scene, wanted, backend)
    for name, gradient in weighted_gradients(scene, wanted, backend, channels=channels).items():
        scale = expected_gradients[name].abs().max().item()
        # The order of float32 operations may differ between variants of the kernel.
        assert (gradient - expected_gradients[name]).abs().max() <= 1e-4 * scale, name


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("seed", range(3))
def test_tiles_that_are_not_active_change_nothing_in_the_others(seed: int, backend: str):
    """Images are the full ones where tiles are active and zero elsewhere; so are losses and gradients."""
    camera = dataclasses.replace(tilted_camera(width=75, height=50), fx=60.0, fy=66.0)
    scene = random_scene(40, seed, True, camera)
    active = torch.rand(tile_shape(50, 75), generator=torch.Generator().manual_seed(seed)) < 0.5
    pixels = active.repeat_interleave(16, 0).repeat_interleave(16, 1)[:50, :75]
    whole = rendered(scene, backend)
    buffers = scene.cast(FLOAT_TYPE[backend]).render(backend, active_tiles=active)
    assert buffers.in_frustum.equal(whole.in_frustum)
    for image in IMAGES:
        assert torch.equal(getattr(buffers, image), torch.where(pixels, getattr(whole, image), 0)), image

    def gradients(active_tiles: torch.Tensor | None) -> dict[str, torch.Tensor]:
        leaves = scene.cast(FLOAT_TYPE[backend])
        images = leaves.render(backend, active_tiles=active_tiles)
        sum((getattr(images, image).square() * pixels).sum() for image in IMAGES).backward()
        return {name: leaf.grad for name, leaf in leaves.parameters().items()}

    expected = gradients(None)
    for name, gradient in gradients(active).items():
        # Sums over tiles are taken in the same order, without the zeros between.
        assert (gradient - expected[name]).abs().max() <= 1e-6 * expected[name].abs().max(), name


def test_tiles_of_another_image_are_refused():
    scene = random_scene(3, 1, False, tilted_camera()).cast(torch.float32)
    with pytest.raises(ValueError, match="expected active_tiles of shape"):
        scene.render("cpu", active_tiles=torch.ones(1, 1, dtype=torch.bool))


def test_reference_in_chunks_gives_the_same_images(monkeypatch):
    from panoless.splats.kernels.reference import rasterize as reference

    scene = random_scene(20, 4, True, tilted_camera()).cast(torch.float64)
    whole = scene.render("reference")
    monkeypatch.setattr(reference, "PAIRS_AT_ONCE", 1000)
    assert_agree(scene.render("reference"), whole, 1e-12)


def test_wrong_arguments_are_explained():
    scene = random_scene(3, 1, False, tilted_camera())
    single = scene.cast(torch.float32)
    with pytest.raises(ValueError, match="float32"):
        scene.render("cpu")
    with pytest.raises(ValueError, match="0 < near < far"):
        scene.replace(camera=dataclasses.replace(scene.camera, near=0.0)).render("reference")
    with pytest.raises(ValueError, match="one dtype"):
        scene.replace(scales=scene.scales.float()).render("auto")
    # jaxtyping checks shapes first in this test session; users without it get the operator's own words.
    unchecked = inspect.unwrap(rasterize)
    with pytest.raises(ValueError, match="expected scales of shape"):
        unchecked(single.means, single.quats, single.scales[:2], single.opacities, single.colors, None, single.camera)


def test_auto_takes_the_kernel_for_float32_and_the_reference_otherwise():
    scene = random_scene(5, 6, False, tilted_camera())
    assert scene.cast(torch.float32).render("auto").colors.dtype == torch.float32
    assert scene.cast(torch.float64).render("auto").colors.dtype == torch.float64
    single = scene.cast(torch.float32)
    without = rasterize(single.means, single.quats, single.scales, single.opacities, single.colors, None, scene.camera)
    assert torch.equal(without.colors, single.render("cpu").colors)
