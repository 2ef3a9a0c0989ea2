"""A fit places its data on a device once and keeps them there, proved with a device that is not there."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from panoless.config import FitConfig
from panoless.environment import fill
from panoless.environment import solve as cubemap
from panoless.geometry.plane.model import plane_buffers, unoccluded_share
from panoless.kernels import backend
from panoless.reconstruct import fit as fit_module
from panoless.reconstruct.fit import find_device, fit
from panoless.splats import train
from panoless.splats.density import grow_and_prune
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset
from tests.support.few_rounds import take_few_rounds
from tests.support.mirror_plane import RECTANGLE, arc, make_plane_dataset, plane_of
from tests.support.mirror_sphere import tiny_config
from tests.support.second_device import second_device


@pytest.fixture
def definition_only(monkeypatch: pytest.MonkeyPatch, often: None) -> None:
    """Both devices compute by the definition, in few rounds and sweeps."""
    monkeypatch.setattr(backend, "_fastest", lambda dtype, device: "reference")
    monkeypatch.setattr(cubemap, "ROBUST_SCALES", (None,))
    monkeypatch.setattr(cubemap, "REFINING_SCALES", (0.05,))
    monkeypatch.setattr(fill, "RELAXED_TEXELS", 16)
    monkeypatch.setattr(train, "grow_and_prune", partial(grow_and_prune, threshold=0.0))
    take_few_rounds(monkeypatch, joint=1, revolutions=1)


def shortest_config(preset: str) -> FitConfig:
    """Every path of a preset in a few steps."""
    config = tiny_config(preset, iterations=5, count=20)
    return replace(
        config,
        first_surface=replace(config.first_surface, hull_resolution=16),
        model="surfels",
        downscale=2,
        environment=replace(config.environment, resolution=4, solve_resolution=4),
    )


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["default", pytest.param("paper", marks=pytest.mark.slow), "paper-rho-weighted"])
def test_a_fit_on_another_device_mixes_nothing_and_ends_the_same(
    preset: str, tmp_path: Path, sphere_dataset: Dataset, definition_only: None
) -> None:
    config, dataset = shortest_config(preset), replace(sphere_dataset, train=sphere_dataset.train[:2])
    here = fit(dataset, config, tmp_path / "here")
    with second_device() as device:
        there = fit(dataset, config, tmp_path / "there", device=device)
    surfels, expected = there.geometry.state_dict()["surfels"], here.geometry.state_dict()["surfels"]
    assert surfels["means"].device.type == "cpu"
    for name, value in expected.items():
        torch.testing.assert_close(surfels[name], value)
    torch.testing.assert_close(there.environment, here.environment)
    torch.testing.assert_close(there.visibility, here.visibility)
    for name, series in here.curves.items():
        assert there.curves[name] == pytest.approx(series), name


@pytest.mark.slow
def test_the_same_kind_is_chosen_on_another_device(tmp_path: Path, definition_only: None) -> None:
    dataset = make_plane_dataset(tmp_path / "plane", plane_of(RECTANGLE), size=32, train=4, test=1)
    config = shortest_config("default")
    config = replace(
        config,
        model="auto",
        corrections=replace(config.corrections, masks="off", exposure="off", lens="off"),
        surroundings=replace(config.surroundings, mode="off"),
    )
    here = fit(dataset, config, tmp_path / "here")
    with second_device() as device:
        there = fit(dataset, config, tmp_path / "there", device=device)
    kinds = [each.kind for each in here.selection.candidates]
    assert kinds[:2] == ["sphere", "plane"]
    assert [each.kind for each in there.selection.candidates] == kinds
    assert [each.verdict for each in there.selection.candidates] == [e.verdict for e in here.selection.candidates]
    torch.testing.assert_close(there.environment, here.environment)
    torch.testing.assert_close(there.visibility, here.visibility)


@pytest.mark.parametrize("frame_height", [0.0, 0.1])
def test_a_plane_is_seen_on_the_device_of_the_camera(frame_height: float) -> None:
    plane, camera = plane_of(RECTANGLE, frame_height), arc(1, size=24)[0]
    behind = replace(plane, normal=-plane.normal, offset=-plane.offset)
    for each in (plane, behind):
        here, clear = plane_buffers(each, camera), unoccluded_share(each, camera)
        with second_device() as device:
            moved = replace(camera, world_to_camera=camera.world_to_camera.to(device))
            there = {**vars(plane_buffers(each, moved)), "unoccluded_share": unoccluded_share(each, moved)}
            assert {value.device for value in there.values()} == {device}
            there = {name: value.to("cpu") for name, value in there.items()}
        for name, value in {**vars(here), "unoccluded_share": clear}.items():
            torch.testing.assert_close(there[name], value, msg=name)


def test_what_is_missing_for_a_gpu_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_device("cpu").type == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="a GPU that torch can use"):
        find_device("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(fit_module, "gpu_kernels_installed", lambda: False)
    with pytest.raises(InputError, match="Triton"):
        find_device("cuda")
