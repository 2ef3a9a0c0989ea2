"""Held-out views distinguish a golden mirror from a perfect one, and its views become those of a perfect one."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.encoding import LDR
from panoless.capture.views import TrainView, Views
from panoless.config import EnvironmentConfig, FitConfig
from panoless.environment.options import MaterialOptions
from panoless.environment.reflectance import Reflectance
from panoless.geometry.plane.kind import PlaneMirror
from panoless.geometry.revolution.kind import RevolutionMirror
from panoless.selection.material import as_perfect_mirror, earned_reflectance, without_scattered_light
from shinypartial.core.sphere import fibonacci_directions
from tests.support.mirror_plane import RECTANGLE, arc, plane_of, reflecting_views
from tests.support.mirror_revolution import around, goblet, rays_of, revolution_views
from tests.support.synthetic_dataset import environment_radiance

GOLD = np.array([1.0, 0.77, 0.34])
MIRROR = RevolutionMirror(goblet(), occlusion_test=False)
CONFIG = FitConfig(environment=EnvironmentConfig(solve_resolution=16))
"""With texels as wide as the views are coarse."""
PERFECT = revolution_views(MIRROR.surface, around(15, size=48))


def golden(view: TrainView) -> TrainView:
    """What gold shows of it, by the angles at which the surface is met."""
    _, directions = rays_of(view.camera)
    hits = MIRROR.surface.hits(*rays_of(view.camera))
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    cosine = np.abs((directions * hits.normals).sum(1))[:, None]
    share = GOLD + (1 - GOLD) * (1 - cosine) ** 5
    return replace(view, radiance=view.radiance * torch.from_numpy(share.T.reshape(view.radiance.shape)).float())


@pytest.fixture(scope="module")
def gold() -> Views:
    return replace(PERFECT, train=tuple(golden(view) for view in PERFECT.train))


def test_gold_is_found_where_held_out_views_gain(gold: Views) -> None:
    """Within 3 % at 48 px; a perfect mirror stays one, and so does gold where nobody is to ask."""
    found = earned_reflectance(gold, MIRROR, CONFIG)
    assert found is not None
    assert found.at_normal == pytest.approx(GOLD, abs=0.03)
    assert earned_reflectance(PERFECT, MIRROR, CONFIG) is None
    assert earned_reflectance(gold, MIRROR, replace(CONFIG, material=MaterialOptions(reflectance="off"))) is None
    assert earned_reflectance(gold, MIRROR, replace(CONFIG, tint=(1.0, 0.77, 0.34))) is None


def test_a_plane_does_not_tell_its_color() -> None:
    """In a far world it shows each direction at one angle."""
    plane = plane_of(RECTANGLE)
    views = reflecting_views(plane, arc(10, size=48))
    tinted = tuple(replace(view, radiance=view.radiance * torch.tensor(GOLD)[:, None, None]) for view in views.train)
    assert earned_reflectance(replace(views, train=tinted), PlaneMirror(plane), CONFIG) is None


def test_views_of_gold_become_those_of_a_perfect_mirror(gold: Views) -> None:
    """At solid pixels; what is saturated has the largest value, for it may be any brighter."""
    found = as_perfect_mirror(gold, gold, MIRROR, Reflectance(GOLD), LDR)
    for view, true in zip(found.train, PERFECT.train, strict=True):
        seen, truth = (each.radiance.flatten(1)[:, view.solid] for each in (view, true))
        unsaturated = truth < 0.99
        assert seen[unsaturated] == pytest.approx(truth[unsaturated].numpy(), abs=1e-4)
    bright = tuple(replace(view, radiance=torch.ones_like(view.radiance)) for view in gold.train[:1])
    one = replace(gold, train=bright)
    largest = as_perfect_mirror(one, one, MIRROR, Reflectance(GOLD), LDR).train[0].radiance.flatten(1)
    assert largest[:, bright[0].solid[0]].numpy() == pytest.approx(1 / GOLD, rel=1e-5)


def lacquered(view: TrainView, albedo: float) -> TrainView:
    """What a mirror of the rest of the light shows that scatters a part of it: ρ ∫ E (n·ω)₊ dω/π by 4000 directions."""
    around = fibonacci_directions(4000)
    normals = MIRROR.surface.hits(*rays_of(view.camera)).normals
    falling = np.maximum(normals @ around.T, 0) @ environment_radiance(around) * (4 / len(around))
    scattered = torch.from_numpy(albedo * falling.T.reshape(view.radiance.shape)).float()
    return replace(view, radiance=((1 - albedo) * view.radiance + scattered * (view.mask > 0)).clamp(max=1))


def test_a_veil_of_scattered_light_is_taken_off() -> None:
    """Within what 48 px determine: an albedo of 0.3 is determined to 0.1, and views come twice as near to those of a
    perfect mirror. Without a veil, or where held-out views leave nothing to explain, nothing is done.
    """
    veiled = replace(PERFECT, train=tuple(lacquered(view, 0.3) for view in PERFECT.train))
    material, found = (
        earned_reflectance(veiled, MIRROR, CONFIG),
        without_scattered_light(veiled, veiled, MIRROR, 0.3, CONFIG),
    )
    assert material is not None
    assert found is not None
    assert material.albedo == pytest.approx(0.3, abs=0.1)
    errors = {}
    for name, views in {"veiled": veiled, "found": found[0]}.items():
        pairs = zip(views.train, PERFECT.train, strict=True)
        errors[name] = torch.cat([(one.radiance - other.radiance).flatten(1)[:, one.solid] for one, other in pairs], 1)
    assert float(errors["found"].abs().median()) < 0.55 * float(errors["veiled"].abs().median())
    elsewhere = tuple(replace(view, camera=replace(view.camera, fx=1.1 * view.camera.fx)) for view in veiled.train)
    again = without_scattered_light(replace(veiled, train=elsewhere), veiled, MIRROR, 0.3, CONFIG)
    assert again is not None
    for one, other in zip(again[0].train, found[0].train, strict=True):
        assert torch.equal(one.radiance, other.radiance), "cameras are those of the corrected views"
        assert one.camera.fx != other.camera.fx
    assert without_scattered_light(veiled, veiled, MIRROR, 0.0, CONFIG) is None
    assert without_scattered_light(PERFECT, PERFECT, MIRROR, 0.3, CONFIG) is None


COLOR = np.array([0.6, 0.1, 0.05])


def labeled(view: TrainView) -> TrainView:
    """With a matte label on one side of the body."""
    label = torch.from_numpy(on_label(view).reshape(view.mask.shape)) & (view.mask > 0.5)
    color = torch.from_numpy(COLOR).float()[:, None, None]
    return replace(view, radiance=torch.where(label, color, view.radiance))


def on_label(view: TrainView) -> np.ndarray:
    """Which pixels see it."""
    hits = MIRROR.surface.hits(*rays_of(view.camera))
    return hits.met & (hits.points[:, 1] < -0.3) & (np.abs(hits.points[:, 0]) < 0.25)


def test_a_label_is_found_and_left_out() -> None:
    """It is matte, and the mirror beside it stays as it was."""
    views = replace(PERFECT, train=tuple(labeled(view) for view in PERFECT.train))
    found = earned_reflectance(views, MIRROR, CONFIG)
    assert found is not None
    assert found.field is not None
    assert found.tint == (1, 1, 1)
    clean = as_perfect_mirror(views, views, MIRROR, found, LDR)
    kept = of_label = left = 0
    for before, view, true in zip(views.train, clean.train, PERFECT.train, strict=True):
        label = on_label(before)[before.solid.numpy()]
        stays = np.isin(before.solid.numpy(), view.solid.numpy())
        of_label, left = of_label + int(label.sum()), left + int((label & ~stays).sum())
        kept += int((stays & ~label).sum())
        same = view.solid[~np.isin(view.solid.numpy(), before.solid.numpy()[label])]
        apart = (view.radiance - true.radiance).flatten(1)[:, same].abs()
        assert float(apart.median()) < 0.01
    assert of_label > 200
    assert left > 0.6 * of_label
    assert kept > 0.9 * (sum(len(view.solid) for view in views.train) - of_label)
