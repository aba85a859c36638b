"""The fast matching against the oracle: the same rows and the same scores, bit for bit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher import oracle
from buildloc_matcher.config import MatcherConfig, matcher_config
from buildloc_matcher.matching import NOTHING, Matches, QueryStars, match_stars
from buildloc_matcher.reference.buildings import concatenate
from buildloc_matcher.reference.database import ReferenceDatabase
from hypothesis import given, settings
from hypothesis import strategies as st
from towns import (
    DEFAULT,
    buildings_at,
    lattice,
    lexington,
    observed,
    reference_stars,
    stars_of,
    tiled,
    town,
    whole,
)

PAPER = matcher_config({"preset": "paper"})
PRESETS = {"default": DEFAULT, "paper": PAPER}
ODD = {
    "narrow": replace(DEFAULT, tau_angle_deg=5.0, tau_perimeter=0.05, tau_shape=0.06),
    "all pass": replace(DEFAULT, tau_angle_deg=180.0, tau_perimeter=0.95, tau_shape=1.0),
    "the best alone": replace(PAPER, matches_per_star=1),
    "more than there are": replace(PAPER, matches_per_star=10_000),
    "areas alone": replace(DEFAULT, area_weight=10.0, score_area=5.0, score_angle_deg=0.1),
    "centre alone": replace(DEFAULT, centre_weight=10.0, score_perimeter=5.0),
    "neighbours alone": replace(DEFAULT, centre_weight=0.1, score_area=0.01, score_perimeter=0.01),
}


def agree(stars: QueryStars, database: ReferenceDatabase, config: MatcherConfig) -> Matches:
    """Match, check against the oracle, and return the matches."""
    found = match_stars(stars, database.tables, config)
    expected = oracle.match_stars(stars, reference_stars(database), config)
    np.testing.assert_array_equal(found.reference, expected.reference)
    np.testing.assert_array_equal(found.score, expected.score)
    assert len(found) <= found.passed <= min(found.tested, expected.passed)
    assert found.tested <= expected.tested == len(stars) * database.stars
    return found


@pytest.mark.parametrize("config", (PRESETS | ODD).values(), ids=(PRESETS | ODD).keys())
def test_random_towns(config: MatcherConfig) -> None:
    found = agree(stars_of(town(2, 60, 300.0)), whole(town(1, 1200, 1300.0)), config)
    assert len(found) > 0


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    angle=st.floats(0.1, 180.0),
    perimeter=st.floats(0.01, 0.95),
    shape=st.floats(0.01, 1.0),
    kept=st.integers(1, 300),
    weights=st.tuples(st.floats(0.0, 10.0), st.floats(0.1, 10.0)),
)
def test_any_towns_and_any_tolerances(
    seed: int, angle: float, perimeter: float, shape: float, kept: int, weights: tuple[float, float]
) -> None:
    config = replace(
        DEFAULT, tau_angle_deg=angle, tau_perimeter=perimeter, tau_shape=shape, score_angle_deg=angle,
        score_perimeter=perimeter, matches_per_star=kept, area_weight=weights[0], centre_weight=weights[1],
    )  # fmt: skip
    agree(stars_of(town(seed, 20, 160.0)), whole(town(seed + 1, 300, 600.0)), config)


@pytest.mark.parametrize("config", PRESETS.values(), ids=PRESETS.keys())
def test_on_a_lattice_the_lower_number_wins_every_tie(config: MatcherConfig) -> None:
    database = whole(lattice(14, 14))
    found = agree(stars_of(lattice(6, 5)), database, config)
    # Every triangle is the same one, and all have the same neighbours: each query star meets only ties.
    assert np.all(found.score == found.score[0, 0]) and found.score[0, 0] == pytest.approx(1.0)
    assert np.all(np.diff(found.reference, axis=1) > 0)


@pytest.mark.parametrize("config", PRESETS.values(), ids=PRESETS.keys())
@pytest.mark.parametrize("size_m", [400.0, 900.0])
def test_tiles_are_numbered_through(config: MatcherConfig, size_m: float) -> None:
    both = concatenate([town(1, 900, 1100.0), lattice(9, 9)])
    database = tiled(both, size_m, config)
    assert len(database.tables) >= 4 and all(table.first > 0 for table in database.tables[1:])
    query = concatenate([town(2, 40, 250.0), lattice(5, 4)])
    found = agree(stars_of(query), database, config)
    tile = np.searchsorted([table.first for table in database.tables], found.reference, side="right")
    assert len(np.unique(tile[found.reference != NOTHING])) >= 4  # matches come from many tiles


@pytest.mark.parametrize(
    ("areas_m2", "side_m"),
    [((20_000.0, 90_000.0), 1300.0), ((0.5, 20.0), 1300.0), ((25.0, 400.0), 30.0)],
    ids=["halls", "sheds", "closer than a metre"],
)
@pytest.mark.parametrize("config", PRESETS.values(), ids=PRESETS.keys())
def test_sizes_beyond_the_ends_of_the_sketches(
    config: MatcherConfig, areas_m2: tuple[float, float], side_m: float
) -> None:
    config = replace(config, min_area_m2=0.0, matches_per_star=10)
    query = town(2, 60, side_m / 5.0, areas_m2)
    assert len(agree(stars_of(query), whole(town(1, 1200, side_m, areas_m2), config), config)) > 100


def test_the_order_of_tables_does_not_matter() -> None:
    database, stars = tiled(town(1, 900, 1100.0), 500.0), stars_of(town(2, 40, 250.0))
    forth = match_stars(stars, database.tables, DEFAULT)
    back = match_stars(stars, database.tables[::-1], DEFAULT)
    np.testing.assert_array_equal(forth.reference, back.reference)
    np.testing.assert_array_equal(forth.score, back.score)


@pytest.mark.data
@pytest.mark.parametrize("name", PRESETS)
def test_flights_over_lexington(name: str) -> None:
    city, config = lexington(3000.0), PRESETS[name]
    databases = whole(city, config), tiled(city, 2000.0, config)
    assert databases[0].stars == databases[1].stars > 20_000
    for seed, level in enumerate((1, 2)):
        stars = stars_of(observed(city, 60, level, seed).local_map)
        one, other = (agree(stars, database, config) for database in databases)
        np.testing.assert_array_equal(one.score, other.score)
        assert one.tested < 0.5 * len(stars) * databases[0].stars  # the index leaves most pairs out


def test_the_score_is_that_of_the_paper() -> None:
    """Eq. 1 and 2 word for word, one pair at a time, in double precision."""
    query, reference = stars_of(town(2, 25, 180.0)), whole(town(1, 300, 600.0), PAPER)
    found = match_stars(query, reference.tables, replace(PAPER, matches_per_star=10_000))
    theirs = reference_stars(reference).features.astype(np.float64)
    tau = math.radians(15.0)

    def terms(q: np.ndarray, r: np.ndarray) -> tuple[float, float, float]:
        angles = np.abs([q[0] - r[0], q[1] - r[1], q[0] + q[1] - r[0] - r[1]]).sum()
        return angles, abs(q[3] - r[3]) / max(q[3], r[3]), np.abs(q[4:] - r[4:]).mean()

    for s, star in enumerate(query.features.astype(np.float64)):
        expected = {}
        for row, other in enumerate(theirs):
            d_angle, d_perimeter, d_shape = terms(star[0], other[0])
            if d_angle >= tau or d_perimeter > 0.3 or d_shape > 0.3:
                continue
            agreement = []
            for q, r in zip(star, other, strict=True):
                d_angle, d_perimeter, d_shape = terms(q, r)
                agreement.append(
                    (2.0 * max(0.0, 1.0 - d_angle / tau) + 1.0 - d_perimeter + 1.0 - d_shape) / 4.0
                )
            expected[row] = sum(agreement) / 4.0
        rows = found.reference[s][found.reference[s] != NOTHING]
        assert set(rows) == expected.keys()
        # Single precision, 32 terms.
        np.testing.assert_allclose(found.score[s, : len(rows)], [expected[row] for row in rows], atol=2e-5)


def test_areas_count_in_the_default_score_by_hand() -> None:
    points = town(3, 12, 120.0).centroids_m
    one = buildings_at(points, 1)
    other = replace(one, areas_m2=np.float32(0.8) * one.areas_m2)
    best = match_stars(stars_of(other), whole(one).tables, replace(DEFAULT, matches_per_star=1))
    # Geometry and shapes agree. Every area is smaller by 20 % of the larger: 1 - 0.2 / 0.45 of weight 3,
    # beside the 4 of Eq. 2, in all four triangles.
    assert len(best) > 3
    np.testing.assert_allclose(best.score, (4.0 + 3.0 * (1.0 - 0.2 / 0.45)) / 7.0, atol=1e-5)


def test_without_stars_or_tables_there_is_nothing() -> None:
    none = stars_of(town(1, 2, 100.0))
    assert len(none) == len(match_stars(none, whole(town(1, 90, 400.0)).tables, DEFAULT)) == 0
    found = match_stars(stars_of(town(2, 40, 250.0)), (), DEFAULT)
    assert np.all(found.reference == NOTHING) and (found.tested, found.passed) == (0, 0)
