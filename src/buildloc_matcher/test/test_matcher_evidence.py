"""Evidence of what lies around a seed, against chance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.descriptors import describe
from buildloc_matcher.evidence import (
    HOPELESS,
    NEIGHBOURS,
    NO_MATCH,
    WITNESSES,
    absence_evidence,
    area_evidence,
    density_at,
    ground,
    placed_evidence,
    query_map,
    scale_evidence,
    seed_evidence,
    shares_of,
    witnesses,
)
from buildloc_matcher.geometry import rotation
from buildloc_msgs_py.types import FloatArray
from towns import DEFAULT, alike, lattice, mapped, strip, town

CITY = town(61, 4000, 1900.0)  # 30 m apart on average
GROUND = alike(CITY.centroids_m)
SEEN = strip(CITY, 900.0, 70.0)
TURN = rotation(2.5)
TRIANGLES = describe(SEEN.centroids_m, SEEN.areas_m2, SEEN.shapes).vertices.astype(np.int64)


def as_map(points_m: FloatArray, sigma_m: float = 0.0) -> FloatArray:
    """In a frame of its own, with errors."""
    noise = np.random.default_rng(1).normal(0.0, sigma_m, points_m.shape)
    return (points_m - points_m.mean(axis=0)) @ TURN.T + noise


def evidence(query_m: FloatArray, triangles: np.ndarray, places_m: FloatArray) -> FloatArray:
    seeds = np.arange(len(triangles))
    return seed_evidence(mapped(query_m), triangles, seeds, places_m, GROUND, DEFAULT)


@pytest.mark.parametrize("sigma_m", [0.0, 1.0])
def test_true_seeds_have_more_than_chance(sigma_m: float) -> None:
    query = as_map(SEEN.centroids_m, sigma_m)
    true = evidence(query, TRIANGLES, SEEN.centroids_m[TRIANGLES])
    # The same triangles laid on corners somewhere else: the shapes fit, the surroundings do not.
    moved = as_map(SEEN.centroids_m) @ TURN + SEEN.centroids_m.mean(axis=0) + (37.0, 411.0)
    wrong = evidence(query, TRIANGLES, moved[TRIANGLES])
    assert len(true) > 150
    assert np.quantile(true, 0.1) > 20.0 > 0.0 > np.quantile(wrong, 0.9)
    assert np.all(wrong > HOPELESS - 10.0)  # one that sinks is given up


def test_more_witnesses_are_more_evidence() -> None:
    middle = int(
        np.argmin(np.abs(SEEN.centroids_m[TRIANGLES].mean(axis=1) - SEEN.centroids_m.mean(axis=0)).sum(1))
    )
    corners = TRIANGLES[middle]
    others = witnesses(mapped(SEEN.centroids_m), corners[None])[0]
    nats = []
    for count in range(1, WITNESSES + 1):
        kept = np.concatenate([corners, others[:count]])
        some = as_map(SEEN.centroids_m)[kept]
        nats.append(evidence(some, np.array([[0, 1, 2]]), SEEN.centroids_m[corners][None])[0])
    # Each lies where it is predicted; by chance a building does so within a metre once in 300 times.
    assert np.all(np.diff(nats) > 1.0) and nats[0] > 1.0
    (everything,) = evidence(as_map(SEEN.centroids_m), corners[None], SEEN.centroids_m[corners][None])
    # A little more: among a hundred alike, each is a little less likely to be invented.
    assert everything == pytest.approx(nats[-1], rel=1e-3)


def test_a_building_that_is_missing_costs_less_than_one_that_is_found_gains() -> None:
    corners = TRIANGLES[len(TRIANGLES) // 2]
    query = as_map(SEEN.centroids_m)
    (whole,) = evidence(query, corners[None], SEEN.centroids_m[corners][None])
    last = witnesses(mapped(query), corners[None])[0][-1]
    hole = np.flatnonzero(np.hypot(*(CITY.centroids_m - SEEN.centroids_m[last]).T) > 30.0)
    without = seed_evidence(
        mapped(query), corners[None], np.zeros(1, dtype=np.int64), SEEN.centroids_m[corners][None],
        alike(CITY.centroids_m[hole]), DEFAULT,
    )[0]  # fmt: skip
    assert 0.0 < without < whole


def test_a_map_laid_where_it_belongs_and_elsewhere() -> None:
    here = SEEN.centroids_m
    shares = np.full(len(here), 0.7)
    assert placed_evidence(here, shares, GROUND, DEFAULT) > 3.0 * len(here)
    for shift in ((300.0, 0.0), (0.0, -250.0), (20.0, 20.0)):
        assert placed_evidence(here + shift, shares, GROUND, DEFAULT) < 0.0
    far = placed_evidence(here + 1e5, shares, GROUND, DEFAULT)
    # Nothing there: each building was seen in the reference with a probability of 0.7, up to 3 sigma.
    assert far == pytest.approx(len(here) * math.log(1.0 - 0.7 * (1.0 - math.exp(-4.5))))


def test_the_density_is_that_of_the_surroundings() -> None:
    block = alike(lattice(40, 40, 25.0).centroids_m)
    # 1 in 625 m2, in cells of 100 m that hold four rows of four.
    assert block.density_per_m2[3:6, 3:6] == pytest.approx(1.0 / 625.0)
    assert np.all(block.density_per_m2 > 0.0)
    lonely = alike(np.array([[0.0, 0.0], [2000.0, 2000.0]])).density_per_m2
    assert lonely[10, 10] == 2e-5


def test_neighbours_and_witnesses_are_the_nearest_others() -> None:
    points = SEEN.centroids_m
    distances = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    expected = np.argsort(distances, axis=1)[:, 1 : NEIGHBOURS + 1]
    np.testing.assert_array_equal(mapped(points).neighbours, expected)
    near = witnesses(mapped(points), TRIANGLES[:5])
    for corners, others in zip(TRIANGLES[:5], near, strict=True):
        apart = np.hypot(*(points - points[corners].mean(axis=0)).T)
        apart[corners] = np.inf
        assert others.tolist() == np.argsort(apart)[:WITNESSES].tolist()


def test_small_maps_have_fewer_neighbours_and_padded_witnesses() -> None:
    five = SEEN.centroids_m[:5]
    assert mapped(five).neighbours.shape == (5, 4)
    near = witnesses(mapped(five), np.array([[0, 1, 2]]))
    assert set(near[0, :2].tolist()) == {3, 4} and np.all(near[0, 2:] == NO_MATCH)
    assert witnesses(mapped(five), np.empty((0, 3), dtype=np.int64)).shape == (0, WITNESSES)


def test_areas_speak_for_true_pairs_against_exchanged_ones_and_a_common_factor_is_no_matter() -> None:
    rng = np.random.default_rng(4)
    theirs = np.exp(rng.normal(5.0, 0.6, 60))
    ours = theirs * np.exp(rng.normal(0.0, 0.2, 60))
    true = area_evidence(ours, theirs, theirs, DEFAULT)
    assert true > 15.0
    assert area_evidence(1.3 * ours, theirs, theirs, DEFAULT) == pytest.approx(true)
    exchanged = [area_evidence(rng.permutation(ours), theirs, theirs, DEFAULT) for _ in range(20)]
    assert max(exchanged) < -5.0
    # One wild area costs less than ln(5): it may always be something else.
    wild = np.concatenate([[1e4], ours[1:]])
    assert true - area_evidence(wild, theirs, theirs, DEFAULT) < 4.0
    assert area_evidence(ours[:3], theirs[:3], theirs, DEFAULT) == 0.0


def test_a_wrong_scale_speaks_against() -> None:
    assert scale_evidence(1.0, DEFAULT) == 0.0
    assert scale_evidence(1.1, DEFAULT) == pytest.approx(-2.0) == pytest.approx(scale_evidence(0.9, DEFAULT))


def test_what_is_not_seen_speaks_against_a_place() -> None:
    # Ten buildings of a map over a hundred of the reference, 1.1 per 1000 m2 there: by chance a building of
    # the reference has one of the map within 10 m in 1 - exp(-pi 100 1.1e-4) = 3.4 % of cases.
    around = CITY.centroids_m[
        np.argsort(np.hypot(*(CITY.centroids_m - CITY.centroids_m.mean(axis=0)).T))[:100]
    ]
    density = float(density_at(around, GROUND).mean())
    assert density == pytest.approx(1.1e-3, rel=0.1)
    chance = 1.0 - math.exp(-math.pi * DEFAULT.mnn_distance_m**2 * density * 10 / 100)
    expected = 3 * math.log(0.5 / chance) + 97 * math.log(0.5 / (1.0 - chance))
    assert absence_evidence(3, around, 10, GROUND, DEFAULT) == pytest.approx(expected) and expected < -50.0
    # As many as a true place shows are counted where they lie, not here.
    assert absence_evidence(60, around, 100, GROUND, DEFAULT) == 0.0
    assert absence_evidence(0, np.empty((0, 2)), 10, GROUND, DEFAULT) == 0.0


def test_small_buildings_are_invented_where_there_are_no_more_than_a_segmenter_invents() -> None:
    """On the 0.5 km2 of this map 65 of about 33 m2 are invented."""
    rng = np.random.default_rng(4)
    points, houses = rng.uniform(0.0, 600.0, (200, 2)), rng.lognormal(math.log(150.0), 0.3, 150)
    invented = rng.lognormal(math.log(33.0), 0.3, 50)
    shares = shares_of(points, np.concatenate([houses, invented]), DEFAULT)
    assert np.median(shares[:150]) > 0.95 * DEFAULT.match_share
    assert np.median(shares[150:]) < 0.3 * DEFAULT.match_share
    # In a town of small houses hardly any are: there are many more of them.
    crowd = rng.uniform(0.0, 600.0, (1500, 2))
    shares = shares_of(crowd, rng.lognormal(math.log(33.0), 0.3, 1500), DEFAULT)
    assert shares.min() > 0.6 * DEFAULT.match_share
    assert shares.max() <= DEFAULT.match_share


def test_invented_buildings_are_seldom_witnesses_and_cost_little() -> None:
    houses = SEEN.centroids_m
    middle = houses.mean(axis=0)
    points = np.concatenate([houses, middle + np.random.default_rng(5).uniform(-150.0, 150.0, (20, 2))])
    areas = np.concatenate([np.full(len(houses), 150.0), np.full(20, 30.0)])
    query = query_map(points, areas, DEFAULT)
    shares = np.where(np.arange(len(points)) < len(houses), 1.0, 1e-3)
    assert witnesses(replace(query, shares=shares), TRIANGLES).max() < len(houses)
    assert np.mean(witnesses(query, TRIANGLES) >= len(houses)) < 0.05
    with_them = placed_evidence(points, query.shares, GROUND, DEFAULT)
    without = placed_evidence(houses, query.shares[: len(houses)], GROUND, DEFAULT)
    assert without - 6.0 < with_them


def test_a_match_gets_from_one_real_building_to_the_next() -> None:
    """Among neighbours a building is as far away as its distance over its share."""
    rng = np.random.default_rng(3)
    houses = np.column_stack([60.0 * np.arange(20.0), rng.uniform(-5.0, 5.0, 20)])
    between = rng.uniform((0.0, -20.0), (1140.0, 20.0), (25, 2))
    areas = np.concatenate([np.full(20, 400.0), np.maximum(rng.lognormal(math.log(33.0), 0.5, 25), 20.0)])
    points = np.concatenate([houses, between])
    query = query_map(points, areas, DEFAULT)
    for k, found in enumerate(query.neighbours.tolist()):
        others = np.delete(np.arange(len(points)), k)
        away = np.hypot(*(points[others] - points[k]).T) / query.shares[others]
        assert found == others[np.argsort(away)][:NEIGHBOURS].tolist()
    of_houses = query.neighbours[5:15]
    assert np.mean(of_houses < 20) > 0.6  # of the twelve nearest five would be houses
    assert all({k - 1, k + 1} <= set(found) for k, found in enumerate(of_houses.tolist(), start=5))


def test_the_least_area_of_a_map_does_not_make_small_buildings_suspect() -> None:
    rng = np.random.default_rng(8)
    points = rng.uniform(0.0, 900.0, (1500, 2))
    real = np.exp(rng.uniform(math.log(20.0), math.log(400.0), 1500))
    shares = shares_of(points, real, DEFAULT)
    least, above = shares[real < 22.0].mean(), shares[(real > 26.0) & (real < 32.0)].mean()
    assert least > 0.8 * above > 0.3
    invented = rng.lognormal(math.log(33.0), 0.5, 400)
    suspect = shares_of(points[:100], invented[invented > 20.0][:100], DEFAULT)
    assert suspect.max() < 0.25


def test_a_corner_of_the_seed_is_no_witness() -> None:
    corners = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 30.0]])
    query, nothing = np.concatenate([corners, [[3.0, 2.0]]]), np.array([[3000.0, 3000.0]])
    seeds, zero = corners[None], np.zeros(1, dtype=np.int64)

    def nats(others: FloatArray) -> float:
        reference = alike(np.concatenate([corners, others]))
        return float(seed_evidence(mapped(query), np.array([[0, 1, 2]]), zero, seeds, reference, DEFAULT)[0])

    # The fourth lies beside the first, whose place in the reference is the corner's.
    assert nats(nothing) < 0.0 < nats(np.concatenate([nothing, [[3.2, 2.1]]]))


def test_a_witness_of_another_size_says_less() -> None:
    corners = TRIANGLES[len(TRIANGLES) // 2]
    rng = np.random.default_rng(2)
    areas = rng.lognormal(math.log(200.0), 0.5, len(CITY))
    reference = ground(CITY.centroids_m, areas)
    rows = np.array([int(np.argmin(np.hypot(*(CITY.centroids_m - p).T))) for p in SEEN.centroids_m])

    def nats(seen_m2: FloatArray) -> float:
        query = query_map(as_map(SEEN.centroids_m), seen_m2, DEFAULT)
        seeds, zero = SEEN.centroids_m[corners][None], np.zeros(1, dtype=np.int64)
        return float(seed_evidence(query, corners[None], zero, seeds, reference, DEFAULT)[0])

    right, exchanged = nats(areas[rows]), nats(rng.permutation(areas[rows]))
    assert right > exchanged + 5.0
    assert nats(1.2 * areas[rows]) > exchanged + 4.0  # roofs are larger than walls, all of them


def test_one_building_of_the_reference_is_no_witness_twice() -> None:
    corners = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 30.0]])
    # Two of the map where the reference has one; the others speak against the place.
    query = np.concatenate([corners, [[60.0, 40.0], [61.0, 40.0], [62.0, 41.0]]])
    reference = alike(np.concatenate([corners, [[60.5, 40.0], [3000.0, 3000.0]]]))

    def nats(count: int) -> float:
        seeds, zero = corners[None], np.zeros(1, dtype=np.int64)
        return float(
            seed_evidence(mapped(query[:count]), np.array([[0, 1, 2]]), zero, seeds, reference, DEFAULT)[0]
        )

    assert nats(4) > 4.0
    assert nats(6) < nats(5) < nats(4)
