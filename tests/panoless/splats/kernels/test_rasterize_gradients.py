"""Gradients of the rasterizer, proved thrice: gradcheck of the reference, kernel against reference, finite
differences of the kernel.
"""

import platform
import re

import pytest
import torch
from numba import njit

from tests.support.surfel_scenes import (
    IMAGES,
    SurfelScene,
    facing_surfel,
    merged,
    random_scene,
    straight_camera,
    tilted_camera,
)


def test_reference_passes_gradcheck():
    """Every image with respect to every parameter; the seed keeps fragments away from the cut-offs, where no
    derivative exists.
    """
    camera = straight_camera(width=4, height=4, focal=4.0)
    scene = random_scene(3, 8, True, camera, size=0.5)
    scene = scene.replace(means=scene.means + torch.tensor([0.0, 0.0, 2.5], dtype=torch.float64)).cast(torch.float64)
    names = list(scene.parameters())

    def images(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        buffers = scene.replace(**dict(zip(names, values, strict=True))).render("reference")
        return tuple(getattr(buffers, name) for name in IMAGES)

    torch.autograd.gradcheck(images, tuple(scene.parameters().values()))


def cotangents(scene: SurfelScene, seed: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    image = (scene.camera.height, scene.camera.width)
    return {
        name: torch.randn(*((3, *image) if name in IMAGES[:2] else image), generator=generator, dtype=torch.float64)
        for name in IMAGES
    }


def pull_back(scene: SurfelScene, backend: str, weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Gradients of Σ weights · images, in float64."""
    leaves = scene.cast(torch.float64 if backend == "reference" else torch.float32)
    buffers = leaves.render(backend)
    loss = sum((getattr(buffers, name).double() * weight).sum() for name, weight in weights.items())
    parameters = leaves.parameters()
    found = torch.autograd.grad(loss, list(parameters.values()), allow_unused=True, materialize_grads=True)
    return {name: gradient.double() for name, gradient in zip(parameters, found, strict=True)}


def assert_close(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor], tolerance: float) -> None:
    for name, gradient in expected.items():
        scale = max(gradient.abs().max().item(), 1e-6)
        assert (found[name] - gradient).abs().max().item() <= tolerance * scale, name


def gradient_scenes() -> dict[str, SurfelScene]:
    tilted, straight = tilted_camera(), straight_camera()
    return {
        "flat": random_scene(20, 1, False, tilted),
        "curved": random_scene(20, 2, True, tilted),
        "small": random_scene(60, 3, True, tilted, size=0.02),
        "saturated": merged(*(facing_surfel(straight, 2.0 + 0.1 * i, 1.0) for i in range(6))),
    }


SCENES = gradient_scenes()


@pytest.mark.parametrize("image", [*IMAGES, "all"])
@pytest.mark.parametrize("name", SCENES)
def test_kernel_pulls_back_like_the_reference(name: str, image: str):
    weights = cotangents(SCENES[name], 5)
    weights = weights if image == "all" else {image: weights[image]}
    # Float32 rounding of the slopes of oblique surfels: 1e-4 measured.
    assert_close(pull_back(SCENES[name], "cpu", weights), pull_back(SCENES[name], "reference", weights), 1e-3)


@pytest.mark.parametrize(
    "parameter", ["means", "quats", "scales", "opacities", "colors", "curvatures", "screen_offsets"]
)
def test_kernel_agrees_with_its_own_finite_differences(parameter: str):
    """Surfels larger than the image leave no edge inside it; the median jumps where the order of half transmittance
    changes, and is left out.
    """
    scene = random_scene(10, 12, True, tilted_camera(width=48, height=33), size=4.0)
    # Faint enough that no pixel is finished early, and nearly parallel to the image, since oblique surfels end inside
    # it.
    scene = scene.replace(opacities=0.1 + 0.3 * scene.opacities)
    toward = torch.tensor([0.9, -0.2, 0.3, -0.1], dtype=torch.float64)
    scene = scene.replace(quats=toward + 0.15 * torch.nn.functional.normalize(scene.quats, dim=-1))
    weights = cotangents(scene, 3)
    del weights["median_depth"]
    direction = torch.randn(scene.parameters()[parameter].shape, generator=torch.Generator().manual_seed(1)).double()
    expected = (pull_back(scene, "cpu", weights)[parameter] * direction).sum().item()

    def loss(step: float) -> float:
        moved = scene.replace(**{parameter: scene.parameters()[parameter] + step * direction}).cast(torch.float32)
        buffers = moved.render("cpu")
        return sum((getattr(buffers, name).double() * weight).sum().item() for name, weight in weights.items())

    step = 2e-3
    # Rounding of a loss of about 100 in float32, over the step, leaves about 0.01; curvature of the loss the rest.
    assert (loss(step) - loss(-step)) / (2 * step) == pytest.approx(expected, rel=5e-3, abs=0.05)


def test_screen_offsets_move_the_whole_footprint():
    scene = random_scene(20, 6, True, tilted_camera())
    shifted = scene.replace(screen_offsets=torch.full((20, 2), 2.0, dtype=torch.float64))
    for backend in ("reference", "cpu"):
        dtype = torch.float64 if backend == "reference" else torch.float32
        plain, moved = (s.cast(dtype).render(backend) for s in (scene, shifted))
        for name in IMAGES:
            a, b = getattr(plain, name)[..., :-2, :-2], getattr(moved, name)[..., 2:, 2:]
            assert (a - b).abs().max() < 1e-4, name


def test_two_forwards_may_precede_two_backwards():
    """Autograd's state belongs to its own forward, although buffers are used again."""
    first, second = SCENES["flat"], SCENES["curved"]
    weights = cotangents(first, 1)
    expected = [pull_back(scene, "cpu", weights) for scene in (first, second)]
    leaves = [scene.cast(torch.float32) for scene in (first, second)]
    losses = []
    for scene in leaves:
        buffers = scene.render("cpu")
        losses.append(sum((getattr(buffers, name).double() * weight).sum() for name, weight in weights.items()))
        del buffers
    for loss, scene, gradients in zip(losses, leaves, expected, strict=True):
        loss.backward()
        for name, leaf in scene.parameters().items():
            assert torch.equal(leaf.grad.double(), gradients[name]), name


def test_results_outlive_later_calls():
    scene = SCENES["flat"].cast(torch.float32)
    kept = scene.render("cpu").colors.detach()
    copy = kept.clone()
    for seed in range(3):
        random_scene(20, seed, False, tilted_camera()).cast(torch.float32).render("cpu")
    assert torch.equal(kept, copy)


def test_gradients_do_not_depend_on_the_number_of_threads():
    weights = cotangents(SCENES["curved"], 2)
    threads = torch.get_num_threads()
    try:
        found = []
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(pull_back(SCENES["curved"], "cpu", weights))
    finally:
        torch.set_num_threads(threads)
    for name, gradient in found[0].items():
        assert torch.equal(gradient, found[1][name]), name


def packed_and_scalar_products(assembly: str) -> tuple[int, int]:
    """Count multiplications of whole vectors and of single numbers."""
    if platform.machine().lower() in ("x86_64", "amd64"):
        packed = re.findall(r"\bv?(?:mul|fn?m(?:add|sub)\d+)ps\b", assembly)
        single = re.findall(r"\bv?(?:mul|fn?m(?:add|sub)\d+)ss\b", assembly)
    elif platform.machine().lower() in ("arm64", "aarch64"):
        packed = re.findall(r"\bfm(?:ul|la|ls)(?:\.4s)?\s+v\d+(?:\.4s)?", assembly)
        single = re.findall(r"\bf(?:mul|n?madd|n?msub)\s+s\d+", assembly)
    else:
        pytest.skip(f"no vector instructions are known here for {platform.machine()}")
    return len(packed), len(single)


@pytest.mark.parametrize("curved", [False, True])
def test_block_kernels_are_vector_code(curved: bool):
    from panoless.kernels.cpu.compilation import LANE_CODE
    from panoless.splats.kernels.cpu import blend, blend_backward

    name = "curved" if curved else "flat"
    pull_back(SCENES[name], "cpu", cotangents(SCENES[name], 1))
    for used in (blend.blend, blend_backward.blend_backward):
        signature = next(each for each in used.signatures if len(each[1].types[0]) == curved)
        # Compiled again, because Numba shows no code for functions that come from its disk cache.
        fresh = njit(**{**LANE_CODE, "cache": False})(used.py_func)
        fresh.compile(signature)
        code = fresh.inspect_asm(fresh.signatures[0])
        packed, single = packed_and_scalar_products(code)
        # Measured: 46 to 130 packed, of which only the few on per-surfel numbers may be single; as scalar code there
        # are none.
        assert packed > 30, used
        assert single < packed / 4, used
        # Counting references by atomic operations took a quarter of the time.
        assert "NRT_" not in code, used
