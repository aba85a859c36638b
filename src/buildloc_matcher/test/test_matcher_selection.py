"""MNN-Jaccard (Eq. 4) by hand, what a flight observes, and the score of candidates on a map that bends."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.config import MatcherConfig, matcher_config
from buildloc_matcher.evidence import Ground
from buildloc_matcher.geometry import Similarity, fit_similarity
from buildloc_matcher.growth import grow
from buildloc_matcher.hypotheses import Hypotheses
from buildloc_matcher.selection import (
    Score,
    local_transform,
    mnn_jaccard,
    mutual_pairs,
    observable,
    pieces_of_one,
    score_grown,
    score_rigid,
    select,
    shifted,
)
from buildloc_matcher.voting import Ballot, Cluster, vote
from buildloc_msgs_py.types import FloatArray
from hypothesis import given, settings
from hypothesis import strategies as st
from towns import DEFAULT, alike, bent, mapped, strip, town

PAPER = matcher_config({"preset": "paper"})
QUERY = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]])
REFERENCE = np.array([[1.0, 0.0], [4.0, 0.0], [100.0, 3.0], [100.0, 160.0], [50.0, 50.0], [900.0, 0.0]])


def test_mutual_pairs_by_hand() -> None:
    assert mutual_pairs(QUERY, REFERENCE, 25.0).tolist() == [[0, 0], [1, 2]]
    assert mutual_pairs(QUERY, REFERENCE, 65.0).tolist() == [[0, 0], [1, 2], [2, 3]]
    assert mutual_pairs(QUERY, REFERENCE, 3.0).tolist() == [[0, 0]]  # nearer than the distance, not as near
    assert mutual_pairs(QUERY, REFERENCE[:0], 25.0).shape == (0, 2)
    assert mutual_pairs(QUERY[:0], REFERENCE, 25.0).shape == (0, 2)


def test_jaccard_by_hand() -> None:
    config = replace(DEFAULT, observable_margin_m=15.0, observable_radius_m=60.0, mnn_distance_m=10.0)
    # Q: 4. R: the first three; (50, 50) is 71 m from every building, (100, 160) 60 m beyond the hull. M: 2.
    assert observable(QUERY, alike(REFERENCE), config).tolist() == [0, 1, 2]
    score, pairs = mnn_jaccard(QUERY, alike(REFERENCE), config)
    assert score == pytest.approx(2 / (4 + 3 - 2)) and pairs.tolist() == [[0, 0], [1, 2]]
    wider = replace(config, observable_radius_m=80.0)
    assert mnn_jaccard(QUERY, alike(REFERENCE), wider)[0] == pytest.approx(2 / (4 + 4 - 2))
    margin = replace(config, observable_margin_m=61.0)
    assert observable(QUERY, alike(REFERENCE), margin).tolist() == [0, 1, 2, 3]


def test_jaccard_at_its_ends() -> None:
    everything = alike(QUERY)
    assert mnn_jaccard(QUERY, everything, DEFAULT)[0] == 1.0
    assert mnn_jaccard(QUERY + 1000.0, everything, DEFAULT)[0] == 0.0
    assert mnn_jaccard(np.empty((0, 2)), everything, DEFAULT)[0] == 0.0


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 40))
def test_jaccard_counts_each_building_once_in_any_order(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    query, reference = rng.uniform(0, 300, (count, 2)), rng.uniform(0, 300, (60, 2))
    score, pairs = mnn_jaccard(query, alike(reference), DEFAULT)
    seen = observable(query, alike(reference), DEFAULT)
    assert 0.0 <= score <= 1.0 and set(pairs[:, 1]) <= set(seen)
    assert score * (count + len(seen) - len(pairs)) == pytest.approx(len(pairs))
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
    order = rng.permutation(60)
    assert mnn_jaccard(query, alike(reference[order]), DEFAULT)[0] == pytest.approx(score)


def test_a_flight_along_an_l_does_not_see_the_inside_of_its_hull() -> None:
    step = np.arange(0.0, 601.0, 30.0)
    flown = np.concatenate([np.column_stack([step, 0 * step]), np.column_stack([0 * step, step])])
    x, y = np.meshgrid(np.arange(-100.0, 700.0, 20.0), np.arange(-100.0, 700.0, 20.0))
    city = np.column_stack([x.ravel(), y.ravel()])
    seen = np.zeros(len(city), dtype=bool)
    seen[observable(flown, alike(city), DEFAULT)] = True
    x, y = city.T
    near_a_leg = (np.minimum(np.abs(x), np.abs(y)) <= 50.0) & (x >= 0) & (y >= 0) & (x + y <= 600.0)
    inside = (x > 80.0) & (y > 80.0)
    outside = (x < -16.0) | (y < -16.0) | (x + y > 600.0 + 15.0 * math.sqrt(2.0) + 1.0)
    assert near_a_leg.sum() > 100 and np.all(seen[near_a_leg])
    assert inside.sum() > 200 and not np.any(seen[inside]) and not np.any(seen[outside])


# A map that bends: 20 degrees over 1,200 m.

CITY = town(81, 5000, 2100.0)
GROUND = alike(CITY.centroids_m)
SEEN = strip(CITY, 1200.0, 60.0)
BENT = bent(SEEN.centroids_m, 20.0, 0.5)
MAP = mapped(BENT)
MIDDLE = np.argsort(np.hypot(*(SEEN.centroids_m - SEEN.centroids_m.mean(axis=0)).T))[:3]
NOWHERE = Similarity((0.0, 0.0), (0.0, 0.0), 0.0)


def grown_score(reference: Ground = GROUND) -> Score:
    ((_, grown),) = grow(MAP, MIDDLE[None], SEEN.centroids_m[MIDDLE][None], reference, DEFAULT)
    return score_grown(NOWHERE, grown, MAP, reference, DEFAULT)


def test_a_grown_match_scores_where_a_rigid_one_does_not() -> None:
    best = fit_similarity(BENT, SEEN.centroids_m, DEFAULT.scale_gate)
    rigid, grown = score_rigid(best, MAP, GROUND, DEFAULT), grown_score()
    assert grown.jaccard > 0.75 and grown.jaccard > rigid.jaccard + 0.2
    assert grown.evidence > 300.0 and grown.evidence > rigid.evidence + 300.0
    assert len(grown.pairs) > 0.9 * len(SEEN) and grown.rms_m < 3.0
    np.testing.assert_allclose(grown.moved_m, SEEN.centroids_m, atol=6.0)
    assert grown.transform.yaw_rad == pytest.approx(best.yaw_rad, abs=0.02)


def test_the_local_transform_holds_where_it_is_asked_for() -> None:
    score = grown_score()
    for share in (0.02, 0.25, 0.5, 0.75, 0.98):
        at = int(share * len(SEEN))
        here = local_transform(score, BENT[at], MAP, GROUND, DEFAULT)
        place = here.apply(BENT[at][None])[0]
        # Jitter of half a metre, and an arc of 300 m that lies 3 m beside its chord.
        assert np.hypot(*(place - SEEN.centroids_m[at])) < 4.0
        # The heading drifts evenly, so a place's share of the length tells the turn there. At the ends the
        # neighbours are all on one side, and what little weight the far ones have pulls.
        along = (SEEN.centroids_m[at, 0] - SEEN.centroids_m[:, 0].min()) / np.ptp(SEEN.centroids_m[:, 0])
        tolerance = 2.0 if 0.2 < share < 0.8 else 5.0
        assert math.degrees(here.yaw_rad) == pytest.approx(20.0 * (0.5 - along), abs=tolerance)
    ends = [np.hypot(*(score.transform.apply(BENT[[i]])[0] - SEEN.centroids_m[i])) for i in (0, -1)]
    assert max(ends) > 10.0  # what one transform makes of the same places


def test_pieces_of_a_torn_match_are_no_rivals_and_a_shifted_one_is() -> None:
    """Ten buildings; a match of the first seven, and others of the same map against it."""
    points = np.array([[30.0 * i, 0.0] for i in range(10)])
    row = mapped(points)
    transform = Similarity((0.0, 0.0), (0.0, 0.0), 0.0)

    def match(rows: list[int], places: list[int], away_m: float) -> Score:
        pairs = np.column_stack([rows, places])
        return Score(transform, points + np.array([0.0, away_m]), pairs, 1.0, 0.5, 50.0)

    def pieces(other: Score) -> bool:
        return pieces_of_one(first, other, row, DEFAULT)

    first = match([*range(7)], [*range(7)], 0.0)
    assert pieces(match([7, 8, 9], [7, 8, 9], 40.0))  # one of three lies at the seam
    assert not pieces(match([*range(6)], [*range(1, 7)], 30.0))  # one house further on
    # The same though the reference lacks so many houses that the two share none of the map's.
    first = match([0, 2, 4, 6], [0, 2, 4, 6], 0.0)
    assert not pieces(match([1, 3, 5], [2, 4, 6], 30.0))
    assert not pieces(match([7, 8, 9], [7, 8, 9], 101.0))
    turned = replace(match([8, 9], [8, 9], 40.0), transform=Similarity((0.0, 0.0), (0.0, 0.0), math.pi))
    assert pieces(match([8, 9], [8, 9], 40.0)) and not pieces(turned)


def test_a_rigid_candidate_has_one_transform_everywhere() -> None:
    score = grown_score()
    assert local_transform(score, BENT[0], MAP, GROUND, PAPER) is score.transform
    few = replace(score, pairs=score.pairs[:2])
    assert local_transform(few, BENT[0], MAP, GROUND, DEFAULT) is score.transform


def candidates(truth: Similarity, spots: FloatArray) -> tuple[Ballot, Hypotheses, np.ndarray]:
    """Hypotheses that lay the map's middle triangle where it belongs, and on triangles near other spots."""
    distances = np.hypot(*(CITY.centroids_m[None] - spots[:, None]).transpose(2, 0, 1))
    others = CITY.centroids_m[np.argsort(distances, axis=1)[:, :3]]
    places = np.concatenate([others, SEEN.centroids_m[MIDDLE][None]])
    centre = BENT.mean(axis=0)
    positions = np.concatenate([spots, truth.apply(centre[None])])
    yaws = np.concatenate([np.linspace(-3.0, 3.0, len(spots)), [truth.yaw_rad]])
    count = len(places)
    weights = np.linspace(2.0, 1.0, count)  # the true one has the fewest votes
    voters = Hypotheses(np.zeros(count, np.int64), places, positions, yaws, np.ones(count), weights, 0, 0)
    return vote(voters, replace(DEFAULT, top_k=100)), voters, MIDDLE[None]


@pytest.mark.parametrize("config", [DEFAULT, PAPER], ids=["grow", "rigid"])
def test_the_true_cluster_is_selected_though_it_has_the_fewest_votes(config: MatcherConfig) -> None:
    truth = fit_similarity(BENT, SEEN.centroids_m, DEFAULT.scale_gate)
    spots = np.random.default_rng(2).uniform(300.0, 1800.0, (15, 2)) + CITY.centroids_m.min(axis=0)
    far = np.hypot(*(spots - SEEN.centroids_m.mean(axis=0)).T) > 250.0
    ballot, voters, corners = candidates(truth, spots[far])
    assert ballot.clusters[-1].votes == 1.0
    ranked = select(ballot, voters, corners, MAP, GROUND, config)
    cluster, score = ranked[0]
    assert cluster == ballot.clusters[-1]
    if config is PAPER:
        assert [s.jaccard for _, s in ranked] == sorted((s.jaccard for _, s in ranked), reverse=True)
        assert len(ranked) == len(ballot.clusters)
    else:
        evidence = [s.evidence for _, s in ranked]
        assert evidence == sorted(evidence, reverse=True) and score.jaccard > 0.7


def test_seeds_that_grow_into_the_same_match_are_one_candidate() -> None:
    truth = fit_similarity(BENT, SEEN.centroids_m, DEFAULT.scale_gate)
    triangles = np.array([MIDDLE, [0, 1, 2], [len(SEEN) - 3, len(SEEN) - 2, len(SEEN) - 1]])
    places = SEEN.centroids_m[triangles]
    # Far apart in votes, as the two ends of a bent map put its middle at different places.
    positions = truth.apply(BENT.mean(axis=0)[None]) + np.array([[0.0, 0.0], [150.0, 0.0], [-150.0, 0.0]])
    voters = Hypotheses(np.arange(3), places, positions, np.zeros(3), np.ones(3), np.ones(3), 0, 0)
    ballot = vote(voters, DEFAULT)
    assert len(ballot.clusters) == 3
    assert len(select(ballot, voters, triangles, MAP, GROUND, DEFAULT)) == 1


def test_without_clusters_there_is_no_candidate() -> None:
    none = np.empty(0)
    nobody = Hypotheses(none.astype(int), np.empty((0, 3, 2)), np.empty((0, 2)), none, none, none, 0, 0)
    for config in (DEFAULT, PAPER):
        assert select(Ballot((), 0, np.empty((0, 2))), nobody, MIDDLE[None], MAP, GROUND, config) == []


def test_a_match_of_fewer_than_three_scores_as_its_cluster() -> None:
    cluster = Cluster(*CITY.centroids_m.mean(axis=0), 0.3, 1.0, 1.0, 1, (0,))
    centre = BENT.mean(axis=0)
    start = Similarity((centre[0], centre[1]), (cluster.x_m, cluster.y_m), 0.3)
    ((_, grown),) = grow(MAP, MIDDLE[None], SEEN.centroids_m[MIDDLE][None], GROUND, DEFAULT)
    lost = replace(grown, matches=np.full_like(grown.matches, -1))
    one, other = score_grown(start, lost, MAP, GROUND, DEFAULT), score_rigid(start, MAP, GROUND, DEFAULT)
    assert one.transform is start and (one.jaccard, one.evidence) == (other.jaccard, other.evidence)


def test_a_seed_moves_from_house_to_house_and_turns_round() -> None:
    x, y = np.meshgrid(np.arange(5) * 25.0, np.arange(5) * 25.0)
    grid = np.column_stack([x.ravel(), y.ravel()])
    seed = np.array([[50.0, 50.0], [75.0, 50.0], [50.0, 75.0]])
    found = {tuple(map(tuple, triangle.tolist())) for triangle in shifted(seed, alike(grid), DEFAULT)}
    beside = ((25.0, 50.0), (50.0, 50.0), (25.0, 75.0))
    round_about = ((50.0, 50.0), (25.0, 50.0), (50.0, 25.0))
    assert {beside, round_about} <= found
    assert all((np.ptp(np.array(triangle), axis=0) == 25.0).all() for triangle in found)
    # In a town without rows hardly any other three houses lie alike.
    town_m = np.random.default_rng(2).uniform(0.0, 800.0, (640, 2))
    middle = town_m[np.argsort(np.hypot(*(town_m - 400.0).T))[:3]]
    assert len(shifted(middle, alike(town_m), DEFAULT)) < 40
