"""The Triton rasterizer against loops, against the definition's gradients and against its own finite differences."""

import dataclasses
import math

import pytest
import torch

from panoless.splats.kernels.rasterize import RasterBuffers
from tests.panoless.splats.kernels.test_rasterize import AGREEMENT, assert_agree, looped
from tests.panoless.splats.kernels.test_rasterize import SCENES as SPECIAL_SCENES
from tests.panoless.splats.kernels.test_rasterize_gradients import assert_close, cotangents, pull_back
from tests.support.surfel_scenes import (
    IMAGES,
    SurfelScene,
    facing_surfel,
    merged,
    random_scene,
    straight_camera,
    tilted_camera,
)

# The interpreter computes with numpy, which warns where masked lanes overflow.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


def leaves_on(scene: SurfelScene, device: torch.device) -> SurfelScene:
    """Fresh float32 leaves on a device."""
    parameters = scene.parameters().items()
    return scene.replace(**{name: p.detach().to(device, torch.float32).requires_grad_() for name, p in parameters})


def rendered(scene: SurfelScene, device: torch.device) -> RasterBuffers:
    """Images on the CPU, without a graph."""
    with torch.no_grad():
        buffers = leaves_on(scene, device).render("gpu")
    return RasterBuffers(**{f.name: getattr(buffers, f.name).cpu() for f in dataclasses.fields(RasterBuffers)})


def gradients(scene: SurfelScene, device: torch.device, weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Gradients of Σ weights · images, in float64 on the CPU."""
    leaves = leaves_on(scene, device)
    buffers = leaves.render("gpu")
    loss = sum((getattr(buffers, name).double() * weight.to(device)).sum() for name, weight in weights.items())
    parameters = leaves.parameters()
    found = torch.autograd.grad(loss, list(parameters.values()), allow_unused=True, materialize_grads=True)
    return {name: gradient.double().cpu() for name, gradient in zip(parameters, found, strict=True)}


@pytest.mark.parametrize("name", SPECIAL_SCENES)
def test_loops_and_kernel_agree(name: str, device: torch.device):
    """Also without surfels, with one, behind the camera, edge-on, saturated, at equal depths, below a pixel in size."""
    assert_agree(rendered(SPECIAL_SCENES[name], device), looped(SPECIAL_SCENES[name]), AGREEMENT["cpu"])


def gradient_scenes() -> dict[str, SurfelScene]:
    camera = tilted_camera(width=21, height=18)
    moved = random_scene(8, 3, True, camera)
    return {
        "flat": random_scene(8, 1, False, camera),
        "curved": random_scene(8, 2, True, camera),
        "small": random_scene(12, 3, True, camera, size=0.02),
        "saturated": merged(*(facing_surfel(straight_camera(), 2.0 + 0.1 * i, 1.0) for i in range(6))),
        "moved": moved.replace(screen_offsets=torch.linspace(-2, 2, 16, dtype=torch.float64).view(8, 2)),
        "none": random_scene(0, 0, True, camera),
    }


SCENES = gradient_scenes()


@pytest.mark.parametrize(
    ("name", "image"), [*((name, "all") for name in SCENES), *(("curved", image) for image in IMAGES)]
)
def test_kernel_pulls_back_like_the_reference(name: str, image: str, device: torch.device):
    weights = cotangents(SCENES[name], 5)
    weights = weights if image == "all" else {image: weights[image]}
    # Float32 rounding of the slopes of oblique surfels; 1e-5 measured in the interpreter, 1e-4 with the CPU kernels.
    expected = pull_back(SCENES[name], "reference", weights) if len(SCENES[name].means) else {}
    assert_close(gradients(SCENES[name], device, weights), expected, 1e-3)


@pytest.mark.parametrize(
    "parameter", ["means", "quats", "scales", "opacities", "colors", "curvatures", "screen_offsets"]
)
def test_kernel_agrees_with_its_own_finite_differences(parameter: str, device: torch.device):
    """Faint surfels larger than the image and nearly parallel to it leave no edge inside; the median jumps, and is
    left out.
    """
    scene = random_scene(4, 12, True, tilted_camera(width=20, height=13), size=4.0)
    scene = scene.replace(opacities=0.1 + 0.3 * scene.opacities)
    toward = torch.tensor([0.9, -0.2, 0.3, -0.1], dtype=torch.float64)
    scene = scene.replace(quats=toward + 0.15 * torch.nn.functional.normalize(scene.quats, dim=-1))
    weights = cotangents(scene, 3)
    del weights["median_depth"]
    direction = torch.randn(scene.parameters()[parameter].shape, generator=torch.Generator().manual_seed(1)).double()
    expected = (gradients(scene, device, weights)[parameter] * direction).sum().item()

    def loss(step: float) -> float:
        buffers = rendered(scene.replace(**{parameter: scene.parameters()[parameter] + step * direction}), device)
        return sum((getattr(buffers, name).double() * weight).sum().item() for name, weight in weights.items())

    step = 2e-3
    # Rounding of a loss of about 40 in float32, over the step, leaves about 0.005; curvature of the loss the rest.
    assert (loss(step) - loss(-step)) / (2 * step) == pytest.approx(expected, rel=5e-3, abs=0.05)


def stacked(count: int) -> SurfelScene:
    """Many faint surfels behind each other in one tile: no pixel is finished before the last."""
    scene = random_scene(count, 9, True, tilted_camera(width=14, height=11), size=1.0)
    return scene.replace(opacities=0.02 + 0.1 * scene.opacities)


def test_neither_tiles_nor_chunks_change_anything(device: torch.device, monkeypatch: pytest.MonkeyPatch):
    """A list may be shorter or longer than a chunk or as long; a tile may divide the image or not."""
    from panoless.kernels.gpu import launch

    scene = stacked(9)
    weights = cotangents(scene, 7)
    results = []
    for tile, chunk in ((32, 64), (32, 4), (8, 9)):
        monkeypatch.setattr(launch, "TILES", launch.TileLaunch(tile=tile, chunk=chunk))
        results.append((rendered(scene, device), gradients(scene, device, weights)))
    for buffers, pulled in results[1:]:
        assert_agree(buffers, results[0][0], 1e-5)
        assert_close(pulled, results[0][1], 1e-4)


def test_an_opaque_surfel_hides_what_lies_behind(device: torch.device):
    """Behind three surfels of alpha 0.99 no transmittance above 1e-4 is left, so the fourth has neither weight nor
    gradient.
    """
    front = [facing_surfel(straight_camera(), 2.0 + 0.1 * i, 1.0, size=20.0) for i in range(3)]
    behind = facing_surfel(straight_camera(), 3.0, 0.9, size=0.5)
    alone, both = merged(*front), merged(*front, behind)
    assert_agree(rendered(both, device), rendered(alone, device), 0.0)
    pulled = gradients(both, device, cotangents(both, 2))
    assert all((gradient[3] == 0).all() for gradient in pulled.values())
    assert all((gradient[0] != 0).any() for name, gradient in pulled.items() if name in ("colors", "means"))


@pytest.mark.parametrize("value", [math.nan, pytest.param(math.inf, marks=pytest.mark.slow)])
@pytest.mark.parametrize("parameter", ["means", "quats", "scales", "opacities", "colors", "curvatures"])
def test_a_surfel_that_is_not_finite_is_culled(parameter: str, value: float, device: torch.device):
    scene = random_scene(3, 5, True, tilted_camera(width=21, height=18))
    broken = scene.parameters()[parameter].clone()
    broken[1] = value
    scene = scene.replace(**{parameter: broken})
    expected = scene.replace(**{name: p[[0, 2]] for name, p in scene.parameters().items()})
    buffers = rendered(scene, device)
    assert_agree(buffers, rendered(expected, device), 1e-7)
    assert buffers.in_frustum.tolist() == [True, False, True]
    for name, gradient in gradients(scene, device, cotangents(scene, 1)).items():
        assert gradient.isfinite().all(), name
        assert (gradient[1] == 0).all(), name


@pytest.mark.parametrize("count", [20, 200])
def test_the_kernel_culls_the_same_surfels(count: int, device: torch.device):
    scene = random_scene(count, 2, False, tilted_camera())
    scene = scene.replace(means=3 * scene.means, opacities=scene.opacities - 0.3, scales=0.1 * scene.scales)
    found = rendered(scene, device).in_frustum
    assert found.equal(scene.cast(torch.float64).render("reference").in_frustum)
    assert 0 < found.sum() < count


def test_two_forwards_may_precede_two_backwards(device: torch.device):
    scenes = (SCENES["flat"], SCENES["curved"])
    weights = cotangents(scenes[0], 1)
    expected = [gradients(scene, device, weights) for scene in scenes]
    leaves = [leaves_on(scene, device) for scene in scenes]
    losses = []
    for scene in leaves:
        buffers = scene.render("gpu")
        losses.append(sum((getattr(buffers, n).double() * w.to(device)).sum() for n, w in weights.items()))
    for loss, scene, gradient in zip(losses, leaves, expected, strict=True):
        loss.backward()
        found = {name: leaf.grad.double().cpu() for name, leaf in scene.parameters().items()}
        # Atomic additions come in any order.
        assert_close(found, gradient, 1e-5)


def test_parameters_need_not_be_contiguous(device: torch.device):
    scene = leaves_on(SCENES["curved"], device)
    turned = {n: p.detach().T.contiguous().T if p.ndim == 2 else p.detach() for n, p in scene.parameters().items()}
    assert not turned["means"].is_contiguous()
    with torch.no_grad():
        assert torch.equal(scene.replace(**turned).render("gpu").colors, scene.render("gpu").colors)


def test_wrong_tensors_are_explained(device: torch.device):
    scene = random_scene(3, 1, False, tilted_camera())
    with pytest.raises(ValueError, match="float32 tensors on a GPU"):
        scene.cast(torch.float64).render("gpu")
