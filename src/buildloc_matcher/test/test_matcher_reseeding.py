"""Seeds laid anew around rough hypotheses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.evidence import ground, query_map
from buildloc_matcher.growth import grown_nats
from buildloc_matcher.hypotheses import Hypotheses
from buildloc_matcher.reseeding import FOUND, reseeded
from buildloc_msgs_py.types import FloatArray
from towns import DEFAULT, town

CITY = town(83, 3000, 1800.0)
GROUND = ground(CITY.centroids_m, CITY.areas_m2)
MIDDLE = CITY.centroids_m.mean(axis=0)
ROWS = np.flatnonzero((np.abs(CITY.centroids_m - MIDDLE) < (220.0, 60.0)).all(axis=1))[::2]
YAW = 0.8  # of the world in the map
SEEN = ((CITY.centroids_m[ROWS] - MIDDLE) @ (1.0, 1.0j)) * np.exp(-1j * YAW)
QUERY = query_map(np.column_stack([SEEN.real, SEEN.imag]), CITY.areas_m2[ROWS].astype(float), DEFAULT)
TRUE_M = CITY.centroids_m[ROWS].mean(axis=0)


def voter(off_m: FloatArray, turned: float, scale: float = 1.0, vote: float = 1.0) -> Hypotheses:
    """That the middle of the map lies so far from where it does."""
    return Hypotheses(
        np.zeros(1, dtype=np.int64), np.zeros((1, 3, 2)), (TRUE_M + off_m)[None], np.array([YAW + turned]),
        np.array([scale]), np.array([vote]), mirrored=0, off_scale=0,
    )  # fmt: skip


def nats(corners: np.ndarray, found: Hypotheses) -> FloatArray:
    return grown_nats(QUERY, corners, found.places_m, GROUND, DEFAULT)


def test_around_a_rough_hypothesis_some_seeds_are_right() -> None:
    rough = voter(np.array([7.0, -6.0]), math.radians(3.0), 1.02)
    corners, found = reseeded(rough, QUERY, GROUND, 400_000, DEFAULT)
    assert len(corners) == len(found) > 10
    true = (np.abs(found.places_m - CITY.centroids_m[ROWS[corners]]) < 0.01).all(axis=(1, 2))
    assert 0.02 < true.mean() < 0.9
    away = np.hypot(*(found.positions_m[true] - TRUE_M).T)
    assert away.max() < 1e-6 and np.abs(found.yaws_rad[true] - YAW).max() < 1e-9
    assert found.scales[true] == pytest.approx(1.0)
    grown = nats(corners, found)
    assert np.median(grown[true]) > 3.0 * len(ROWS) > 0.0 > np.median(nats(*reseeded(
        voter(np.array([400.0, 300.0]), 1.0), QUERY, GROUND, 400_000, DEFAULT
    )))  # fmt: skip


def test_seeds_are_neighbours_of_the_map_beside_buildings_of_the_reference() -> None:
    corners, found = reseeded(voter(np.array([3.0, 4.0]), 0.05), QUERY, GROUND, 400_000, DEFAULT)
    moved = (QUERY.points_m - QUERY.points_m.mean(axis=0)) @ (1.0, 1.0j) * np.exp(1j * (YAW + 0.05))
    laid = np.column_stack([moved.real, moved.imag]) + TRUE_M + (3.0, 4.0)
    for triangle, places in zip(corners, found.places_m, strict=True):
        assert set(triangle[1:]) <= set(QUERY.neighbours[triangle[0]])
        assert len(set(triangle.tolist())) == len(np.unique(places, axis=0)) == 3
        assert (np.hypot(*(places - laid[triangle]).T) <= DEFAULT.mnn_distance_m).all()
    assert np.bincount(corners[:, 0]).max() <= FOUND * (FOUND - 1) // 2
    assert np.abs(found.scales - 1.0).max() <= DEFAULT.scale_gate


def test_the_likeliest_of_each_bin_and_no_more_than_wanted() -> None:
    both = voter(np.zeros(2), 0.0, vote=9.0).joined(voter(np.array([20.0, 0.0]), 0.5, vote=5.0), 1)
    best, _ = reseeded(voter(np.zeros(2), 0.0), QUERY, GROUND, 400_000, DEFAULT)
    assert len(reseeded(both, QUERY, GROUND, 400_000, DEFAULT)[0]) == len(best) > 0
    three = 3 * len(QUERY.points_m)
    assert len(reseeded(both, QUERY, GROUND, three, DEFAULT)[0]) == len(best) <= three
    assert len(reseeded(both, QUERY, GROUND, three - 1, DEFAULT)[0]) == 0
    assert len(reseeded(both, QUERY, GROUND, 400_000, replace(DEFAULT, reseeded=0))[1]) == 0
    none = both.weighted(np.zeros(2))
    assert len(reseeded(none, QUERY, GROUND, 400_000, DEFAULT)[0]) == 0
