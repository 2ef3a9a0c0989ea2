"""A run folder: its state survives the disk, damage is named, and nobody else's folder is taken."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from panoless.geometry.revolution.model import SurfaceOfRevolution
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
from shinypartial.core.errors import InputError
from tests.support.mirror_height_field import bumpy
from tests.support.mirror_plane import L_SHAPE, plane_of
from tests.support.mirror_revolution import around, funnel, goblet, rays_of
from tests.support.mirror_sphere import sphere_surfels

CONFIG = PRESETS["default"]
DATASET = Path("datasets/vase")


def some_state(final: bool) -> FitState:
    return FitState(
        surfels=sphere_surfels(7),
        environment=torch.rand(6, 3, 4, 4),
        iteration=42,
        optimizer={"state": {0: {"exp_avg": torch.rand(7, 3)}}, "param_groups": [{"lr": 0.1, "name": "means"}]},
        gradient_sum=torch.rand(7),
        gradient_count=torch.ones(7),
        evidence=torch.rand(6, 4, 4),
        center=[1.0, 2.0, 3.0],
        radius=0.5,
        final_environment=torch.rand(6, 3, 8, 8) if final else None,
        seconds={"optimize": 1.5},
        curves={"loss": [3.0, 2.0]},
        peak_memory_bytes=10,
    )


@pytest.mark.parametrize("final", [False, True])
def test_a_state_survives_the_disk(tmp_path: Path, final: bool) -> None:
    state = some_state(final)
    save_state(tmp_path, state)
    assert [path.name for path in tmp_path.iterdir()] == [CHECKPOINT]
    loaded = load_state(tmp_path)
    assert isinstance(loaded, FitState)
    torch.testing.assert_close(loaded.surfels.named(), state.surfels.named(), rtol=0, atol=0)
    for name in set(vars(state)) - {"surfels", "optimizer", "final_environment"}:
        first, second = getattr(loaded, name), getattr(state, name)
        assert torch.equal(first, second) if isinstance(first, torch.Tensor) else first == second, name
    assert loaded.optimizer["param_groups"] == state.optimizer["param_groups"]
    assert torch.equal(loaded.optimizer["state"][0]["exp_avg"], state.optimizer["state"][0]["exp_avg"])
    assert (loaded.final_environment is not None) == final
    if final:
        assert torch.equal(loaded.final_environment, state.final_environment)


@pytest.mark.parametrize("flat", [True, False], ids=["plane", "bent from a plane"])
def test_a_plane_survives_the_disk(tmp_path: Path, flat: bool) -> None:
    """To the last bit, with the outline's corners and why it was taken; it is the geometry only when it is flat."""
    plane = plane_of(L_SHAPE, frame_height=0.1 / 3, offset=1 / 7)
    save_state(tmp_path, replace(some_state(True), plane=plane, flat=flat, rung="plane (asked for)"))
    loaded = load_state(tmp_path)
    assert loaded is not None
    assert loaded.plane is not None
    for name, value in vars(plane).items():
        np.testing.assert_array_equal(getattr(loaded.plane, name), value)
    assert isinstance(loaded.plane.offset, float)
    assert loaded.rung == "plane (asked for)"
    assert loaded.geometry is (loaded.plane if flat else loaded.surfels)


@pytest.mark.parametrize("bent", [True, False], ids=["bent plane", "surfels that began on it"])
def test_a_bent_plane_survives_the_disk(tmp_path: Path, bent: bool) -> None:
    """To the last bit, with the plane of its frame; it is the geometry only when it was taken."""
    height_field = bumpy(plane_of(L_SHAPE, frame_height=0.1 / 3, offset=1 / 7), 0.02)
    save_state(tmp_path, replace(some_state(True), height_field=height_field, plane=height_field.plane, bent=bent))
    loaded = load_state(tmp_path)
    assert loaded is not None
    assert loaded.height_field is not None
    for first, second in ((loaded.height_field, height_field), (loaded.height_field.plane, height_field.plane)):
        for item in fields(second):
            if item.name != "plane":
                np.testing.assert_array_equal(getattr(first, item.name), getattr(second, item.name))
    assert loaded.stepless == bent
    assert loaded.geometry is (loaded.height_field if bent else loaded.surfels)


@pytest.mark.parametrize("turned", [True, False], ids=["revolution", "surfels that began on it"])
def test_a_surface_of_revolution_survives_the_disk(tmp_path: Path, turned: bool) -> None:
    """To the last bit, and with it what its rays meet; it is the geometry only when it was taken."""
    surface = funnel(1 / 3)
    save_state(tmp_path, replace(some_state(True), surface=surface, turned=turned, rung="revolution (asked for)"))
    loaded = load_state(tmp_path)
    assert loaded is not None
    assert loaded.surface is not None
    for item in fields(surface):
        np.testing.assert_array_equal(getattr(loaded.surface, item.name), getattr(surface, item.name))
    assert type(loaded.surface.lip) is int
    rays = rays_of(around(3, 24)[2])
    for name, values in vars(surface.hits(*rays)).items():
        np.testing.assert_array_equal(getattr(loaded.surface.hits(*rays), name), values)
    assert loaded.stepless == turned
    assert loaded.geometry is (loaded.surface if turned else loaded.surfels)


def test_a_surface_of_revolution_that_was_used_is_saved_like_a_new_one(tmp_path: Path) -> None:
    """What it computed about itself meanwhile is no part of it."""
    for name, surface in (("new", goblet()), ("used", goblet())):
        (tmp_path / name).mkdir()
        if name == "used":
            surface.hits(*rays_of(around(1, 8)[0]))
        save_state(tmp_path / name, replace(some_state(True), surface=surface, turned=True))
    first, second = (load_state(tmp_path / name) for name in ("new", "used"))
    assert first is not None
    assert second is not None
    assert (
        vars(first.surface).keys() == vars(second.surface).keys() == {item.name for item in fields(SurfaceOfRevolution)}
    )


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


def test_a_failed_save_keeps_the_last_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_state(tmp_path, some_state(False))

    def full(*_) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        save_state(tmp_path, replace(some_state(False), iteration=43))
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
