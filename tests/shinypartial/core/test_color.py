"""Linear light ⇄ sRGB."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shinypartial.core.color import (
    CODES_OF_LINEAR,
    LINEAR_OF_CODES,
    LINEAR_THRESHOLD,
    linear_to_srgb,
    srgb_to_linear,
    to_display,
)

#: IEC 61966-2-1, computed by hand to ten digits: 1.055 · x^(1/2.4) − 0.055 above the threshold, 12.92 x below.
KNOWN = [(0.0, 0.0), (0.001, 0.01292), (0.18, 0.4613561295), (0.5, 0.7353569831), (1.0, 1.0), (2.0, 1.3532560461)]


@pytest.mark.parametrize(("linear", "srgb"), KNOWN)
def test_known_values(linear: float, srgb: float) -> None:
    assert linear_to_srgb(np.array([linear]))[0] == pytest.approx(srgb, abs=1e-9)


@given(st.floats(-1.0, 1e4))
def test_decoding_inverts_encoding(value: float) -> None:
    linear = np.array([value])
    # Float64 powers lose about 1e-15; the threshold of the standard leaves a gap of 3e-8 between its two branches.
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(linear)), linear, rtol=1e-12, atol=3e-8)


@given(st.floats(-1.0, 1e4))
def test_encoding_inverts_decoding(value: float) -> None:
    srgb = np.array([value])
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(srgb)), srgb, rtol=1e-12, atol=4e-7)


def test_encoding_increases_and_its_branches_meet() -> None:
    linear = np.linspace(0, 2, 200_001)
    assert np.diff(linear_to_srgb(linear)).min() > 0
    below, above = linear_to_srgb(LINEAR_THRESHOLD + np.array([-1e-12, 1e-12]))
    assert abs(above - below) < 4e-8, "The standard's rounded constants leave a step of 2.9e-8."


def test_every_8_bit_value_survives_a_round_trip() -> None:
    stored = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(to_display(srgb_to_linear(stored.astype(np.float32) / 255)), stored)


def test_tables_have_what_the_formulas_have() -> None:
    """Light of each code, exactly; a code of each light, but for as near to where codes change as a table's step."""
    np.testing.assert_array_equal(LINEAR_OF_CODES, srgb_to_linear(np.arange(256, dtype=np.float32) / 255))
    light = np.linspace(0, 1, 1_000_003)
    looked_up = CODES_OF_LINEAR[np.rint(65535 * light).astype(np.uint16)]
    exact = 255 * linear_to_srgb(light)
    # Half a code, and half a step of 1/65535 where the curve is steepest, 12.92.
    assert np.abs(looked_up - exact).max() < 0.5 + 0.5 * 255 * 12.92 / 65535 + 1e-9


def test_a_picture_clips_what_it_can_not_show() -> None:
    np.testing.assert_array_equal(to_display(np.array([-1.0, np.nan, 7.0, np.inf])), [0, 0, 255, 255])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_precision_is_kept(dtype: type) -> None:
    assert linear_to_srgb(np.ones((2, 3), dtype)).dtype == dtype
    assert srgb_to_linear(np.ones((2, 3), dtype)).dtype == dtype
