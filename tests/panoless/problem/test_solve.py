"""Surfaces of few numbers with cameras, exposures and masks: what is wrong is found, all at once, and only that."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.corrections import with_silhouette_moved
from panoless.capture.lens import with_focal_factor
from panoless.capture.poses import Poses
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.surroundings import FAR, Surroundings
from panoless.geometry.height_field.model import flat_height_field
from panoless.geometry.registry import FAMILIES
from panoless.geometry.revolution.model import closed_profile
from panoless.geometry.revolution.silhouette import contour_rays
from panoless.geometry.revolution.unknowns import RevolutionUnknowns
from panoless.problem.blocks import Block, CameraPoses, Exposures, FocalLength, MaskOffsets, Walls
from panoless.problem.corrected import Corrected
from panoless.problem.equations import State
from panoless.problem.nuisance import Nuisance
from panoless.problem.parametric import ParametricSurface
from panoless.problem.solve import Solved, by_silhouettes, by_silhouettes_alone, solve
from panoless.selection.joint import nuisance_kinds
from tests.support.mirror_body import body_views, sphere
from tests.support.mirror_height_field import height_field_views
from tests.support.mirror_plane import RECTANGLE, arc, disc, plane_of, reflecting_views
from tests.support.mirror_revolution import around, goblet, revolution_views

CONFIG = FitConfig()


def views_of(kind: str, count: int, size: int) -> Views:
    """Of a mirror of that kind, in half of the light."""
    if kind == "sphere":
        views = body_views(sphere(0.8), count, size)
    elif kind == "plane":
        views = reflecting_views(plane_of(RECTANGLE), arc(count, size=size))
    elif kind == "height_field":
        views = height_field_views(flat_height_field(plane_of(disc(24)), 6).domed(0.3), arc(count, 15.0, size=size))
    else:
        views = revolution_views(goblet(), around(count, size))
    return replace(views, train=tuple(replace(view, radiance=view.radiance * 0.6) for view in views.train))


def solved(kind: str, views: Views, left: Collection[type[Block]] = (), around_it: Surroundings = FAR) -> Solved:
    """By a kind, from its own proposal, without the blocks that are `left` out."""
    family = FAMILIES[kind]
    source = family if family.refines is None else FAMILIES[family.refines]
    proposal = source.propose(views, CONFIG, requested=True)
    assert proposal is not None
    kinds, required = nuisance_kinds(CONFIG)
    with torch.no_grad():
        return solve(
            views,
            family.unknowns(views, proposal, CONFIG),
            [each for each in kinds if each not in left],
            required,
            lambda state: family.begun(Corrected.by(state.nuisance).applied(views, CONFIG), state.surface, CONFIG),
            around=around_it,
        )


KINDS = [
    ("sphere", 14, 80),
    *(pytest.param(kind, 20, 128, marks=pytest.mark.slow) for kind in ("plane", "height_field", "revolution")),
]


@pytest.mark.parametrize(("kind", "count", "size"), KINDS)
def test_right_photographs_need_no_block(kind: str, count: int, size: int) -> None:
    found = solved(kind, views_of(kind, count, size))
    assert not [each.name for each in found.decisions if each.kept]
    assert not found.state.nuisance.blocks


def test_proposed_walls_that_are_not_needed_leave_no_trace() -> None:
    views = views_of("sphere", 14, 80)
    found = solved("sphere", views, around_it=Surroundings(np.array([0.05])))
    without = solved("sphere", views, left=[Walls])
    assert [each.kept for each in found.decisions if each.name == Walls.name] == [False]
    np.testing.assert_array_equal(found.state.surface.shape.center, without.state.surface.shape.center)
    assert found.state.surface.shape.radius == without.state.surface.shape.radius


def test_past_the_limit_nothing_is_solved_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would end before its first round, and lose what was solved."""
    begun: list[bool] = []

    def started(views: Views, surface: ParametricSurface, nuisance: Nuisance) -> State:
        begun.append(bool(nuisance.free))
        return by_silhouettes(views, surface, nuisance)

    monkeypatch.setattr("panoless.problem.solve.by_silhouettes", started)
    monkeypatch.setattr("panoless.problem.solve.is_past_limit", lambda: True)
    found = solved("sphere", views_of("sphere", 14, 80), around_it=Surroundings(np.array([0.05])))
    assert [each.kept for each in found.decisions if each.name == Walls.name] == [False]
    assert begun.count(True) == 1


@pytest.mark.parametrize(("kind", "count", "size"), KINDS[:3])
def test_turns_exposures_and_masks_are_found_together(kind: str, count: int, size: int) -> None:
    """Turns of 0.3° in part, as few pixels determine them; exposures to a third, masks to a tenth of a pixel."""
    rng = np.random.default_rng(7)
    turns = rng.normal(size=(count, 3))
    turns *= np.radians(0.3) / np.linalg.norm(turns, axis=1, keepdims=True)
    gains = np.exp2(0.15 * rng.normal(size=count))
    gains /= np.exp(np.log(gains).mean())
    offsets = rng.uniform(-1, 1, count)
    views = Poses(turns, np.zeros((count, 3))).moved(views_of(kind, count, size))
    train = (
        with_silhouette_moved(replace(view, radiance=view.radiance * float(gain)), float(offset))
        for view, gain, offset in zip(views.train, gains, offsets, strict=True)
    )
    found = solved(kind, replace(views, train=tuple(train)))
    nuisance, kept = found.state.nuisance, {each.name for each in found.decisions if each.kept}
    assert {"poses", "exposures", "mask offsets"} <= kept
    assert not {"distortion", "white balances"} & kept
    cameras, exposures, masks = (nuisance.get(block) for block in (CameraPoses, Exposures, MaskOffsets))
    assert cameras is not None
    assert exposures is not None
    assert masks is not None
    assert np.sqrt(((exposures.values[:, 0] - np.log(gains)) ** 2).mean()) < np.log(gains).std() / 3
    assert (masks.values[:, 0] - offsets).std() < 0.1
    assert np.median(np.linalg.norm(cameras.values[:, :3] + turns, axis=1)) < np.radians(0.25)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_a_wrong_focal_length_is_found_with_a_flat_mirror(factor: float) -> None:
    """To half a percent with views of 128 px: 64 px determine it to a percent only."""
    views = views_of("plane", 20, 128)
    found = solved("plane", replace(views, train=tuple(with_focal_factor(view, factor) for view in views.train)))
    focal = found.state.nuisance.get(FocalLength)
    assert focal is not None
    assert np.exp(focal.values[0, 0]) == pytest.approx(1 / factor, abs=0.005)


def test_silhouettes_put_an_end_that_is_too_low_where_it_is() -> None:
    """A lid is the corner of wall and top: rays over its far edge, normal to neither, move both."""
    true = goblet()
    views = revolution_views(true, around(12), subpixels=1)
    pixel = contour_rays(views).pixel
    outer = true.profile[1 : true.lip + 1]
    low = closed_profile(outer[outer[:, 1] < true.profile[true.lip, 1] - 1.2 * pixel])
    start = replace(true, profile=low, lip=len(low) - 2)
    found = by_silhouettes_alone(views, RevolutionUnknowns(start, pixel)).surface
    before, after = (np.linalg.norm(each.profile[each.lip] - true.profile[true.lip]) for each in (start, found))
    assert before > 1.2 * pixel
    assert after < 0.3 * pixel
