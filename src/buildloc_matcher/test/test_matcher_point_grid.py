"""The grid of points against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from buildloc_matcher.point_grid import grid_points, near, nearest, within
from buildloc_msgs_py.types import FloatArray
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from towns import ORIGIN_M

# Whole multiples of a quarter: many ties, duplicates and points on the borders of cells, without rounding.
QUARTERS = st.integers(-4000, 4000).map(lambda n: n / 4.0)


def points(most: int) -> st.SearchStrategy[FloatArray]:
    return st.integers(1, most).flatmap(lambda n: arrays(np.float64, (n, 2), elements=QUARTERS))


RADII = st.integers(1, 1200).map(lambda n: n / 4.0)


@settings(max_examples=150, deadline=None)
@given(reference=points(60), x=QUARTERS, y=QUARTERS, reach=RADII)
def test_the_nearest_point_within_reach(reference: FloatArray, x: float, y: float, reach: float) -> None:
    grid = grid_points(reference)
    place, squared = nearest(grid.points_m, grid.starts, grid.frame, x, y, reach)
    expected = np.min(np.sum((reference - (x, y)) ** 2, axis=1))
    if expected < reach * reach:
        found = reference[grid.order[place]]
        assert squared == expected == np.sum((found - (x, y)) ** 2)
    else:
        assert place == -1


@settings(max_examples=100, deadline=None)
@given(reference=points(60), around=points(8), radius=RADII)
def test_all_points_near_some_others(reference: FloatArray, around: FloatArray, radius: float) -> None:
    squared = np.sum((reference[:, None] - around[None]) ** 2, axis=2).min(axis=1)
    expected = np.flatnonzero(squared <= radius * radius)
    assert near(grid_points(reference), around, radius).tolist() == expected.tolist()


@settings(max_examples=100, deadline=None)
@given(reference=points(60), corners=arrays(np.float64, (2, 2), elements=QUARTERS))
def test_all_points_in_a_box_borders_included(reference: FloatArray, corners: FloatArray) -> None:
    low, high = corners.min(axis=0), corners.max(axis=0)
    expected = np.flatnonzero(((reference >= low) & (reference <= high)).all(axis=1))
    assert within(grid_points(reference), *low, *high).tolist() == expected.tolist()


@pytest.mark.parametrize("count", [1, 2, 3000])
def test_a_city_at_utm_coordinates(count: int) -> None:
    rng = np.random.default_rng(count)
    city = np.add(rng.uniform(0.0, 2000.0, (count, 2)), ORIGIN_M)
    grid = grid_points(city)
    assert sorted(grid.order.tolist()) == list(range(count)) and grid.starts[-1] == count
    for x, y in np.add(rng.uniform(-100.0, 2100.0, (200, 2)), ORIGIN_M):
        distances = np.hypot(*(city - (x, y)).T)
        place, squared = nearest(grid.points_m, grid.starts, grid.frame, x, y, 60.0)
        assert (place >= 0) == (distances.min() < 60.0)
        if place >= 0:
            assert grid.order[place] == distances.argmin()
            assert squared == pytest.approx(distances.min() ** 2, abs=1e-6)  # of differences of 1e6 m
        around = np.array([[x, y]])
        assert near(grid, around, 60.0).tolist() == np.flatnonzero(distances <= 60.0).tolist()
