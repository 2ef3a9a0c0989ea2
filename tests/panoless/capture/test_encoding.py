"""The encoding of a fit has an inverse, the usual one the identity, and a tint that leaves no trace."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from panoless.capture.encoding import LDR, RadianceEncoding, encoding_of
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import raster_camera
from panoless.capture.views import load_views
from panoless.config import FitConfig, check_config
from panoless.environment.cubemap import look_up
from panoless.export.render import render
from panoless.kernels.cubemap import cubemap_directions
from panoless.presets import PRESETS
from panoless.reconstruct.fit import fit
from panoless.splats.mirror import SurfelMirror
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import read_view
from shinypartial.dataset.schema import Dataset
from shinypartial.dataset.write import write_view
from tests.panoless.conftest import FinishedFit
from tests.support.mirror_sphere import clipped_environment, sphere_surfels
from tests.support.synthetic_dataset import (
    SUN_DIRECTION,
    environment_radiance,
    make_plain_sphere_dataset,
    make_sphere_dataset,
    sphere_cameras,
)

TINT = (1.0, 0.8, 0.5)
HDR = RadianceEncoding(high_dynamic_range=True)


@given(st.floats(0, 65504, width=32), st.sampled_from([(1.0, 1.0, 1.0), TINT]))
def test_decoding_inverts_encoding(radiance: float, tint: tuple[float, float, float]) -> None:
    encoding = RadianceEncoding(True, tint)
    color = np.full((1, 1, 3), radiance, np.float32) * np.array(tint, np.float32)
    encoded = torch.from_numpy(encoding.encoded(color)).permute(2, 0, 1)[None].expand(6, 3, 1, 1)
    # ln of the largest half is 11, of which single precision keeps 1e-6.
    torch.testing.assert_close(encoding.decoded(encoded), torch.full((6, 3, 1, 1), radiance), rtol=2e-5, atol=1e-7)


def test_the_encoding_is_smooth_increasing_and_the_identity_up_to_one() -> None:
    x = np.linspace(0, 4, 4001)[:, None, None].repeat(3, 2)
    encoded = HDR.encoded(x)
    slope = np.diff(encoded[:, 0, 0]) / np.diff(x[:, 0, 0])
    assert np.array_equal(encoded[x <= 1], x[x <= 1])
    assert (slope > 0).all()
    assert np.abs(np.diff(slope)).max() < 0.002


def test_no_view_is_brighter_than_saturation(tmp_path: Path) -> None:
    """Encoded radiance ends at 1/F of each channel with a low dynamic range, and nowhere with a high one."""
    dataset = make_sphere_dataset(tmp_path)
    for encoding in (LDR, RadianceEncoding(tint=TINT), HDR):
        frame = dataset.train[0]
        view = read_view(frame)
        bright = replace(view, radiance=4 * np.ones_like(view.radiance))
        encoded = torch.from_numpy(encoding.encoded(encoding.clipped(frame, bright))).float()
        if encoding.high_dynamic_range:
            assert bool(encoding.saturation.isinf().all())
        else:
            torch.testing.assert_close(encoded.amax((0, 1)), encoding.saturation)


def test_the_usual_light_changes_nothing() -> None:
    radiance = np.random.default_rng(0).random((4, 5, 3)).astype(np.float32)
    environment = torch.rand(6, 3, 4, 4)
    assert LDR.encoded(radiance) is radiance
    assert LDR.decoded(environment) is environment
    mirrors = [config for config in PRESETS.values() if config.splats.surfels.shading == "mirror"]
    assert all(encoding_of(config) == LDR for config in mirrors)


def test_srgb_is_that_of_what_covers_a_pixel() -> None:
    """An image of a plain color is that color times alpha, and decodes to it."""
    alpha = np.linspace(0, 1, 20, dtype=np.float32).reshape(4, 5)
    color = np.array([0.7, 0.002, 0.18], np.float32)
    srgb = RadianceEncoding(srgb=True)
    encoded = srgb.encoded(color * alpha[..., None], alpha)
    # 0.18 is the middle gray of 8-bit 118.
    assert encoded[-1, -1] == pytest.approx([0.854, 0.0258, 118 / 255], abs=2e-3)
    np.testing.assert_allclose(encoded, alpha[..., None] * encoded[-1, -1], atol=1e-6)
    shown = srgb.shown(torch.from_numpy(color)[None].expand(6, -1)[..., None, None].contiguous())
    torch.testing.assert_close(srgb.decoded(shown)[0, :, 0, 0], torch.from_numpy(color))


def test_a_high_dynamic_range_is_found_where_a_low_one_saturates(
    many_views_dataset: Dataset, finished: FinishedFit, tmp_path: Path
) -> None:
    config = replace(finished.config, environment=replace(finished.config.environment, range="hdr"))
    state = fit(many_views_dataset, config, tmp_path / "hdr")
    sun = torch.from_numpy(SUN_DIRECTION)[None].float()
    truth = torch.from_numpy(environment_radiance(SUN_DIRECTION[None])).float()
    assert float(truth.min()) > 3
    assert state.environment is not None
    assert finished.state.environment is not None
    # 24 texels a side blur the sun a little.
    torch.testing.assert_close(look_up(state.environment, sun, "clamp"), truth, rtol=0.15, atol=0)
    assert float(look_up(finished.state.environment, sun, "clamp").max()) <= 1
    frame = state.frame
    camera = raster_camera(many_views_dataset.test[1].camera, frame, 0.1)
    assert float(render(state.geometry, state.environment, camera, frame, config).radiance.max()) > 2


def test_views_without_light_above_one_are_the_same_in_both_ranges(sphere_dataset: Dataset) -> None:
    for usual, high in zip(
        load_views(sphere_dataset, 2).train, load_views(sphere_dataset, 2, encoding=HDR).train, strict=True
    ):
        dim = high.radiance <= 1
        assert torch.equal(usual.radiance[dim], high.radiance[dim])
        assert bool((high.radiance[~dim] > 1).all())
        assert bool((usual.radiance[~dim] == 1).all())


@pytest.mark.slow
def test_a_tinted_mirror_with_its_tint_gives_the_map_of_an_untinted_one(finished: FinishedFit, tmp_path: Path) -> None:
    """Light above 1 is cut from the untinted views first, because a camera would cut it at another place.

    The tint's powers of two leave what half floats of the files round as it is, so nothing differs at all.
    """
    tint = (1.0, 0.5, 0.25)
    plain = make_sphere_dataset(tmp_path / "plain", resolution=40, train=14, test=3)
    tinted = make_sphere_dataset(tmp_path / "tinted", resolution=40, train=14, test=3)
    for one, other in zip(plain.train, tinted.train, strict=True):
        view = read_view(one)
        write_view(one, replace(view, radiance=np.minimum(view.radiance, 1)))
        write_view(other, replace(view, radiance=np.minimum(view.radiance, 1) * np.array(tint, np.float32)))
    config = replace(finished.config, splats=replace(finished.config.splats, iterations=10))
    given_tint = replace(config, tint=tint)
    states = [fit(plain, config, tmp_path / "a"), fit(tinted, given_tint, tmp_path / "b")]
    maps = [state.environment for state in states]
    assert maps[0] is not None
    assert maps[1] is not None
    torch.testing.assert_close(maps[1], maps[0], rtol=0, atol=1e-6)
    blind = fit(tinted, config, tmp_path / "c").environment
    assert blind is not None
    assert float((maps[0] - blind)[:, 2].abs().mean()) > 0.1


def test_a_render_is_multiplied_by_the_tint() -> None:
    frame = ObjectFrame(np.zeros(3), 1.0)
    camera = raster_camera(sphere_cameras("test", 1, 24)[0], frame, 0.1)
    environment = clipped_environment(cubemap_directions(8)).permute(0, 3, 1, 2).contiguous()
    mirror, config = SurfelMirror(sphere_surfels(300)), FitConfig()
    plain = render(mirror, environment, camera, frame, config)
    tinted = render(mirror, environment, camera, frame, replace(config, tint=TINT))
    assert float(plain.radiance.max()) > 0.1
    factor = torch.tensor(TINT)[:, None, None]
    torch.testing.assert_close(tinted.radiance, factor * plain.radiance)
    torch.testing.assert_close(tinted.specular, factor * plain.specular)


def test_pictures_of_8_bits_have_no_high_dynamic_range(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="8-bit"):
        load_views(make_plain_sphere_dataset(tmp_path / "plain"), 2, encoding=HDR)


@pytest.mark.parametrize(
    "config",
    [
        replace(FitConfig(), tint=(1.0, 0.0, 1.0)),
        replace(FitConfig(), tint=(1.0, float("nan"), 1.0)),
        replace(PRESETS["paper"], environment=replace(PRESETS["paper"].environment, range="hdr")),
        replace(
            FitConfig(),
            splats=replace(FitConfig().splats, albedo=True),
            environment=replace(FitConfig().environment, range="hdr"),
        ),
        replace(FitConfig(), exposure=2.0, environment=replace(FitConfig().environment, range="hdr")),
        replace(FitConfig(), exposure=2.0, environment=replace(FitConfig().environment, solve=False)),
        replace(PRESETS["paper"], exposure=2.0),
    ],
)
def test_impossible_lights_are_refused(config: FitConfig) -> None:
    with pytest.raises(InputError):
        check_config(config)
