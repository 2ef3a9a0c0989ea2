"""Polygons: coverage is area, the nearest side is that of a dense sampling, and inside is inside."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float
from matplotlib.path import Path as PolygonPath

from panoless.numeric.polygon import contains, depth_inside, nearest_side, polygon_coverage, with_cut_sides


def area(polygon: Float[np.ndarray, "N 2"]) -> float:
    x, y = polygon.T
    return abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())) / 2


@st.composite
def star_polygons(draw: st.DrawFn) -> Float[np.ndarray, "N 2"]:
    """Simple polygons around (15, 12) with vertices up to 11 pixels away, often on pixel borders."""
    count = draw(st.integers(3, 12))
    radii = draw(st.lists(st.floats(1.0, 11.0), min_size=count, max_size=count))
    angles = 2 * np.pi * (np.arange(count) + draw(st.floats(0, 1))) / count
    vertices = np.array([15.0, 12.0]) + np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
    return vertices.round(draw(st.sampled_from([1, 9])))


@given(star_polygons())
def test_coverage_sums_to_the_area(polygon: np.ndarray) -> None:
    """Σ coverage = the polygon's area by the shoelace formula, whichever way round it is."""
    coverage = polygon_coverage(polygon, 30, 24)
    assert coverage.sum() == pytest.approx(area(polygon), abs=1e-3)
    assert coverage.min() >= 0
    assert coverage.max() <= 1
    np.testing.assert_allclose(polygon_coverage(polygon[::-1].copy(), 30, 24), coverage, atol=1e-9)


@given(star_polygons(), st.integers(-14, 14), st.integers(-11, 11))
def test_coverage_moves_with_the_polygon_and_ends_at_the_border(polygon: np.ndarray, right: int, down: int) -> None:
    """A shift by whole pixels shifts the picture; what leaves it on any side changes nothing of what stays."""
    wide = polygon_coverage(polygon + np.array([20, 20]), 70, 64)
    part = polygon_coverage(polygon + np.array([right, down]), 30, 24)
    np.testing.assert_allclose(part, wide[20 - down : 44 - down, 20 - right : 50 - right], atol=2e-6)


def test_coverage_is_the_area_within_each_pixel() -> None:
    """Against points on a 64×64 grid in each pixel, which a side through a pixel gets wrong by up to about 1/64."""
    polygon = np.array([[3.2, 4.1], [30.7, 2.3], [25.1, 20.9], [38.0, 33.3], [10.5, 36.2], [14.0, 18.0]])
    line = (np.arange(40 * 64) + 0.5) / 64
    points = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    counted = PolygonPath(polygon).contains_points(points).reshape(40, 64, 40, 64).mean((1, 3))
    assert np.abs(polygon_coverage(polygon, 40, 40) - counted).max() < 1 / 64


def test_a_polygon_around_the_picture_covers_it() -> None:
    square = 1e7 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    assert (polygon_coverage(square, 9, 7) == 1).all()
    assert (polygon_coverage(square + 3e7, 9, 7) == 0).all()
    assert (polygon_coverage(np.zeros((0, 2)), 9, 7) == 0).all()


POLYGON = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]])


def test_the_nearest_side_is_that_of_a_dense_sampling() -> None:
    points = np.random.default_rng(0).uniform(-2, 6, (400, 2))
    side, along, distance = nearest_side(points, POLYGON)
    starts, ends = POLYGON, np.roll(POLYGON, -1, 0)
    feet = starts[side] + along[:, None] * (ends - starts)[side]
    np.testing.assert_allclose(np.linalg.norm(points - feet, axis=1), distance, atol=1e-12)
    dense = np.concatenate([np.linspace(a, b, 2001) for a, b in zip(starts, ends, strict=True)])
    sampled = np.linalg.norm(points[:, None] - dense, axis=-1).min(1)
    # Samples are 0.002 apart at most, so the nearest is too far by less than half of that.
    assert (distance <= sampled + 1e-12).all()
    assert (distance >= sampled - 1e-3).all()


def test_inside_is_as_another_implementation_has_it_and_gives_the_sign_of_the_depth() -> None:
    points = np.random.default_rng(1).uniform(-1, 5, (500, 2))
    inside = PolygonPath(POLYGON).contains_points(points)
    np.testing.assert_array_equal(contains(POLYGON, points), inside)
    np.testing.assert_array_equal(depth_inside(points, POLYGON) > 0, inside)
    np.testing.assert_array_equal(contains(POLYGON[::-1].copy(), points), inside)
    assert depth_inside(np.array([[0.5, 2.0], [-0.5, 2.0]]), POLYGON).tolist() == [0.5, -0.5]


@given(star_polygons(), st.floats(0.1, 30))
def test_cut_sides_are_short_and_the_polygon_is_the_same(polygon: np.ndarray, longest: float) -> None:
    """No vertex is lost, area and length stay, and no piece could be spared."""
    cut = with_cut_sides(polygon, longest)
    lengths, whole = (np.linalg.norm(np.roll(each, -1, 0) - each, axis=1) for each in (cut, polygon))
    assert lengths.max() <= longest * (1 + 1e-6)
    assert len(cut) == np.maximum(np.ceil(whole / longest - 1e-9), 1).sum()
    assert all((cut == corner).all(1).any() for corner in polygon)
    np.testing.assert_allclose([area(cut), lengths.sum()], [area(polygon), whole.sum()])
