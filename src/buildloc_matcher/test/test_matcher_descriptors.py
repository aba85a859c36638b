"""Stars drawn by hand, and what must not change them."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.descriptors import (
    AREA,
    MAX_CIRCUMRADIUS_M,
    NO_TRIANGLE,
    PERIMETER,
    SHAPE,
    Triangles,
    describe,
)
from buildloc_matcher.geometry import rotation
from buildloc_matcher.hypotheses import hypothesize
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.matching import match_stars
from buildloc_matcher.mesh import mesh
from buildloc_matcher.star_index import cell_starts, cells, corner_areas
from buildloc_msgs_py.types import FloatArray
from hypothesis import given, settings
from hypothesis import strategies as st
from towns import DEFAULT, ORIGIN_M, Buildings, cut, lattice, local_map, town, whole

# A 3-4-5 triangle, and one building beyond each of its sides.
POINTS = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0], [5.0, 6.0], [-4.0, 1.0], [1.0, -5.0]])
AREAS = np.array([8.0, 27.0, 125.0, 64.0, 1000.0, 1.0])
SHAPES = np.column_stack([np.full(6, 0.5), np.arange(6) / 10.0, 1.0 - np.arange(6) / 10.0, np.full(6, 1.0)])


def star_of(triangles: Triangles, corners: set[int]) -> int:
    (row,) = (r for r in range(triangles.stars) if set(triangles.vertices[r].tolist()) == corners)
    return int(row)


def stars_by_place(triangles: Triangles, points_m: FloatArray) -> dict[tuple[float, ...], FloatArray]:
    """The features (4, 8) of all stars by the coordinates of their corners, in the order of the angles."""
    names = points_m[triangles.vertices[: triangles.stars]].reshape(-1, 6)
    return dict(zip(map(tuple, names.tolist()), triangles.star_features(), strict=True))


def test_a_star_drawn_by_hand() -> None:
    found = describe(POINTS, AREAS, SHAPES)
    row = star_of(found, {0, 1, 2})
    # Angles rise from the corner on the long leg to the right angle at the origin.
    assert found.vertices[row].tolist() == [2, 1, 0]
    expected = [math.atan2(3, 4), math.atan2(4, 3), 30.0, 12.0, 0.5, 0.1, 0.9, 1.0]
    np.testing.assert_allclose(found.features[row], expected, rtol=1e-6)  # (8 27 125)^(1/3) = 30 m2
    # Centroids of the neighbours lie sqrt(50)/3, sqrt(61)/3 and sqrt(82)/3 away.
    beyond = [set(found.vertices[n].tolist()) for n in found.neighbours[row]]
    assert beyond == [{0, 2, 4}, {1, 2, 3}, {0, 1, 5}]
    star = found.star_features()[row]
    np.testing.assert_allclose(star[0], found.features[row])
    perimeters = [4 + math.sqrt(17) + 5, 5 + math.sqrt(29) + math.sqrt(40), 3 + math.sqrt(26) + math.sqrt(29)]
    np.testing.assert_allclose(star[1:, PERIMETER], perimeters, rtol=1e-6)
    np.testing.assert_allclose(star[1:, AREA], [100.0, 60.0, 6.0], rtol=1e-6)
    np.testing.assert_allclose(star[1:, SHAPE + 1], [0.2, 0.2, 0.2], rtol=1e-6)
    np.testing.assert_allclose(corner_areas(found, AREAS)[row], [8.0, 27.0, 125.0])


def test_only_triangles_with_three_neighbours_are_stars() -> None:
    found = describe(POINTS, AREAS, SHAPES)
    assert 0 < found.stars < len(found)
    assert np.all(found.neighbours[: found.stars] != NO_TRIANGLE)
    assert np.all((found.neighbours[found.stars :] == NO_TRIANGLE).any(axis=1))


NOT_ENOUGH = {
    "none": np.empty((0, 2)),
    "one": POINTS[:1],
    "two": POINTS[:2],
    "a triangle": POINTS[:3],
    "a square": np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 9.0]]),
    "on the x axis": np.column_stack([np.arange(9.0) * 30.0, np.zeros(9)]) + ORIGIN_M,
    "on a slanted line": np.outer(np.arange(9.0), [30.0 / 7.0, 10.0 / 3.0]) + ORIGIN_M,
    "in one place": np.tile(ORIGIN_M, (9, 1)),
    "in two places": np.repeat(POINTS[:2], 5, axis=0),
    "on a line, each twice": np.repeat(np.outer(np.arange(9.0), [30.0, 17.0]), 2, axis=0),
}


@pytest.mark.parametrize("points", NOT_ENOUGH.values(), ids=NOT_ENOUGH.keys())
def test_too_few_collinear_and_coincident_buildings_have_no_stars(points: FloatArray) -> None:
    found = describe(points, np.full(len(points), 100.0), np.full((len(points), 4), 0.5))
    assert found.stars == 0 and found.star_features().shape == (0, 4, 8)
    assert len(found) == {3: 1, 4: 2}.get(len(points), 0)


def test_duplicates_do_not_add_stars() -> None:
    once = town(4, 60, 350.0)
    thrice = once.select(np.repeat(np.arange(60), 3))
    one, other = (describe(b.centroids_m, b.areas_m2, b.shapes) for b in (once, thrice))
    found = stars_by_place(one, once.centroids_m), stars_by_place(other, thrice.centroids_m)
    assert len(found[0]) > 50 and found[0].keys() == found[1].keys()
    assert all(np.array_equal(found[0][name], found[1][name]) for name in found[0])


@settings(max_examples=60, deadline=None)
@given(
    yaw=st.floats(-math.pi, math.pi), x=st.floats(-1e6, 1e6), y=st.floats(-1e7, 1e7), seed=st.integers(0, 999)
)
def test_stars_do_not_change_with_rotation_shift_and_order(yaw: float, x: float, y: float, seed: int) -> None:
    # No four of these buildings lie within the millimetre of one circle that decides ties.
    here = town(3, 60, 350.0, origin_m=(0.0, 0.0))
    order = np.random.default_rng(seed).permutation(len(here))
    moved = here.select(order)
    there = moved.centroids_m @ rotation(yaw).T + [x, y]
    one = describe(here.centroids_m, here.areas_m2, here.shapes)
    two = describe(there, moved.areas_m2, moved.shapes)
    assert one.stars == two.stars > 50
    expected = dict(zip(map(tuple, one.vertices.tolist()), one.star_features(), strict=False))
    for corners, features in zip(order[two.vertices[: two.stars]].tolist(), two.star_features(), strict=True):
        # Single precision of a perimeter of a kilometre.
        np.testing.assert_allclose(features, expected[tuple(corners)], rtol=1e-6, atol=1e-6)


def test_a_mirrored_map_is_recognised_and_rejected() -> None:
    city = whole(town(5, 1500, 1500.0))
    near = np.hypot(*(city.centroids_m - city.centroids_m.mean(axis=0)).T) < 250.0
    seen = city.buildings.select(near)
    mirrored = Buildings(seen.centroids_m * [-1.0, 1.0], seen.areas_m2, seen.shapes)
    found = mesh(mirrored.centroids_m, mirrored.areas_m2, mirrored.shapes)
    one = replace(DEFAULT, matches_per_star=1)
    matches = match_stars(found.stars, city.tables, one)
    # Sorted angles cannot tell a star from its mirror image; the order of the corners can.
    centre = mirrored.centroids_m.mean(axis=0)
    hypotheses = hypothesize(matches, found.corners, mirrored.centroids_m, city, centre, one)
    assert np.median(matches.score) == pytest.approx(1.0, abs=1e-5)
    assert hypotheses.mirrored > 0.9 * len(found.stars) > 100
    matcher = Matcher(city, DEFAULT)
    assert matcher.judge(matcher.locate(local_map(seen))).reason is None
    assert matcher.judge(matcher.locate(local_map(mirrored))).reason is not None


def circumradius(corners_m: FloatArray) -> float:
    """A b c / 4 A, by Heron."""
    a, b, c = (float(np.hypot(*(corners_m[i] - corners_m[j]))) for i, j in ((0, 1), (1, 2), (2, 0)))
    s = (a + b + c) / 2.0
    return a * b * c / (4.0 * math.sqrt(s * (s - a) * (s - b) * (s - c)))


@pytest.mark.parametrize("scale", [1.0, 80.0, 100.0, 119.0, 121.0])
def test_triangles_over_empty_land_are_left_out(scale: float) -> None:
    small = describe(POINTS, AREAS, SHAPES)
    large = describe(POINTS * scale, AREAS, SHAPES)
    fits = {
        tuple(corners)
        for corners in small.vertices.tolist()
        if circumradius(POINTS[corners]) * scale <= MAX_CIRCUMRADIUS_M
    }
    assert set(map(tuple, large.vertices.tolist())) == fits
    assert ((2, 1, 0) in fits) == (scale < 120.0)  # half the hypotenuse of 5
    whole_star = all(
        any(set(pair) <= set(corners) and k not in corners for corners in fits)
        for pair, k in (((0, 1), 2), ((1, 2), 0), ((0, 2), 1))
    )
    assert (large.stars > 0) == ((2, 1, 0) in fits and whole_star)


@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_a_regular_grid_has_the_same_stars_in_every_window(yaw: float) -> None:
    grid = lattice(30, 30)
    points = (grid.centroids_m - ORIGIN_M) @ rotation(yaw).T + ORIGIN_M
    everything = describe(points, grid.areas_m2, grid.shapes)
    expected = stars_by_place(everything, points)
    for west, south in itertools.product((2, 5, 9), (0, 7)):
        column, row = np.divmod(np.arange(900), 30)
        rows = np.flatnonzero((column >= west) & (column < west + 15) & (row >= south) & (row < south + 13))
        inside = points[rows]
        found = describe(inside, grid.areas_m2[rows], grid.shapes[rows])
        inner = (column >= west + 2) & (column < west + 13) & (row >= south + 2) & (row < south + 11)
        places = {tuple(place) for place in points[inner].tolist()}

        def within(star: tuple[float, ...], places: set[tuple[float, ...]] = places) -> bool:
            return {star[:2], star[2:4], star[4:]} <= places

        here = {star for star in stars_by_place(found, inside) if within(star)}
        assert here == {star for star in expected if within(star)}
        assert len(here) == 2 * 10 * 8  # two triangles in every cell


def test_the_index_sorts_stars_by_cell_and_perimeter() -> None:
    (tile,) = cut(town(6, 800, 900.0), 1e6).values()
    cell, starts = cells(tile.sketches), cell_starts(tile.sketches)
    assert np.all(np.diff(cell) >= 0) and starts[-1] == tile.triangles.stars == tile.sketches.shape[1]
    for c in np.unique(cell):
        assert np.all(cell[starts[c] : starts[c + 1]] == c)
        assert np.all(np.diff(tile.sketches[2, starts[c] : starts[c + 1]].astype(int)) >= 0)
