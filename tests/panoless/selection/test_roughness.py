"""A rough mirror is distinguished from a smooth one by held-out views, made by facets that are drawn at random."""

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
import torch
from jaxtyping import Float

from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from panoless.environment.options import MaterialOptions
from panoless.geometry.revolution.kind import RevolutionMirror
from panoless.selection.blur import Blur, BlurTrial, judged_blur, needed_blur
from tests.support.mirror_revolution import around, goblet, rays_of, revolution_views

ROUGHNESS = 0.3
MIRROR = RevolutionMirror(goblet(), occlusion_test=False)


def found_blur(views: Views) -> Blur:
    """With texels as wide as the views are coarse, and rougher than slightly, so that they show it."""
    return needed_blur(views, MIRROR, FitConfig(), first_roughness=0.15, roughnesses=(0.05, 0.5), trials=4)


def checkered(directions: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P 3"]:
    """Squares 20° wide at the equator."""
    azimuth, height = np.arctan2(directions[..., 1], directions[..., 0]), np.arcsin(directions[..., 2].clip(-1, 1))
    squares = np.sign(np.sin(9 * azimuth) * np.sin(9 * height))
    return np.stack([0.4 + 0.3 * squares, 0.4 - 0.2 * squares, 0.5 + 0.1 * squares], -1)


def mirrored(view: TrainView, roughness: float) -> TrainView:
    """What facets tilted by atan(α √(u/(1 − u))) to all sides show, u and the side uniform: a mean over 100 of them."""
    origins, directions = rays_of(view.camera)
    hits = MIRROR.surface.hits(origins, directions)
    random = np.random.default_rng(5)
    share, side = random.random((2, 100, len(directions)))
    normals = hits.normals + 1e-9
    first = np.cross(normals, [0.3, 0.5, 0.8])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    tilt = (roughness**2 * np.sqrt(share / (1 - share)))[..., None]
    facets = normals + tilt * (
        np.cos(2 * np.pi * side)[..., None] * first + np.sin(2 * np.pi * side)[..., None] * np.cross(normals, first)
    )
    facets /= np.linalg.norm(facets, axis=-1, keepdims=True)
    light = checkered(directions - 2 * (directions * facets).sum(-1, keepdims=True) * facets).mean(0)
    image = torch.from_numpy((light * hits.met[:, None]).T.reshape(view.radiance.shape)).float()
    return replace(view, radiance=image)


def views_of(roughness: float) -> Views:
    plain = revolution_views(MIRROR.surface, around(15, size=48))
    return replace(plain, train=tuple(mirrored(view, roughness) for view in plain.train))


@pytest.mark.slow
def test_a_rough_mirror_is_found_and_a_smooth_one_stays_smooth() -> None:
    """It comes out too low, as steps end before edges are sharp."""
    found = found_blur(views_of(ROUGHNESS))
    assert found.blur_px is None
    assert found.roughness is not None
    assert 0.4 * ROUGHNESS < found.roughness < 1.2 * ROUGHNESS
    assert found_blur(views_of(1e-3)) == Blur()


@pytest.mark.slow
def test_blurred_pictures_are_told_from_a_rough_mirror() -> None:
    """It comes out too low: fields of the checkered world are narrower than such a pixel in these views."""
    plain = views_of(1e-3)
    soft = tuple(replace(view, radiance=_blurred(view, 1.0)) for view in plain.train)
    found = found_blur(replace(plain, train=soft))
    assert found.roughness is None
    assert found.blur_px is not None
    assert 0.3 < found.blur_px < 1.2


def _blurred(view: TrainView, sigma_px: float) -> torch.Tensor:
    from scipy.ndimage import gaussian_filter

    weight = np.maximum(gaussian_filter(view.mask.numpy(), sigma_px), 1e-3)
    planes = [gaussian_filter((plane * view.mask).numpy(), sigma_px) / weight for plane in view.radiance]
    return torch.from_numpy(np.stack(planes)).float()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (MaterialOptions(roughness="off", blur="off", known_roughness=0.2), None),
        (MaterialOptions(known_roughness=0.2), 0.2),
    ],
)
def test_a_roughness_that_is_off_or_known_is_not_searched(options: MaterialOptions, expected: float | None) -> None:
    views = revolution_views(MIRROR.surface, around(5, size=16))
    assert needed_blur(views, MIRROR, FitConfig(material=options)) == Blur(roughness=expected)


@pytest.mark.parametrize(("sharp", "evaluations"), [(0.004, 1), (0.04, 7)])
def test_nothing_else_is_tried_where_a_sharp_map_explains_all(sharp: float, evaluations: int) -> None:
    """Though a rough mirror would explain half of what little is left."""
    found: list[Blur] = []

    class Trial:
        def errors(self, blur: Blur, *_: object) -> np.ndarray:
            found.append(blur)
            return np.full(5, sharp if blur.roughness is None else sharp / 2) + np.linspace(0, 1e-6, 5)

        def searched(self, blur: Callable[[float], Blur], bounds: tuple[float, float], trials: int) -> float:
            return 0.1

    taken = judged_blur(cast(BlurTrial, Trial()), MaterialOptions())
    assert taken == (Blur() if evaluations == 1 else Blur(roughness=0.1))
    assert len(found) == evaluations


def test_blur_and_roughness_are_found_beside_each_other() -> None:
    """Errors fall by both; smoothing a map afterwards gains nothing."""

    class Trial:
        def errors(self, blur: Blur, *_: object) -> np.ndarray:
            error = 0.04 * (1 if blur.roughness is None else 0.6) * (1 if blur.blur_px is None else 0.8)
            return np.full(5, error) + np.linspace(0, 1e-6, 5)

        def searched(self, blur: Callable[[float], Blur], bounds: tuple[float, float], trials: int) -> float:
            return 0.1 if blur(0.1).blur_px is None else 0.7

    found = judged_blur(cast(BlurTrial, Trial()), MaterialOptions())
    assert found == Blur(roughness=0.1, blur_px=0.7)
