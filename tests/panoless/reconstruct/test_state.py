"""A run folder: its state survives the disk, damage is named, and nobody else's folder is taken."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.poses import Poses
from panoless.environment.reflectance import Reflectance
from panoless.geometry.base import Geometry, from_plain
from panoless.geometry.height_field.kind import HeightFieldMirror
from panoless.geometry.plane.kind import PlaneMirror
from panoless.geometry.revolution.kind import RevolutionMirror
from panoless.presets import PRESETS
from panoless.reconstruct.state import (
    CHECKPOINT,
    DESCRIPTION,
    FitState,
    acquire_run,
    load_state,
    read_description,
    save_state,
)
from panoless.selection.candidates import Candidate, Selection, Verdict
from panoless.splats.mirror import SurfelMirror
from panoless.splats.training import Training
from shinypartial.core.errors import InputError
from shinypartial.prediction.format import Trust
from tests.support.mirror_height_field import bumpy
from tests.support.mirror_plane import L_SHAPE, plane_of
from tests.support.mirror_revolution import around, funnel, goblet, rays_of
from tests.support.mirror_sphere import sphere_surfels

CONFIG = PRESETS["default"]
DATASET = Path("datasets/vase")


def some_state(final: bool, geometry: Geometry | None = None) -> FitState:
    optimizer = {
        "adam": {"state": {0: {"exp_avg": torch.rand(7, 3)}}, "param_groups": [{"lr": 0.1, "name": "means"}]},
        "gradients": [torch.rand(7), torch.ones(7)],
    }
    refused = Candidate("plane", Verdict.REFUSED_BY_SILHOUETTES, "misses the silhouettes", math.inf, 0.5)
    chosen = Candidate("surfels", Verdict.CHOSEN, "no simpler kind explains the views")
    return FitState(
        geometry=geometry or SurfelMirror(sphere_surfels(7), curved=False),
        frame=ObjectFrame(np.array([1.0, 2.0, 1 / 3]), 0.5),
        selection=Selection("surfels", (refused, chosen)),
        training=Training(torch.rand(6, 3, 4, 4), torch.rand(6, 4, 4), 42, optimizer),
        environment=torch.rand(6, 3, 8, 8) if final else None,
        seconds={"optimize": 1.5},
        curves={"loss": [3.0, 2.0]},
        peak_memory_bytes=10,
        verdict=Trust("partly", "a reason", "a remedy", 1.5, {"unexplained": 0.3}) if final else None,
    )


def reloaded(folder: Path, state: FitState) -> FitState:
    save_state(folder, state)
    loaded = load_state(folder)
    assert isinstance(loaded, FitState)
    return loaded


@pytest.mark.parametrize("final", [False, True])
def test_a_state_survives_the_disk(tmp_path: Path, final: bool) -> None:
    state = some_state(final)
    loaded = reloaded(tmp_path, state)
    assert [path.name for path in tmp_path.iterdir()] == [CHECKPOINT]
    assert isinstance(loaded.geometry, SurfelMirror)
    assert isinstance(state.geometry, SurfelMirror)
    torch.testing.assert_close(loaded.geometry.surfels.named(), state.geometry.surfels.named(), rtol=0, atol=0)
    assert not loaded.geometry.curved
    np.testing.assert_array_equal(loaded.frame.center, state.frame.center)
    for name in ("selection", "seconds", "curves", "peak_memory_bytes", "iteration", "device", "verdict"):
        assert getattr(loaded, name) == getattr(state, name), name
    assert loaded.training is not None
    assert state.training is not None
    for name in ("environment", "evidence"):
        assert torch.equal(getattr(loaded.training, name), getattr(state.training, name)), name
    adam, expected = loaded.training.optimizer["adam"], state.training.optimizer["adam"]
    assert adam["param_groups"] == expected["param_groups"]
    assert torch.equal(adam["state"][0]["exp_avg"], expected["state"][0]["exp_avg"])
    assert (loaded.environment is not None) == final
    if final:
        assert torch.equal(loaded.environment, state.environment)


def test_a_material_survives_the_disk_and_an_earlier_version_had_none(tmp_path: Path) -> None:
    state = replace(some_state(True), reflectance=Reflectance(np.array([1.0, 0.77, 1 / 3])), roughness=0.1)
    loaded = reloaded(tmp_path, state)
    assert loaded.roughness == 0.1
    assert loaded.reflectance is not None
    assert loaded.reflectance.tint == (1.0, 0.77, 1 / 3)
    content = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    del content["reflectance"], content["roughness"]
    torch.save(content, tmp_path / CHECKPOINT)
    earlier = load_state(tmp_path)
    assert earlier is not None
    assert earlier.reflectance is None
    assert earlier.roughness is None


def exact_kinds() -> list[Geometry]:
    plane = plane_of(L_SHAPE, frame_height=0.1 / 3, offset=1 / 7)
    return [
        PlaneMirror(plane, occlusion_test=False),
        HeightFieldMirror(bumpy(plane, 0.02)),
        RevolutionMirror(funnel(1 / 3)),
    ]


@pytest.mark.parametrize("geometry", exact_kinds(), ids=lambda geometry: geometry.kind)
def test_every_exact_kind_survives_the_disk(tmp_path: Path, geometry: Geometry) -> None:
    """To the last bit, and what a camera sees of it."""
    camera = around(3, 24)[2]
    poses = Poses(np.full((3, 3), 0.01), np.full((3, 3), 1 / 3))
    geometry = geometry.with_poses(poses)
    loaded = reloaded(tmp_path, some_state(True, geometry)).geometry
    assert loaded.poses is not None
    assert np.array_equal(loaded.poses.stacked, poses.stacked)
    assert type(loaded) is type(geometry)
    assert loaded.state_dict() == geometry.state_dict()
    for field, values in vars(geometry.buffers(camera)).items():
        assert torch.equal(getattr(loaded.buffers(camera), field), values), field


def test_what_an_earlier_version_did_not_know_has_its_default() -> None:
    plain = RevolutionMirror(funnel(1 / 3)).state_dict()
    del plain["poses"]
    assert RevolutionMirror.from_state_dict(plain).poses is None
    for kind in exact_kinds()[:2]:
        content = kind.state_dict()
        assert content.pop("poses") is None
        assert type(kind).from_state_dict(content).poses is None


def test_what_is_missing_has_its_default_also_where_each_has_its_own() -> None:
    plain = from_plain(Reflectance, {"at_normal": [1.0, 0.77, 1 / 3]})
    assert np.array_equal(plain.at_normal, [1.0, 0.77, 1 / 3])
    assert not plain.albedo.any()


def test_a_surface_of_revolution_that_was_used_is_saved_like_a_new_one(tmp_path: Path) -> None:
    """What it computed about itself meanwhile is no part of it."""
    new, used = RevolutionMirror(goblet()), RevolutionMirror(goblet())
    used.surface.hits(*rays_of(around(1, 8)[0]))
    assert used.state_dict() == new.state_dict()


def test_before_the_first_checkpoint_there_is_none(tmp_path: Path) -> None:
    assert load_state(tmp_path) is None


@pytest.mark.parametrize("damage", ["truncated", "text", "empty", "another version"])
def test_a_damaged_checkpoint_is_named(tmp_path: Path, damage: str) -> None:
    save_state(tmp_path, some_state(False))
    path = tmp_path / CHECKPOINT
    content = path.read_bytes()
    if damage == "another version":
        torch.save({"surfels": {}, "iteration": 3}, path)
    else:
        path.write_bytes({"truncated": content[: len(content) // 2], "text": b"hello", "empty": b""}[damage])
    with pytest.raises(InputError, match=r"checkpoint\.pt.*Delete that run folder"):
        load_state(tmp_path)


def test_a_checkpoint_that_would_run_code_is_refused_without_advice_to_load_it(tmp_path: Path) -> None:
    torch.save({"geometry": Path}, tmp_path / CHECKPOINT)
    with pytest.raises(InputError, match=r"UnpicklingError.*Delete that run folder") as raised:
        load_state(tmp_path)
    assert "weights_only" not in str(raised.value)


def test_a_failed_save_keeps_the_last_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_state(tmp_path, some_state(False))

    def full(*_) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        save_state(tmp_path, replace(some_state(False), peak_memory_bytes=43))
    assert [path.name for path in tmp_path.iterdir()] == [CHECKPOINT]
    loaded = load_state(tmp_path)
    assert loaded is not None
    assert loaded.iteration == 42


def test_a_run_can_be_claimed_again_by_the_same_fit(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    for _ in range(2):
        acquire_run(folder, DATASET, "hash", CONFIG)
    description = read_description(folder)
    assert description.config == CONFIG
    assert description.dataset == DATASET.resolve()


@pytest.mark.parametrize(
    ("dataset_hash", "config"),
    [("other", CONFIG), ("hash", replace(CONFIG, seed=1)), ("hash", PRESETS["paper"])],
    ids=["dataset", "seed", "preset"],
)
def test_another_fit_is_refused(tmp_path: Path, dataset_hash: str, config) -> None:
    acquire_run(tmp_path / "run", DATASET, "hash", CONFIG)
    before = (tmp_path / "run" / DESCRIPTION).read_bytes()
    with pytest.raises(InputError, match="another dataset or configuration"):
        acquire_run(tmp_path / "run", DATASET, dataset_hash, config)
    assert (tmp_path / "run" / DESCRIPTION).read_bytes() == before


def test_other_photographs_are_refused_once_there_is_a_checkpoint(tmp_path: Path) -> None:
    for photographs in ("first", "corrected"):
        acquire_run(tmp_path, DATASET, "hash", CONFIG, photographs)
    save_state(tmp_path, some_state(False))
    acquire_run(tmp_path, DATASET, "hash", CONFIG, "corrected")
    with pytest.raises(InputError, match="photographs, masks and cameras"):
        acquire_run(tmp_path, DATASET, "hash", CONFIG, "other")


def test_a_run_of_an_earlier_version_continues(tmp_path: Path) -> None:
    acquire_run(tmp_path, DATASET, "hash", CONFIG)
    description = json.loads((tmp_path / DESCRIPTION).read_text())
    del description["photographs_hash"]
    (tmp_path / DESCRIPTION).write_text(json.dumps(description))
    save_state(tmp_path, some_state(False))
    acquire_run(tmp_path, DATASET, "hash", CONFIG, "any")


@pytest.mark.parametrize("what", ["folder", "file"])
def test_a_foreign_place_is_refused(tmp_path: Path, what: str) -> None:
    place = tmp_path / "thesis"
    if what == "folder":
        place.mkdir()
        (place / "chapter.tex").touch()
    else:
        place.touch()
    with pytest.raises(InputError, match="not a run"):
        acquire_run(place, DATASET, "hash", CONFIG)
    assert not (tmp_path / "thesis" / DESCRIPTION).exists()


def test_what_a_killed_process_left_is_no_obstacle(tmp_path: Path) -> None:
    """Killed while it wrote its first file, and later while it wrote a checkpoint."""
    for _ in range(2):
        (tmp_path / ".partial-x.pt").write_bytes(b"half")
        acquire_run(tmp_path, DATASET, "hash", CONFIG)
    assert [path.name for path in tmp_path.iterdir()] == [DESCRIPTION]


@pytest.mark.parametrize("content", ["[]", "{}", '{"dataset": "a"}', '{"dataset": "a", "config": {}}', "{"])
def test_a_damaged_description_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / DESCRIPTION).write_text(content)
    with pytest.raises(InputError):
        read_description(tmp_path)
    with pytest.raises(InputError):
        acquire_run(tmp_path, DATASET, "hash", CONFIG)
