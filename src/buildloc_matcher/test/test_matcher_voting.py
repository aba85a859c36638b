"""Votes in bins (Eq. 3) and clusters of one heading, by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.hypotheses import Hypotheses
from buildloc_matcher.voting import vote
from hypothesis import given, settings
from hypothesis import strategies as st

CONFIG = MatcherConfig(bin_size_m=100.0, rotation_tolerance_deg=10.0, min_votes=1, top_k=10)


def hypotheses(*rows: tuple[float, float, float, float], scale: float = 1.0) -> Hypotheses:
    """Of (x, y, yaw in degrees, weight) each."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    count = len(table)
    return Hypotheses(
        np.arange(count), np.zeros((count, 3, 2)), np.ascontiguousarray(table[:, :2]),
        np.radians(table[:, 2]), np.full(count, scale), np.ascontiguousarray(table[:, 3]), 0, 0,
    )  # fmt: skip


def test_a_bin_reaches_half_its_size_around_whole_multiples() -> None:
    three_bins = hypotheses(
        (-49, 0, 0, 0.5), (49, 49, 0, 0.7), (0, -49, 0, 0.1),
        (51, 0, 0, 0.9), (149, 49, 0, 1.0), (0, 151, 0, 2.0),
    )  # fmt: skip
    ballot = vote(three_bins, CONFIG)
    assert (ballot.bins, ballot.consistent) == (3, 3)
    assert [(c.votes, c.members) for c in ballot.clusters] == [
        (2.0, 1),
        (pytest.approx(1.9), 2),
        (pytest.approx(1.3), 3),
    ]
    assert [c.seeds for c in ballot.clusters] == [(5,), (4, 3), (1, 0, 2)]


def test_a_cluster_is_the_mean_weighted_by_votes() -> None:
    found = hypotheses((0, 0, -4, 1.0), (30, 10, 2, 3.0))
    found = replace(found, scales=np.array([0.9, 1.1]))
    (cluster,) = vote(found, CONFIG).clusters
    assert (cluster.x_m, cluster.y_m) == pytest.approx((22.5, 7.5))
    mean = math.atan2(
        3 * math.sin(math.radians(2)) + math.sin(math.radians(-4)),
        3 * math.cos(math.radians(2)) + math.cos(math.radians(-4)),
    )
    assert cluster.yaw_rad == pytest.approx(mean) and cluster.scale == pytest.approx(1.05)
    assert (cluster.votes, cluster.members, cluster.seeds) == (4.0, 2, (1, 0))


def test_other_headings_in_the_same_place_do_not_count() -> None:
    (cluster,) = vote(
        hypotheses((0, 0, 0, 1.0), (0, 0, 9, 1.0), (0, 0, -9, 1.0), (20, 0, 90, 2.5), (0, 0, 91, 0.1)), CONFIG
    ).clusters
    # Around 0 degrees three weigh 3; the two around 90 weigh 2.6.
    assert (cluster.votes, cluster.members) == (3.0, 3) and cluster.yaw_rad == pytest.approx(0.0, abs=1e-12)
    (heavier,) = vote(hypotheses((0, 0, 0, 1.0), (0, 0, 5, 1.0), (20, 0, 90, 2.5)), CONFIG).clusters
    assert (heavier.votes, heavier.members, heavier.seeds, heavier.x_m) == (2.5, 1, (2,), 20.0)


def test_headings_wrap_around() -> None:
    rows = [(0, 0, 179, 1.0), (0, 0, -178, 1.0), (0, 0, 175, 1.0), (0, 0, -5, 2.0)]
    (cluster,) = vote(hypotheses(*rows), CONFIG).clusters
    assert (cluster.votes, cluster.members) == (3.0, 3)
    assert math.degrees(cluster.yaw_rad) == pytest.approx(178.667, abs=0.001)
    # 6 degrees from one another over the seam, but 354 on the number line.
    (pair,) = vote(hypotheses((0, 0, 177, 1.0), (0, 0, -177, 1.0)), CONFIG).clusters
    assert pair.members == 2 and abs(math.degrees(pair.yaw_rad)) == pytest.approx(180.0)
    # The two over the seam outweigh one that is heavier than either.
    (heaviest,) = vote(hypotheses((0, 0, 177, 1.0), (0, 0, -177, 1.0), (0, 0, 90, 1.5)), CONFIG).clusters
    assert (heaviest.votes, heaviest.members) == (2.0, 2)


@settings(max_examples=60, deadline=None)
@given(turn=st.floats(-360.0, 360.0), seed=st.integers(0, 1000))
def test_turning_all_headings_turns_the_clusters(turn: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = np.column_stack(
        [rng.uniform(-160, 160, (40, 2)), rng.uniform(-180, 180, 40), rng.uniform(0.1, 1.0, 40)]
    )
    turned = np.add(rows, (0.0, 0.0, turn, 0.0))
    one, other = (vote(hypotheses(*map(tuple, r)), CONFIG) for r in (rows, turned))
    assert (one.bins, one.consistent) == (other.bins, other.consistent)
    for a, b in zip(one.clusters, other.clusters, strict=True):
        assert (a.members, a.seeds) == (b.members, b.seeds)
        assert (a.x_m, a.y_m, a.votes) == pytest.approx((b.x_m, b.y_m, b.votes))
        assert math.remainder(b.yaw_rad - a.yaw_rad - math.radians(turn), 2.0 * math.pi) == pytest.approx(
            0.0, abs=1e-9
        )


def test_fewest_votes_and_the_number_listed() -> None:
    found = hypotheses(*[(100.0 * i, 0.0, 0.0, 1.0) for i in range(5) for _ in range(i + 1)])
    ballot = vote(found, replace(CONFIG, min_votes=3, top_k=2))
    assert (ballot.bins, ballot.consistent) == (5, 3)
    assert [(c.x_m, c.members) for c in ballot.clusters] == [(400.0, 5), (300.0, 4)]
    assert ballot.places_m.tolist() == [[400.0, 0.0], [300.0, 0.0], [200.0, 0.0]]


def test_ties_are_ranked_from_west_and_south_whatever_the_order() -> None:
    rows = [(200.0, 0.0, 0.0, 1.0), (-100.0, 300.0, 0.0, 1.0), (-100.0, 0.0, 0.0, 1.0)]
    for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0)):
        clusters = vote(hypotheses(*[rows[i] for i in order]), CONFIG).clusters
        assert [(c.x_m, c.y_m) for c in clusters] == [(-100.0, 0.0), (-100.0, 300.0), (200.0, 0.0)]
        assert [rows[order[c.seeds[0]]][:2] for c in clusters] == [(c.x_m, c.y_m) for c in clusters]


def test_no_hypothesis_is_no_bin() -> None:
    ballot = vote(hypotheses(), CONFIG)
    assert (ballot.clusters, ballot.bins, ballot.consistent) == ((), 0, 0)
