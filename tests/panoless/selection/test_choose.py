"""Which kind a scene gets: silhouettes refuse a plane, held-out views distinguish a bent mirror from a flat one."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch

from panoless.capture.poses import Poses
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.geometry.base import Geometry, Proposal, usable_views
from panoless.geometry.free_form.options import FreeFormOptions
from panoless.geometry.plane.kind import PlaneMirror
from panoless.geometry.plane.model import unoccluded_share
from panoless.geometry.registry import FAMILIES
from panoless.geometry.revolution.kind import RevolutionFamily
from panoless.reconstruct.fit import begin, fit
from panoless.reconstruct.snapshots import SnapshotSchedule
from panoless.selection.candidates import Candidate, Selection, Verdict
from panoless.selection.choose import (
    Start,
    begun,
    choose_geometry,
    is_near,
    least_unexplained,
    much_less_unexplained,
)
from panoless.selection.options import CorrectionOptions
from shinypartial.core.errors import InputError
from shinypartial.dataset.perturb.masks import wobbling
from shinypartial.dataset.schema import Dataset
from tests.support.few_rounds import take_few_rounds
from tests.support.mirror_panes import grid_of, panes_views
from tests.support.mirror_plane import NORMAL, RECTANGLE, arc, make_plane_dataset, plane_of, reflecting_views
from tests.support.mirror_revolution import around, goblet, pillar_views, revolution_views
from tests.support.mirror_sphere import tiny_config

SIZE_PX = 56


def coarse_config() -> FitConfig:
    """As few surfels and steps as distinguish kinds, and maps as coarse as views of these few pixels resolve."""
    config = tiny_config(iterations=200, count=200)
    return replace(
        config,
        model="auto",
        environment=replace(config.environment, solve_resolution=32),
        # The traced dome has flat edges, so it looks like a flat mirror in a near room.
        surroundings=replace(config.surroundings, mode="off"),
        corrections=CorrectionOptions(poses="off", masks="off", exposure="off", lens="off"),
        free_form=FreeFormOptions(concavities=False, starts=False, finest_cells=20),
    )


CONFIG = coarse_config()


@pytest.fixture(autouse=True)
def few_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Enough to distinguish kinds."""
    take_few_rounds(monkeypatch, joint=3, revolutions=1)


def framed(frame_height: float, bend: float = 0.0) -> Views:
    return reflecting_views(plane_of(RECTANGLE, frame_height), arc(12, size=SIZE_PX), bend)


def verdicts(selection: Selection) -> dict[str, Verdict]:
    return {each.kind: each.verdict for each in selection.candidates}


@pytest.mark.parametrize(
    ("bend", "frame_height"),
    [(0.0, 0.0), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((0.0, 0.1), (0.1, 0.0), (0.1, 0.1)))],
)
def test_a_flat_mirror_takes_the_plane_and_a_bent_one_in_the_same_boundary_does_not(
    bend: float, frame_height: float
) -> None:
    """A dome whose normals turn by 4° at most has the same masks; a frame that mirrors itself misleads neither."""
    state = begin(framed(frame_height, bend), CONFIG)
    geometry, selection = state.geometry, state.selection
    assert state.training is None
    assert selection.chosen == geometry.kind
    kinds = list(FAMILIES)
    assert [each.kind for each in selection.candidates][: kinds.index("plane") + 1] == kinds[: kinds.index("plane") + 1]
    assert (geometry.kind == "plane") == (bend == 0)
    assert (verdicts(selection)["plane"] == Verdict.REFUSED_BY_HELD_OUT_VIEWS) == (bend > 0)
    plane = getattr(geometry, "plane", None) or geometry.height_field.plane
    assert plane.normal @ NORMAL > np.cos(np.radians(0.2))


def test_silhouettes_that_contradict_each_other_refuse_no_kind_for_what_they_err_by() -> None:
    """A boundary 1.3 px beside wandering silhouettes is near them, beside right ones it is not; nor is one that is 9 px
    away.
    """
    right = framed(0.0)
    wandering = replace(
        right,
        train=tuple(
            replace(view, mask=torch.from_numpy(wobbling(view.mask.numpy(), 2.0, np.random.default_rng(index))))
            for index, view in enumerate(right.train)
        ),
    )
    start, far = (Start(Proposal(None, away, 0.95)) for away in (1.3, 9.0))
    for views, near in ((right, False), (wandering, True)):
        assert is_near(start, views, CONFIG, bent=False) == near
        assert not is_near(far, views, CONFIG, bent=False)


@pytest.mark.slow
@pytest.mark.parametrize("bend", [0.0, 0.1])
def test_turned_cameras_change_no_choice_between_flat_and_bent(bend: float) -> None:
    """Their pictures are those of true cameras; the candidate says that its cameras were turned."""
    views, rng = reflecting_views(plane_of(RECTANGLE), arc(15), bend), np.random.default_rng(3)
    wrong = rng.normal(size=(15, 3))
    wrong *= np.radians(0.5) / np.linalg.norm(wrong, axis=1, keepdims=True)
    geometry, selection = choose_geometry(
        Poses(wrong, np.zeros((15, 3))).moved(views),
        replace(CONFIG, corrections=replace(CONFIG.corrections, poses="auto")),
    )
    assert geometry.kind == ("height_field" if bend else "plane")
    turned = selection.candidates[-1].camera_turn_deg
    assert turned is not None
    # Part of the turns is left open by few views: up to 0.69° are found.
    assert 0.3 < turned < 0.9


@pytest.mark.slow
def test_a_clear_bend_takes_heights() -> None:
    """However far its normals turn, here by 11°; the table says what refused the plane and what was left."""
    geometry, selection = choose_geometry(framed(0.0, 0.3), CONFIG)
    assert geometry.kind == selection.chosen == "height_field"
    errors = {each.kind: each.held_out_error for each in selection.candidates if each.held_out_error is not None}
    assert min(errors, key=lambda each: errors[each]) == "height_field"
    assert "plane: leaves too much unexplained" in selection.sentence
    assert f"held-out error {errors['height_field']:.4f}" in selection.sentence


def test_of_kinds_that_leave_too_much_the_simplest_that_leaves_least_is_taken() -> None:
    """A plane, which heights take on, counts only alone."""

    def left(kind: str, error: float) -> tuple[Candidate, Geometry]:
        geometry = PlaneMirror(plane_of(RECTANGLE))
        return Candidate(kind, Verdict.LEFT_TOO_MUCH, "", None, None, error), geometry

    def kept(*fitted: tuple[Candidate, Geometry]) -> str:
        return least_unexplained(fitted, CONFIG)[0].kind

    plane, bend = left("plane", 0.31), left("height_field", 0.4)
    assert kept(plane, bend) == "height_field"
    assert kept(plane, bend, left("free_form", 0.39)) == "height_field"
    assert kept(plane, bend, left("free_form", 0.32)) == "free_form"
    assert kept(plane) == "plane"


def test_what_is_doubted_stays_unless_another_leaves_much_less() -> None:
    """The simplest is compared with all after it, and a simple one that leaves half of its error replaces it."""

    views, whole = framed(0.0), PlaneMirror(plane_of(RECTANGLE))
    half = PlaneMirror(plane_of(RECTANGLE * [0.5, 1.0]))

    def chosen(*errors: float, geometry: Geometry = whole) -> int:
        fitted = [
            (Candidate(str(number), Verdict.CHOSEN, "", None, None, error), geometry)
            for number, error in enumerate(errors)
        ]
        return int(much_less_unexplained(fitted, views, CONFIG)[0].kind)

    assert chosen(0.2) == 0
    assert chosen(0.2, 0.11) == 0
    assert chosen(0.2, 0.09) == 1
    assert chosen(0.2, 0.09, 0.05) == 1
    assert chosen(0.2, 0.11, 0.05) == 2
    assert chosen(0.2, 0.05, geometry=half) == 0, "what misses half of the object explains no more"


def test_a_box_is_refused_by_its_silhouettes() -> None:
    """Before anything is fitted, as plane and as surface of revolution; the table says how far away they are."""
    geometry, selection = choose_geometry(pillar_views(around(10, SIZE_PX)), CONFIG)
    assert geometry.kind == "free_form"
    refused = Verdict.REFUSED_BY_SILHOUETTES, Verdict.NOT_PROPOSED
    assert all(verdicts(selection)[kind] in refused for kind in ("sphere", "plane", "height_field", "revolution"))
    plane = selection.candidates[1]
    assert plane.verdict == Verdict.NOT_PROPOSED or plane.silhouette_px > 0.5 or plane.overlap < 0.98
    assert selection.sentence.startswith("free_form (explains held-out views;")


@pytest.mark.slow
def test_silhouettes_turn_cameras_where_that_brings_a_shape_near() -> None:
    """Those of a goblet come back; of true ones nothing is turned."""
    views = revolution_views(goblet(), around(12, 96))
    rng = np.random.default_rng(0)
    turns = rng.normal(size=(12, 3))
    turns *= np.radians(0.5) / np.linalg.norm(turns, axis=1, keepdims=True)
    wrong = Poses(turns, np.zeros((12, 3))).moved(views)
    starts = [begun(RevolutionFamily(), each, FitConfig(), requested=False) for each in (views, wrong)]
    assert all(each is not None for each in starts)
    assert starts[0].poses is None
    assert starts[1].poses is not None
    raw = RevolutionFamily().propose(wrong, FitConfig(), requested=True)
    assert raw is not None
    assert starts[1].proposal.silhouette_px < 0.8 * raw.silhouette_px


def test_a_goblet_takes_the_surface_of_revolution(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a second round it leaves next to nothing of held-out views unexplained."""
    take_few_rounds(monkeypatch, joint=3, revolutions=2)
    geometry, selection = choose_geometry(revolution_views(goblet(), around(12, SIZE_PX)), CONFIG)
    assert geometry.kind == "revolution"
    assert selection.candidates[-1].held_out_error < 0.03


def test_the_configuration_overrides_both_ways(views: Views) -> None:
    """Surfels for a flat mirror, a plane for a bent one and even for a sphere; nothing is compared."""
    stated = replace(CONFIG, corrections=replace(CONFIG.corrections, poses="off"))
    chosen = {model: replace(stated, model=model) for model in ("plane", "surfels")}
    state = begin(framed(0.0), chosen["surfels"])
    assert state.geometry.kind == "surfels"
    assert state.training is not None
    assert state.selection.sentence == "surfels (requested)"
    for shown in (framed(0.0, 0.3), views):
        geometry, selection = choose_geometry(shown, chosen["plane"])
        assert geometry.kind == "plane"
        assert selection.sentence == "plane (requested)"


def test_what_silhouettes_refuse_altogether_is_an_error_that_says_why() -> None:
    """Two views determine no plane and nothing else, whether one is requested or not."""
    views = framed(0.0)
    two = replace(views, train=views.train[:2])
    with pytest.raises(InputError, match=r"plane: silhouettes determine none.* free_form: .*--model surfels"):
        choose_geometry(two, CONFIG)
    with pytest.raises(InputError, match="at least 3 distinct places"):
        choose_geometry(two, replace(CONFIG, model="plane"))


def test_what_mirrors_the_frame_is_left_out() -> None:
    """Exactly the solid pixels that see the environment stay: all without a frame, fewer with one."""
    for frame_height in (0.0, 0.1):
        plane, views = plane_of(RECTANGLE, frame_height), framed(frame_height)
        cleared = usable_views(views, PlaneMirror(plane))
        before, after = (sum(len(view.solid) for view in each.train) for each in (views, cleared))
        assert after == before if frame_height == 0 else 0.5 * before < after < before
        for view, clear in zip(views.train, cleared.train, strict=True):
            free = set(torch.nonzero(unoccluded_share(plane, view.camera).flatten() > 0.99)[:, 0].tolist())
            assert set(clear.solid.tolist()) == set(view.solid.tolist()) & free
            assert torch.equal(clear.mask, view.mask)


@pytest.fixture(scope="module")
def plane_dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_plane_dataset(tmp_path_factory.mktemp("datasets") / "plane", plane_of(RECTANGLE))


@pytest.mark.parametrize("preset", ["default", pytest.param("paper", marks=pytest.mark.slow)])
def test_a_plane_has_a_solved_map_whatever_the_preset(tmp_path: Path, plane_dataset: Dataset, preset: str) -> None:
    """No steps are taken with it, so what gradient descent left or accumulated online would say nothing."""
    weighted = CorrectionOptions(masks="off", exposure="off", lens="off")
    config = replace(tiny_config(preset, iterations=4, count=40), model="plane", corrections=weighted)
    state = fit(plane_dataset, config, tmp_path / "run")
    assert state.geometry.kind == "plane"
    assert state.selection.sentence == "plane (requested)"
    assert state.environment is not None
    assert state.visibility is not None
    assert state.peak_memory_bytes > 1e7
    seen = state.visibility > 0.5 * float(state.visibility.max())
    assert 0.005 < float(seen.float().mean()) < 0.5
    # 0.45 + 0.35 ω and a sun; random logits would be uniform in [0, 1].
    assert 0.05 < float(state.environment.permute(0, 2, 3, 1)[seen].mean()) < 0.95
    again = fit(plane_dataset, config, tmp_path / "run", SnapshotSchedule(iterations=frozenset({2})))
    assert again.geometry.kind == "plane"


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["off", "on"])
def test_panes_are_compared_with_a_bent_mirror_in_any_surroundings(mode: Literal["off", "on"]) -> None:
    """In near surroundings the bent mirror starts from the plane, too."""
    config = replace(CONFIG, surroundings=replace(CONFIG.surroundings, mode=mode))
    views = panes_views(grid_of(plane_of(RECTANGLE), 3, 2), arc(16, size=96))
    geometry, selection = choose_geometry(views, config)
    assert geometry.kind == "panes"
    assert verdicts(selection)["plane"] != Verdict.CHOSEN
