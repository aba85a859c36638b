"""The online cache: after every step of a growing map the answer is that of a full match."""

from __future__ import annotations

import numpy as np
import pytest
from buildloc_matcher.config import matcher_config
from buildloc_matcher.match_cache import MatchCache
from buildloc_matcher.matcher import Matcher, MatchResult
from buildloc_matcher.matching import match_stars
from buildloc_matcher.mesh import mesh
from buildloc_msgs_py.types import LocalMap
from towns import first_rows, observed, tiled, town, whole

CITY = town(41, 5000, 2100.0)
REFERENCE = tiled(CITY, 900.0)
FLIGHT = observed(CITY, 90, 1, 5).local_map
STEPS = range(3, 91, 3)
NEW_WORK = {"stars_matched_anew", "pairs_tested", "pairs_passed"}  # what the cache spares


@pytest.mark.parametrize("thinnings", [0, 2])
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_every_step_equals_a_full_match(preset: str, thinnings: int) -> None:
    config = matcher_config({"preset": preset})
    cache = MatchCache(REFERENCE.tables, config)
    known: set[bytes] = set()
    anew = total = 0
    for count in STEPS:
        seen = first_rows(FLIGHT, count)
        stars = mesh(seen.centroids_m, seen.areas_m2, seen.shapes, thinnings).stars
        found, expected = cache.match(stars), match_stars(stars, REFERENCE.tables, config)
        np.testing.assert_array_equal(found.reference, expected.reference)
        np.testing.assert_array_equal(found.score, expected.score)
        names = [f.tobytes() + a.tobytes() for f, a in zip(stars.features, stars.areas_m2, strict=True)]
        new = [row for row, name in enumerate(names) if name not in known]
        assert cache.matched_anew == len(new)
        alone = match_stars(stars.select(np.array(new, dtype=int)), REFERENCE.tables, config)
        assert (found.tested, found.passed) == (alone.tested, alone.passed)
        known = set(names)
        anew, total = anew + len(new), total + len(stars)
    assert anew < 0.4 * total  # a step changes the stars at the growing end


def test_an_unchanged_map_is_not_matched_again_and_a_lost_star_is_forgotten() -> None:
    config = matcher_config()
    cache = MatchCache(REFERENCE.tables, config)
    stars = mesh(FLIGHT.centroids_m, FLIGHT.areas_m2, FLIGHT.shapes).stars
    first = cache.match(stars)
    assert cache.matched_anew == len(stars) > 50
    backwards = np.arange(len(stars))[::-1]
    again = cache.match(stars.select(backwards))
    assert cache.matched_anew == again.tested == again.passed == 0
    np.testing.assert_array_equal(again.reference, first.reference[::-1])
    cache.match(stars.select(np.arange(10)))
    assert cache.matched_anew == 0
    cache.match(stars)
    assert cache.matched_anew == len(stars) - 10
    assert len(cache.match(stars.select(np.arange(0)))) == 0


def same(one: MatchResult, other: MatchResult) -> bool:
    """Whether two results are equal, all but the work that was spared."""
    if one.candidates != other.candidates or len(one.scores) != len(other.scores):
        return False
    for a, b in zip(one.scores, other.scores, strict=True):
        if a.transform != b.transform or (a.jaccard, a.evidence, a.rms_m) != (b.jaccard, b.evidence, b.rms_m):
            return False
        if not (np.array_equal(a.pairs, b.pairs) and np.array_equal(a.moved_m, b.moved_m)):
            return False
    figures = [{n: v for n, v in r.funnel.items() if n not in NEW_WORK} for r in (one, other)]
    return figures[0] == figures[1]


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_used_matcher_answers_as_a_fresh_one(preset: str) -> None:
    config = matcher_config({"preset": preset})
    database = whole(CITY)
    used = Matcher(database, config)
    other = observed(CITY, 60, 2, 6).local_map
    maps: list[LocalMap] = []
    for count in range(6, 91, 12):
        maps += [first_rows(FLIGHT, count)]
    maps += [other, first_rows(FLIGHT, 40)]  # another flight in between
    fixed = 0
    for seen in maps:
        found, expected = used.locate(seen), Matcher(database, config).locate(seen)
        assert same(found, expected) and used.judge(found).reason == used.judge(expected).reason
        assert found.funnel["stars_matched_anew"] <= expected.funnel["stars_matched_anew"]
        fixed += used.judge(found).reason is None
    again = used.locate(maps[-1])
    assert again.funnel["stars_matched_anew"] == again.funnel["pairs_tested"] == 0
    assert fixed > 0
