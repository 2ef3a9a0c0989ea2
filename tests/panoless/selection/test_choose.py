"""The rung of a scene: the outline refuses a plane, held-out views tell a bent mirror from a flat one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.geometry.plane.model import Plane, unoccluded_share
from panoless.geometry.surfels.model import Surfels
from panoless.geometry.surfels.placement import surfels_on_plane
from panoless.reconstruct.fit import _first_state, _trial, fit
from panoless.reconstruct.snapshots import SnapshotSchedule
from panoless.selection.choose import choose_rung, without_frame_reflections
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset
from tests.support.mirror_plane import NORMAL, RECTANGLE, arc, make_plane_dataset, plane_of, reflecting_views
from tests.support.mirror_revolution import around, goblet, pillar_views, revolution_views
from tests.support.mirror_sphere import tiny_config

CONFIG = replace(tiny_config(iterations=200, count=200), model="auto")
SIZE_PX = 64


def framed(frame_height: float, bend: float = 0.0) -> Views:
    return reflecting_views(plane_of(RECTANGLE, frame_height), arc(12, size=SIZE_PX), bend)


def no_trial(views: Views, config: FitConfig, start: Surfels) -> Surfels:
    pytest.fail("nothing was to be fitted")


def as_started(views: Views, config: FitConfig, start: Surfels) -> Surfels:
    return start


def dome(plane: Plane, bend: float, count: int) -> Surfels:
    """Surfels on a plane with the normals n + bend·(p₁ t_u + p₂ t_v) of the traced dome."""
    from scipy.spatial.transform import Rotation

    flat = surfels_on_plane(plane, count, seed=0)
    points = flat.means.double().numpy()
    tangents = np.stack([plane.tangent_u, plane.tangent_v])
    normals = plane.normal + bend * (points @ tangents.T) @ tangents
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    first = plane.tangent_u - (normals @ plane.tangent_u)[:, None] * normals
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normals, first), normals], 2)
    quats = torch.from_numpy(Rotation.from_matrix(frames).as_quat()[:, [3, 0, 1, 2]]).float()
    curvatures = torch.tensor([-bend, 0.0, -bend]).expand(flat.count, 3).clone()
    return replace(flat, quats=quats, curvatures=curvatures)


@pytest.mark.parametrize("frame_height", [0.0, 0.1])
@pytest.mark.parametrize("bend", [0.0, 0.1])
def test_a_flat_mirror_takes_the_plane_and_a_bent_one_in_the_same_outline_does_not(
    frame_height: float, bend: float
) -> None:
    """A dome whose normals turn by 4° at most has the same masks; a frame that mirrors itself misleads neither."""
    rung = choose_rung(framed(frame_height, bend), CONFIG, _trial)
    assert (rung.model == "plane") == (bend == 0)
    assert ("not flat" in rung.reason) == (bend > 0)
    assert rung.plane is not None
    assert rung.plane.normal @ NORMAL > np.cos(np.radians(0.2))


def test_right_surfels_beat_the_plane_of_a_bent_mirror() -> None:
    """With the traced dome's own normals, however far they turn, here by 11°."""
    rung = choose_rung(framed(0.0, 0.3), CONFIG, lambda *_: dome(plane_of(RECTANGLE), 0.3, 800))
    assert rung.model == "surfels"


def test_surfels_that_explain_as_much_do_not_beat_the_plane() -> None:
    """Flat surfels on the plane say the same as the plane does."""
    assert choose_rung(framed(0.0), CONFIG, as_started).model == "plane"


def test_a_plane_that_explains_nothing_goes_even_if_the_trial_does_no_better() -> None:
    """A bent mirror in a flat outline, and surfels that did not learn to bend: the plane goes, and heights come."""
    rung = choose_rung(framed(0.0, 0.3), CONFIG, as_started)
    assert rung.model == "bent"
    assert ": not flat; " in rung.reason
    assert rung.plane is not None


def test_surfels_that_cover_nothing_do_not_beat_the_plane() -> None:
    """What nobody sees explains nothing."""

    def vanished(views: Views, config: FitConfig, start: Surfels) -> Surfels:
        return replace(start, opacity_logits=start.opacity_logits - 20)

    assert choose_rung(framed(0.0), CONFIG, vanished).model == "plane"


def test_a_box_is_refused_by_its_outline() -> None:
    """Before anything is fitted, as plane and as surface of revolution; the reason says how far away the plane is."""
    rung = choose_rung(pillar_views(around(16)), CONFIG, no_trial)
    assert rung.model == "surfels"
    assert rung.plane is None
    assert rung.surface is None
    assert rung.reason.startswith("no plane explains the outlines: ")
    assert "revolution" in rung.reason


def test_a_fit_remembers_why_it_took_surfels() -> None:
    """The reason of the ladder becomes part of the state, from which it goes into the prediction."""
    state = _first_state(pillar_views(around(16)), replace(CONFIG, model="auto"))
    assert state.rung.startswith("surfels (no plane explains the outlines: ")
    assert state.rung.endswith(")")
    assert not state.stepless
    assert state.geometry is state.surfels


def test_a_goblet_takes_the_surface_of_revolution() -> None:
    """Surfels that only start on it explain no more."""
    rung = choose_rung(revolution_views(goblet(), around(12)), CONFIG, as_started)
    assert rung.model == "revolution"
    assert rung.surface is not None
    assert rung.reason.endswith("no better")


def test_the_configuration_overrides_both_ways(views: Views) -> None:
    """Surfels for a flat mirror, a plane for a bent one and even for a sphere; nothing is compared."""
    chosen = {model: replace(CONFIG, model=model) for model in ("plane", "surfels")}
    rung = choose_rung(framed(0.0), chosen["surfels"], no_trial)
    assert (rung.model, rung.reason, rung.plane) == ("surfels", "asked for", None)
    for shown in (framed(0.0, 0.3), views):
        rung = choose_rung(shown, chosen["plane"], no_trial)
        assert rung.model == "plane"
        assert rung.reason.startswith("asked for")
        assert rung.plane is not None


def test_two_views_determine_no_plane() -> None:
    """That is a reason for surfels, and an error only for who asks for a plane."""
    views = framed(0.0)
    two = replace(views, train=views.train[:2])
    rung = choose_rung(two, CONFIG, no_trial)
    assert (rung.model, rung.plane) == ("surfels", None)
    with pytest.raises(InputError, match="at least 3 distinct places"):
        choose_rung(two, replace(CONFIG, model="plane"), no_trial)


def test_what_mirrors_the_frame_is_left_out() -> None:
    """Exactly the solid pixels that see the environment stay: all without a rim, fewer with a rim."""
    for frame_height in (0.0, 0.1):
        plane, views = plane_of(RECTANGLE, frame_height), framed(frame_height)
        cleared = without_frame_reflections(views, plane)
        before, after = (sum(len(view.solid) for view in each.train) for each in (views, cleared))
        assert after == before if frame_height == 0 else 0.5 * before < after < before
        for view, clear in zip(views.train, cleared.train, strict=True):
            free = set(torch.nonzero(unoccluded_share(plane, view.camera).flatten() > 0.99)[:, 0].tolist())
            assert set(clear.solid.tolist()) == set(view.solid.tolist()) & free
            assert torch.equal(clear.mask, view.mask)


@pytest.fixture(scope="module")
def plane_dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_plane_dataset(tmp_path_factory.mktemp("datasets") / "plane", plane_of(RECTANGLE))


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_plane_has_a_solved_map_whatever_the_preset(tmp_path: Path, plane_dataset: Dataset, preset: str) -> None:
    """No steps are taken with it, so what gradient descent left or accumulated online would say nothing."""
    config = replace(tiny_config(preset, iterations=4, count=40), model="plane")
    state = fit(plane_dataset, config, tmp_path / "run")
    assert state.flat
    assert state.rung.startswith("plane (asked for")
    assert state.final_environment is not None
    assert state.visibility is not None
    assert state.peak_memory_bytes > 1e7
    seen = state.visibility > 0.5 * float(state.visibility.max())
    assert 0.005 < float(seen.float().mean()) < 0.5
    # 0.45 + 0.35 ω and a sun; random logits would be uniform in [0, 1].
    assert 0.05 < float(state.final_environment.permute(0, 2, 3, 1)[seen].mean()) < 0.95
    again = fit(plane_dataset, config, tmp_path / "run", SnapshotSchedule(iterations=frozenset({2})))
    assert again.flat
