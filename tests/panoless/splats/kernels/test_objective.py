"""The objective of a mirror, proved thrice: gradcheck of the definition, kernel against definition, finite differences
of the kernel; and what is not requested is not there.
"""

import inspect
from dataclasses import replace

import pytest
import torch

from panoless.splats.kernels.objective import MirrorView, Objective, ObjectiveTerms, mirror_objective

NAMES = ("normals_camera", "alpha", "accumulated_depth", "median_depth", "albedo", "environment")
PHOTOMETRIC = ObjectiveTerms(robust_scale=0.3)
ALL = ObjectiveTerms(robust_scale=0.3, lambda_normal_consistency=0.7, lambda_silhouette=1.3)
TERMS = {
    "photometric": PHOTOMETRIC,
    "all pixels vote": replace(PHOTOMETRIC, robust_scale=0.0),
    "sigmoid": replace(PHOTOMETRIC, activation="sigmoid"),
    "alpha twice": replace(PHOTOMETRIC, alpha_applied="paper"),
    "silhouette": replace(PHOTOMETRIC, photometric=False, lambda_silhouette=1.3),
    "consistency": replace(PHOTOMETRIC, photometric=False, lambda_normal_consistency=0.7),
    "consistency of the expected depth": replace(ALL, depth_blend=0.0),
    "consistency of the median depth": replace(ALL, depth_blend=1.0),
    "consistency everywhere": replace(ALL, consistency_everywhere=True),
    "all": ALL,
}


def scene(height: int = 21, width: int = 37, resolution: int = 5, seed: int = 0, *, holes: bool = True):
    """Images like those of a bumpy object, in float64, and the view that they are compared with.

    Without holes alpha stays away from the ends of the cross-entropy's range and from the half at which a surface
    begins, where there is no derivative.
    """
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    alpha = (1.3 * noise(height, width)).clamp(max=1) if holes else 0.55 + 0.4 * noise(height, width)
    if holes:
        alpha[3:6, 4:9] = 0
    depth = 3 + 0.3 * noise(height, width)
    normals = 0.6 * noise(3, height, width) - 0.3
    normals[2] -= 1
    images = {
        "normals_camera": alpha * normals,
        "alpha": alpha,
        "accumulated_depth": alpha * depth,
        "median_depth": (depth + 0.02 * noise(height, width)) * (alpha > 0),
        "albedo": 0.3 * alpha * noise(3, height, width),
        "environment": 2 * noise(6, 3, resolution, resolution) - 0.5,
    }
    rotation = torch.linalg.qr(noise(3, 3) - 0.5)[0]
    view = MirrorView(
        radiance=noise(3, height, width),
        mask=(2 * noise(height, width)).clamp(max=1),
        camera_to_world_rotation=rotation,
        fx=40.0,
        fy=42.0,
        cx=width / 2 + 0.3,
        cy=height / 2 - 0.7,
        solid_alpha=0.99,
    )
    return images, view


def cast(view: MirrorView, dtype: torch.dtype) -> MirrorView:
    changed = {name: value.to(dtype) for name, value in vars(view).items() if isinstance(value, torch.Tensor)}
    return replace(view, **changed)


def pulled_back(images, view, terms, backend: str, cotangent: float = 1.0) -> tuple[Objective, dict[str, torch.Tensor]]:
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = {name: image.to(dtype).clone().requires_grad_() for name, image in images.items()}
    found = mirror_objective(*leaves.values(), cast(view, dtype), terms, backend=backend)
    gradients = torch.autograd.grad(
        found.total, list(leaves.values()), found.total.new_tensor(cotangent), allow_unused=True, materialize_grads=True
    )
    return found, {name: gradient.double() for name, gradient in zip(NAMES, gradients, strict=True)}


@pytest.mark.parametrize("name", TERMS)
def test_the_kernel_agrees_with_the_definition(name: str) -> None:
    """Value, every part, and every gradient for a random cotangent."""
    images, view = scene()
    expected, expected_gradients = pulled_back(images, view, TERMS[name], "reference", -1.7)
    found, gradients = pulled_back(images, view, TERMS[name], "cpu", -1.7)
    # Where alpha is one, the cross-entropy takes the logarithm of 1 − (1 − 10⁻⁴), which float32 knows to 10⁻⁴.
    assert float(found.total.detach()) == pytest.approx(float(expected.total.detach()), rel=3e-5)
    for part, needed in (("photometric", 5e-6), ("normal_consistency", 2e-5), ("silhouette", 3e-5)):
        assert getattr(found, part) == pytest.approx(getattr(expected, part), rel=needed, abs=1e-9), part
    for image, gradient in expected_gradients.items():
        # Measured: 1e-5 of the largest, where differences of depths are rounded.
        assert (gradients[image] - gradient).abs().max() <= 1e-4 * gradient.abs().max(), image


@pytest.mark.parametrize("size", [(1, 1), (2, 40), (3, 3), (16, 16), (5, 129)])
def test_images_of_any_size_are_fine(size: tuple[int, int]) -> None:
    images, view = scene(*size, holes=False)
    expected, expected_gradients = pulled_back(images, view, ALL, "reference")
    found, gradients = pulled_back(images, view, ALL, "cpu")
    assert float(found.total.detach()) == pytest.approx(float(expected.total.detach()), rel=1e-5)
    for image, gradient in expected_gradients.items():
        assert (gradients[image] - gradient).abs().max() <= 1e-4 * gradient.abs().max() + 1e-12, image


@pytest.mark.parametrize("name", TERMS)
def test_the_definition_passes_gradcheck(name: str) -> None:
    """The weight of the robust term is held constant, so it is left out here."""
    images, view = scene(5, 6, resolution=2, seed=3, holes=False)
    leaves = [image.clone().requires_grad_() for image in images.values()]
    terms = replace(TERMS[name], robust_scale=0.0)
    assert torch.autograd.gradcheck(
        lambda *values: mirror_objective(*values, view, terms, backend="reference").total, leaves
    )


@pytest.mark.parametrize("image", NAMES)
def test_the_kernel_agrees_with_its_own_finite_differences(image: str) -> None:
    images, view = scene(seed=1, holes=False)
    terms = replace(ALL, robust_scale=0.0)
    generator = torch.Generator().manual_seed(2)
    direction = torch.randn(images[image].shape, generator=generator, dtype=torch.float64)
    step = 1e-4

    def moved(sign: int) -> float:
        found, _ = pulled_back({**images, image: images[image] + sign * step * direction}, view, terms, "cpu")
        weights = 1.0, terms.lambda_normal_consistency, terms.lambda_silhouette
        parts = found.photometric, found.normal_consistency, found.silhouette
        return sum(weight * part for weight, part in zip(weights, parts, strict=True))

    _, gradients = pulled_back(images, view, terms, "cpu")
    expected = float((gradients[image] * direction).sum())
    # Parts are sums of float32 terms in float64: 1e-8 over the step; rays that cross a line between texels add kinks.
    assert (moved(1) - moved(-1)) / (2 * step) == pytest.approx(expected, rel=0.02, abs=1e-3)


def test_without_albedo_it_is_as_with_a_black_one() -> None:
    images, view = scene()
    black, gradients = pulled_back({**images, "albedo": 0 * images["albedo"]}, view, ALL, "cpu")
    leaves = {name: image.float().requires_grad_() for name, image in images.items() if name != "albedo"}
    arguments = [leaves.get(name) for name in NAMES]
    found = mirror_objective(*arguments, cast(view, torch.float32), ALL, backend="cpu")
    found.total.backward()
    assert torch.equal(found.total, black.total)
    for name, leaf in leaves.items():
        assert torch.equal(leaf.grad.double(), gradients[name]), name


@pytest.mark.parametrize("name", ["photometric", "all"])
def test_gradients_of_the_environment_alone_are_the_same(name: str) -> None:
    images, view = scene()
    whole, gradients = pulled_back(images, view, TERMS[name], "cpu")
    constants = {image: value.float() for image, value in images.items()}
    environment = constants.pop("environment").requires_grad_()
    found = mirror_objective(*constants.values(), environment, cast(view, torch.float32), TERMS[name], backend="cpu")
    found.total.backward()
    assert torch.equal(found.total, whole.total)
    assert torch.equal(environment.grad.double(), gradients["environment"])


def test_what_no_term_reads_may_hold_anything() -> None:
    """Depths without consistency, and radiance and normals of pixels that are not solid."""
    images, view = scene()
    terms = replace(PHOTOMETRIC, lambda_silhouette=1.0)
    expected, expected_gradients = pulled_back(images, view, terms, "cpu")
    nothing = torch.full_like(images["alpha"], torch.nan)
    away = view.mask <= view.solid_alpha
    spoiled = {**images, "accumulated_depth": nothing, "median_depth": nothing}
    spoiled["normals_camera"] = torch.where(away, torch.nan, images["normals_camera"])
    spoiled_view = replace(view, radiance=torch.where(away, torch.nan, view.radiance))
    found, gradients = pulled_back(spoiled, spoiled_view, terms, "cpu")
    assert torch.equal(found.total, expected.total)
    for name, gradient in expected_gradients.items():
        assert torch.equal(gradients[name], gradient), name


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_view_without_a_solid_pixel_or_a_surface_adds_nothing(backend: str) -> None:
    images, view = scene()
    empty = {name: (image if name == "environment" else 0 * image) for name, image in images.items()}
    found, gradients = pulled_back(empty, replace(view, mask=0 * view.mask), ALL, backend)
    assert found.photometric == found.normal_consistency == 0
    assert all(torch.isfinite(gradient).all() for gradient in gradients.values())
    assert all((gradient == 0).all() for gradient in gradients.values())


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    images, view = scene(90, 130, resolution=16)
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(pulled_back(images, view, ALL, "cpu"))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(found[0][0].total, found[1][0].total)
    for name, gradient in found[0][1].items():
        assert torch.equal(gradient, found[1][1][name]), name


def test_gradients_are_given_away_once() -> None:
    images, view = scene()
    leaves = [image.float().requires_grad_() for image in images.values()]
    found = mirror_objective(*leaves, cast(view, torch.float32), ALL, backend="cpu")
    found.total.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="backward once"):
        found.total.backward()


def test_images_that_do_not_fit_are_named() -> None:
    images, view = scene()
    images["alpha"] = images["alpha"][:, 1:]
    # jaxtyping checks shapes first in this test session; users without it get the operator's own words.
    with pytest.raises(ValueError, match="expected normals_camera of shape"):
        inspect.unwrap(mirror_objective)(*images.values(), view, ALL)
