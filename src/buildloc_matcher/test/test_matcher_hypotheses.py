"""A known similarity from matched stars; mirrored and off-scale matches are counted and left out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.geometry import Similarity
from buildloc_matcher.hypotheses import Hypotheses, hypothesize
from buildloc_matcher.matching import NOTHING, Matches
from buildloc_matcher.mesh import mesh
from buildloc_msgs_py.types import FloatArray
from hypothesis import given, settings
from hypothesis import strategies as st
from towns import DEFAULT, tiled, town, whole

CITY = town(51, 300, 600.0)
DATABASE = whole(CITY)
(TILE,) = DATABASE.tiles
CORNERS = TILE.triangles.vertices[: DATABASE.stars].astype(np.int64)
WORLD = TILE.buildings.centroids_m


def each_with_itself(count: int = DATABASE.stars) -> Matches:
    """Every star of the map matches the star of the reference that has its number."""
    numbers = np.arange(count)[:, None]
    return Matches(numbers, np.linspace(0.5, 1.0, count, dtype=np.float32)[:, None], 0, 0)


def found_in(query_m: FloatArray, gate: float = 0.15, matches: Matches | None = None) -> Hypotheses:
    config = replace(DEFAULT, scale_gate=gate)
    centre = query_m.mean(axis=0)
    return hypothesize(matches or each_with_itself(), CORNERS, query_m, DATABASE, centre, config)


@settings(max_examples=50, deadline=None)
@given(yaw=st.floats(-3.1, 3.1), scale=st.floats(0.87, 1.14), x=st.floats(-1e4, 1e4), y=st.floats(-1e4, 1e4))
def test_a_known_similarity_is_recovered(yaw: float, scale: float, x: float, y: float) -> None:
    # The map is the world moved by the inverse.
    centre = WORLD.mean(axis=0)
    back = Similarity((centre[0], centre[1]), (x, y), -yaw, 1.0 / scale)
    found = found_in(back.apply(WORLD))
    assert len(found) == len(found.weights) == DATABASE.stars and (found.mirrored, found.off_scale) == (0, 0)
    # Coordinates of 5e6 m keep 1e-9 m; a triangle of metres carries them over a kilometre.
    np.testing.assert_allclose(found.positions_m, np.tile(centre, (len(found), 1)), atol=1e-3)
    np.testing.assert_allclose(found.yaws_rad, yaw, atol=1e-6)
    np.testing.assert_allclose(found.scales, scale, rtol=1e-6)
    np.testing.assert_array_equal(found.stars, np.arange(DATABASE.stars))
    np.testing.assert_array_equal(found.places_m, WORLD[CORNERS])
    np.testing.assert_allclose(found.weights, np.linspace(0.5, 1.0, DATABASE.stars), rtol=1e-6)


def test_mirrored_matches_are_rejected_and_counted() -> None:
    found = found_in(WORLD * [-1.0, 1.0])
    assert (len(found), found.mirrored, found.off_scale) == (0, DATABASE.stars, 0)


@pytest.mark.parametrize(("scale", "kept"), [(0.84, False), (0.86, True), (1.14, True), (1.16, False)])
def test_the_scale_gate(scale: float, kept: bool) -> None:
    found = found_in(WORLD / scale)
    assert len(found) == (DATABASE.stars if kept else 0)
    assert found.off_scale == DATABASE.stars - len(found) and found.mirrored == 0
    assert len(found_in(WORLD / scale, gate=0.2)) == DATABASE.stars


def test_the_scale_is_the_ratio_of_the_perimeters() -> None:
    stretched = WORLD * [1.0, 1.05]
    found = found_in(stretched)

    def perimeter(points: FloatArray) -> float:
        return float(sum(np.hypot(*(points[i] - points[i - 1])) for i in range(3)))

    ratios = [perimeter(WORLD[c]) / perimeter(stretched[c]) for c in CORNERS]
    np.testing.assert_allclose(found.scales, ratios, rtol=1e-9)


def test_some_right_some_mirrored_some_off_scale_and_some_without_a_match() -> None:
    query = WORLD.copy()
    apart = found_in(query)
    triangles = [set(corners) for corners in CORNERS.tolist()]
    first = next(i for i, t in enumerate(triangles))
    second = next(i for i, t in enumerate(triangles) if not t & triangles[first])
    third = next(i for i, t in enumerate(triangles) if not t & (triangles[first] | triangles[second]))
    rows = CORNERS[second]
    query[rows] = query[rows] * [-1.0, 1.0]
    rows = CORNERS[third]
    query[rows] = query[rows].mean(axis=0) + 2.0 * (query[rows] - query[rows].mean(axis=0))
    numbers = np.full((DATABASE.stars, 2), NOTHING, dtype=np.int64)
    numbers[[first, second, third], 0] = [first, second, third]
    scores = np.full(numbers.shape, 0.7, dtype=np.float32)
    found = found_in(query, matches=Matches(numbers, scores, 0, 0))
    assert (found.stars.tolist(), found.mirrored, found.off_scale) == ([first], 1, 1)
    assert found.yaws_rad[0] == pytest.approx(apart.yaws_rad[first], abs=1e-9)


def test_corners_come_from_the_right_tile() -> None:
    many = tiled(CITY, 150.0)
    corners = many.star_corners(np.arange(many.stars))
    at = 0
    for tile in many.tiles:
        own = tile.buildings.centroids_m[tile.triangles.vertices[: tile.triangles.stars]]
        np.testing.assert_array_equal(corners[at : at + len(own)], own)
        at += len(own)
    assert at == len(corners) == DATABASE.stars and len(many.tiles) > 10
    shuffled = np.random.default_rng(1).permutation(many.stars)
    np.testing.assert_array_equal(many.star_corners(shuffled), corners[shuffled])


def test_new_votes_leave_out_what_has_none() -> None:
    found = found_in(WORLD)
    weights = np.where(np.arange(len(found)) % 3 == 0, 2.0, 0.0)
    some = found.weighted(weights)
    assert len(some) == (weights > 0).sum() and np.all(some.weights == 2.0)
    np.testing.assert_array_equal(some.stars, found.stars[::3])
    np.testing.assert_array_equal(some.places_m, found.places_m[::3])


def test_no_match_is_no_hypothesis() -> None:
    found = mesh(CITY.centroids_m, CITY.areas_m2, CITY.shapes)
    none = Matches(np.full((len(found.stars), 3), NOTHING), np.zeros((len(found.stars), 3), np.float32), 0, 0)
    empty = hypothesize(none, found.corners, CITY.centroids_m, DATABASE, np.zeros(2), DEFAULT)
    assert len(empty) == empty.mirrored == empty.off_scale == 0
    assert math.isclose(float(np.sum(empty.weights)), 0.0)
