"""Pairs of buildings, tried wherever the reference has two like them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from buildloc_matcher.config import matcher_config
from buildloc_matcher.evidence import QueryMap, ground, query_map
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.pairs import (
    LENGTH_OFF,
    LENGTH_OFF_M,
    LENGTHS_M,
    LOG_AREA_OFF,
    USED_OFTEN,
    _like,
    choose_pairs,
    pair_hypotheses,
)
from buildloc_matcher.reference.database import assemble
from buildloc_msgs_py.types import FloatArray, LocalMap
from towns import DEFAULT, town

CITY = town(71, 6000, 2600.0)
GROUND = ground(CITY.centroids_m, CITY.areas_m2)
TURN, MOVED_M = 0.7, np.array([311.0, -96.0])


def sparse_flight(seed: int, real: int, invented: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A map over a strip of 700 x 100 m that shows few of its buildings and as many that are not there: its
    buildings (N, 2), their areas (N,), and the true places (N, 2)."""
    rng = np.random.default_rng(seed)
    low = CITY.centroids_m.mean(axis=0) - (350.0, 50.0)
    away = CITY.centroids_m - low
    inside = np.flatnonzero(((away > 0.0) & (away < (700.0, 100.0))).all(axis=1))
    rows = rng.choice(inside, real, replace=False)
    anywhere = low + rng.uniform(0.0, 1.0, (invented, 2)) * (700.0, 100.0)
    true = np.concatenate([CITY.centroids_m[rows], anywhere])
    areas = np.concatenate([CITY.areas_m2[rows], np.exp(rng.uniform(3.5, 6.0, invented))]).astype(np.float64)
    seen = (true - true.mean(axis=0) + rng.normal(0.0, 0.5, true.shape)) @ [1.0, 1.0j] * np.exp(-1j * TURN)
    return np.column_stack([seen.real, seen.imag]) + MOVED_M, areas, true


def query_of(points_m: FloatArray, areas_m2: FloatArray) -> QueryMap:
    return query_map(points_m, areas_m2, DEFAULT)


def test_pairs_are_of_neighbours_and_no_building_is_in_many() -> None:
    points, areas, _ = sparse_flight(1, 18, 12)
    pairs = choose_pairs(query_of(points, areas), GROUND)
    assert len(pairs) > 12 and len(np.unique(np.sort(pairs, axis=1), axis=0)) == len(pairs)
    lengths = np.hypot(*(points[pairs[:, 0]] - points[pairs[:, 1]]).T)
    assert lengths.min() >= LENGTHS_M[0] and lengths.max() <= LENGTHS_M[1]
    assert np.bincount(pairs.ravel()).max() <= USED_OFTEN


def test_rare_and_real_buildings_come_first() -> None:
    points, areas = np.random.default_rng(2).uniform(0.0, 300.0, (12, 2)), np.full(12, 100.0)
    points[:2] = (150.0, 150.0), (150.0, 190.0)
    areas[:2] = 390.0, 300.0  # few of the city are so large
    assert choose_pairs(query_of(points, areas), GROUND)[0].tolist() == [0, 1]


def test_those_alike_are_all_that_comparing_every_pair_finds() -> None:
    few = town(72, 150, 500.0)
    where = ground(few.centroids_m, few.areas_m2)
    grid, sizes = where.grid, np.log(where.areas_m2[where.grid.order].astype(np.float64))
    length, first, second = 60.0, math.log(80.0), math.log(200.0)
    off = LENGTH_OFF_M + LENGTH_OFF * length
    found = _like(length, off, first, second, sizes, grid.points_m, grid.starts, grid.frame)
    apart = np.hypot(*(grid.points_m[:, None] - grid.points_m[None]).transpose(2, 0, 1))
    alike = (np.abs(sizes - first) <= LOG_AREA_OFF)[:, None] & (np.abs(sizes - second) <= LOG_AREA_OFF)[None]
    expected = np.argwhere((np.abs(apart - length) <= off) & alike)
    assert len(expected) > 20
    assert {tuple(pair) for pair in found.tolist()} == {tuple(pair) for pair in expected.tolist()}
    assert len(found) == len(expected)


def test_hypotheses_lie_where_their_corners_do() -> None:
    points, areas, true = sparse_flight(3, 18, 12)
    query = query_of(points, areas)
    corners, found = pair_hypotheses(query, GROUND, 100_000, DEFAULT)
    assert len(found) == len(corners) > 0 and (found.weights > 1.0).all()
    assert found.stars.tolist() == list(range(len(found)))
    here = np.hypot(*(found.positions_m - true.mean(axis=0)).T) < 20.0
    assert here.any()
    best = int(np.argmax(np.where(here, found.weights, 0.0)))
    assert found.yaws_rad[best] == pytest.approx(TURN, abs=0.1)
    assert found.scales[best] == pytest.approx(1.0, abs=0.1)
    assert np.hypot(*(found.places_m[best] - true[corners[best]]).T).max() < 3.0


def test_maps_without_pairs_have_no_hypotheses() -> None:
    apart = np.arange(6)[:, None] * np.array([[500.0, 0.0]])
    corners, found = pair_hypotheses(query_of(apart, np.full(6, 150.0)), GROUND, 100_000, DEFAULT)
    assert corners.shape == (0, 3) and len(found) == 0


def test_no_more_places_are_tried_than_asked_for() -> None:
    points, areas, _ = sparse_flight(3, 18, 12)
    query = query_of(points, areas)
    counts = [len(pair_hypotheses(query, GROUND, most, DEFAULT)[1]) for most in (0, 5_000, 100_000)]
    assert counts[0] == 0 < counts[1] < counts[2]


def located(matcher: Matcher, points: FloatArray, areas: FloatArray, true: FloatArray) -> float:
    """How far off the first place is, m; infinite without one."""
    ids = np.arange(len(points), dtype=np.int64)
    shapes = np.random.default_rng(5).uniform(0.3, 1.0, (len(points), 4))
    found = matcher.locate(LocalMap.whole(0, ids, points, areas, shapes, np.ones_like(ids)))
    if not found.candidates:
        return math.inf
    return math.hypot(*(np.array([found.candidates[0].x_m, found.candidates[0].y_m]) - true.mean(axis=0)))


def test_sparse_maps_are_found_by_pairs_where_stars_find_nothing() -> None:
    """Hardly a triangle of the few that are seen is one of the reference's, and the shapes are wrong."""
    flights = [sparse_flight(seed, 12, 10) for seed in range(6)]
    database = assemble(32619, CITY, DEFAULT)
    right = {
        places: sum(
            located(Matcher(database, matcher_config({"second_look_places": places})), *flight) < 20.0
            for flight in flights
        )
        for places in (0, 200_000)
    }
    assert right[0] <= 2 and right[200_000] >= 5
