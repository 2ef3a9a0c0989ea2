"""Protocol paper-v1: its steps one by one, and that it counts what linear-v1 does not."""

import numpy as np
import pytest

from shinypartial.core.color import srgb_to_linear
from shinypartial.metrics.paper import (
    PAPER_PROTOCOL,
    PaperView,
    claimed_mask,
    eight_bit,
    paper_environment,
    paper_render,
    pool_paper,
    reinhard_picture,
)


def test_tone_mapping_is_compressive_and_eight_bit() -> None:
    radiance = np.broadcast_to(np.array([0.0, 1.0, 3.0], np.float32), (512, 1024, 3)).copy()
    picture = reinhard_picture(radiance)[0, 0]
    np.testing.assert_allclose(picture * 255, np.rint(picture * 255), atol=1e-4)
    # L/(1 + L) of 0, 1, 3; half a level of 255 in sRGB is at most 0.003 in linear light.
    np.testing.assert_allclose(srgb_to_linear(picture), [0, 0.5, 0.75], atol=4e-3)
    assert reinhard_picture(radiance[:64, :128]).shape == (512, 1024, 3)
    assert reinhard_picture(-radiance).max() == 0


def test_differences_below_half_a_level_are_not_seen() -> None:
    image = np.full((16, 16, 3), 100 / 255, np.float32)
    assert paper_render(image + 0.4 / 255, image).psnr == 100.0
    scores = paper_render(image + 2 / 255, image)
    assert scores.l1 == pytest.approx(2 / 255, rel=1e-4)
    assert scores.psnr == pytest.approx(-20 * np.log10(2 / 255), rel=1e-5)
    np.testing.assert_array_equal(eight_bit(np.array([-1.0, 2.0])), [0.0, 1.0])


def test_every_texel_counts_alike() -> None:
    truth = np.zeros((512, 1024, 3), np.float32)
    for row in (0, 256):
        prediction = truth.copy()
        prediction[row] = 1.0
        assert paper_environment(prediction, truth, None).l1_reinhard == pytest.approx(1 / 512)


def test_normals_count_where_both_have_them_and_the_prediction_claims() -> None:
    up, none = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    truth = np.stack([[up, up, up, none]]).astype(np.float32)
    predicted = np.stack([[up, up, none, up]]).astype(np.float32)
    mask = claimed_mask(np.array([[0.9, 0.4, 0.9, 0.9]]), predicted, truth)
    assert mask.tolist() == [[True, False, False, False]]


def test_views_are_averaged_and_normals_pooled() -> None:
    image, other = np.zeros((16, 16, 3), np.float32), np.full((16, 16, 3), 0.2, np.float32)
    views = [
        PaperView(paper_render(image, image), np.array([1.0, 1.0, 1.0])),
        PaperView(paper_render(other, image), np.array([9.0])),
    ]
    scores = pool_paper(None, views)
    assert scores.protocol == PAPER_PROTOCOL
    assert scores.render is not None
    assert scores.render.l1 == pytest.approx(0.1)
    assert scores.normals is not None
    assert scores.normals.mean_angular_error_deg == pytest.approx(3.0)
    assert scores.normals.fraction_within_5deg == 0.75
    empty = pool_paper(None, [])
    assert (empty.environment, empty.normals, empty.render) == (None, None, None)
