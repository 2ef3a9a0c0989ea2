"""Angular errors: exact for any angle, blind to length and rotation; holes count with 90°."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shinypartial.metrics.angular import angular_error_deg, angular_statistics, normal_errors_deg


@given(st.floats(0, 180), st.floats(0.1, 10))
def test_a_known_angle_is_measured(angle_deg: float, length: float) -> None:
    angle = math.radians(angle_deg)
    a, b = np.array([0.0, 0.0, length]), np.array([math.sin(angle), 0.0, math.cos(angle)])
    assert angular_error_deg(a, b) == pytest.approx(angle_deg, abs=1e-9)


def test_tiny_angles_keep_their_precision() -> None:
    """The arc cosine of the dot product would return 0 or 1e-6° here."""
    assert angular_error_deg(np.array([1.0, 0.0, 0.0]), np.array([1.0, 1e-9, 0.0])) == pytest.approx(
        math.degrees(1e-9), rel=1e-9
    )


def test_a_common_rotation_changes_nothing() -> None:
    random = np.random.default_rng(0)
    a, b = random.normal(size=(2, 50, 3))
    rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
    np.testing.assert_allclose(angular_error_deg(a @ rotation, b @ rotation), angular_error_deg(a, b), atol=1e-10)


def test_statistics_are_pooled_over_pixels() -> None:
    statistics = angular_statistics(np.array([0.0, 4.0, 10.0, 20.0, 26.0], np.float32))
    assert statistics.mean_angular_error_deg == pytest.approx(12.0)
    assert statistics.median_angular_error_deg == pytest.approx(10.0)
    assert statistics.rmse_angular_error_deg == pytest.approx(math.sqrt((16 + 100 + 400 + 676) / 5))
    assert statistics.fraction_within_5deg == pytest.approx(0.4)
    assert statistics.fraction_within_11_25deg == pytest.approx(0.6)
    assert statistics.fraction_within_22_5deg == pytest.approx(0.8)
    assert statistics.normal_coverage == 1.0


def test_a_hole_counts_with_ninety_degrees_and_lowers_the_coverage() -> None:
    truth = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    errors = normal_errors_deg(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]), truth)
    statistics = angular_statistics(errors)
    assert statistics.mean_angular_error_deg == 45.0
    assert statistics.normal_coverage == 0.5


def test_no_pixels_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one pixel"):
        angular_statistics(np.zeros(0, np.float32))
