"""The whole matcher: noisy maps are located, the wrong town gives no fix, and bad maps end in words."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.acceptance import Outcome
from buildloc_matcher.config import MatcherConfig, matcher_config
from buildloc_matcher.geometry import rotation
from buildloc_matcher.local_map import MapError
from buildloc_matcher.matcher import MOST_STARS, Matcher
from buildloc_msgs_py.types import Fix, FloatArray, FrameObservation, Keyframe, LocalMap, NoFix
from towns import (
    DEFAULT,
    UTM,
    Buildings,
    buildings_at,
    first_rows,
    lattice,
    local_map,
    observed,
    tiled,
    town,
    whole,
)

PAPER = matcher_config({"preset": "paper"})
TOWN, WRONG_TOWN = town(101, 6000, 2400.0), town(102, 6000, 2400.0)  # a building every 31 m
HERE, ELSEWHERE = whole(TOWN), whole(WRONG_TOWN)
HERE_BY_PAPER = whole(TOWN, PAPER)
SECOND = 10**9


@pytest.mark.parametrize("count", [60, 100])
@pytest.mark.parametrize("seed", range(6))
def test_a_noisy_map_is_located_within_5_m(seed: int, count: int) -> None:
    """Two digitisers, 12 % missed, 8 % invented, jitter of 1.2 m and drift: level 1 of the benchmark."""
    seen = observed(TOWN, count, 1, seed)
    matcher = Matcher(HERE, DEFAULT)
    found = matcher.locate(seen.local_map)
    assert matcher.judge(found).reason is None
    best = found.candidates[0]
    assert math.hypot(best.x_m - seen.centre_m[0], best.y_m - seen.centre_m[1]) < 5.0
    # The map is the world seen at this scale and heading, so any two far buildings tell the yaw.
    assert best.scale == pytest.approx(1.0, abs=0.05) and best.acceptance > 30.0
    assert [c.acceptance for c in found.candidates] == sorted(
        (c.acceptance for c in found.candidates), reverse=True
    )
    at = seen.local_map.centroids_m[0]
    place = matcher.place(found, at).apply(at[None])[0]
    # One building, with its own jitter, at the end of a map that has drifted.
    assert np.hypot(*(place - seen.true_m[0])) < 12.0


def test_cut_buildings_are_left_out() -> None:
    seen = observed(TOWN, 60, 1, 0).local_map
    cut = np.arange(60) % 5 == 0
    found = Matcher(HERE, DEFAULT).locate(replace(seen, cut=cut))
    without = Matcher(HERE, DEFAULT).locate(seen.select(~cut))
    assert found.candidates == without.candidates and found.funnel["buildings"] == 48


@pytest.mark.parametrize("seed", range(6))
def test_the_wrong_town_gives_no_fix_and_says_why(seed: int) -> None:
    seen = observed(TOWN, 60, 1, seed)
    for config in (DEFAULT, PAPER):
        matcher = Matcher(whole(WRONG_TOWN, config), config)
        verdict = matcher.judge(matcher.locate(seen.local_map))
        # The best of all wrong places has odds of about 1 to 1: e^5 to 1 comes up once in 150 maps.
        assert verdict.outcome is not Outcome.ACCEPTED and verdict.score < 5.0
        assert verdict.reason is not None and "\n" not in verdict.reason
        if verdict.outcome is Outcome.REJECTED:
            assert "no more than chance" in verdict.reason or "no candidate" in verdict.reason
        else:
            assert "nats, below the" in verdict.reason
    answer = Matcher(ELSEWHERE, DEFAULT).fix(seen.local_map, [Keyframe(0, 0.0, 0.0, 0.0)], [])
    assert isinstance(answer.result, NoFix) and answer.result.reason


def test_the_paper_preset_locates_a_map_that_does_not_bend() -> None:
    city = local_map(TOWN)
    middle = TOWN.centroids_m.mean(axis=0)
    rows = np.flatnonzero(np.hypot(*(TOWN.centroids_m - middle).T) < 180.0)
    rng = np.random.default_rng(1)
    points = (TOWN.centroids_m[rows] - middle) @ rotation(2.0).T + rng.normal(0.0, 1.0, (len(rows), 2))
    seen = LocalMap.whole(0, rows, points, city.areas_m2[rows], city.shapes[rows], np.ones_like(rows))
    matcher = Matcher(HERE_BY_PAPER, PAPER)
    found = matcher.locate(seen)
    assert matcher.judge(found).reason is None and len(found.candidates) == PAPER.top_k
    at = points.mean(axis=0)
    expected = at @ rotation(2.0) + middle
    place = matcher.place(found, at).apply(at[None])[0]
    # The mean of the hypotheses in a bin, each from one triangle with a jitter of 1 m.
    assert np.hypot(*(place - expected)) < 5.0
    assert matcher.place(found, at).yaw_rad == pytest.approx(-2.0, abs=0.05)


def test_tiles_give_the_answer_of_one_piece() -> None:
    seen = observed(TOWN, 60, 1, 3).local_map
    one, many = (Matcher(d, DEFAULT).locate(seen) for d in (HERE, tiled(TOWN, 900.0)))
    assert [c.x_m for c in one.candidates] == pytest.approx([c.x_m for c in many.candidates], abs=1e-6)
    assert one.candidates[0].acceptance == pytest.approx(many.candidates[0].acceptance)


def test_the_funnel_counts_what_came_of_the_stars() -> None:
    matcher = Matcher(HERE, DEFAULT)
    for seed, level in ((1, 1.0), (2, 3.0)):
        found = matcher.locate(observed(TOWN, 60, level, seed).local_map)
        f = found.funnel
        assert 50 < f["buildings"] <= 60 and f["looks"] in (1, 2)  # some seem smaller than 20 m2
        assert f["stars_matched_anew"] == f["stars"] > 0 and (
            f["looks"] == 2 or f["stars"] <= DEFAULT.max_stars
        )
        assert f["pairs_tested"] >= f["pairs_passed"] >= f["matches"]
        assert f["matches"] == f["mirrored"] + f["off_scale"] + f["hypotheses"]
        assert f["hypotheses"] >= f["voters"] >= f["bins"] >= f["clusters"] >= f["rescored"]
        assert f["rescored"] >= len(found.candidates) == len(found.scores)
        assert found.seconds.keys() == {"describe", "match", "hypothesize", "vote", "select"}
        assert all(seconds >= 0.0 for seconds in found.seconds.values())


def test_a_second_look_finds_what_the_first_does_not() -> None:
    once = replace(DEFAULT, second_look=0)
    gained = 0
    for seed in range(10):
        seen = observed(TOWN, 40, 2, seed).local_map
        first, both = (Matcher(HERE, config) for config in (once, DEFAULT))
        found, better = first.locate(seen), both.locate(seen)
        if first.judge(found).reason is None:
            assert better.funnel["looks"] == 1 and better.candidates == found.candidates
        else:
            assert better.funnel["looks"] == 2 and better.funnel["stars"] > found.funnel["stars"]
            gained += both.judge(better).reason is None
    assert gained > 0


# A flight with its frames, to a fix.


def flight(seed: int) -> tuple[LocalMap, list[Keyframe], list[FrameObservation], FloatArray, float]:
    """A map of 800 m, its poses, what the frames saw; true last position and heading."""
    rng = np.random.default_rng(seed)
    middle = TOWN.centroids_m.mean(axis=0)
    path = middle + np.column_stack([np.linspace(-400.0, 400.0, 25), np.linspace(-150.0, 200.0, 25)])
    yaw = float(rng.uniform(-math.pi, math.pi))
    turn = rotation(-yaw)
    apart = np.hypot(*(TOWN.centroids_m[:, None] - path[None]).transpose(2, 0, 1)).min(axis=1)
    near = np.flatnonzero((apart < 90.0) & (rng.random(len(TOWN)) > 0.1))
    points = (TOWN.centroids_m[near] - path[0]) @ turn.T + rng.normal(0.0, 0.8, (len(near), 2))
    poses = [
        Keyframe((i + 1) * SECOND, float(x), float(y), 0.1 * i)
        for i, (x, y) in enumerate((path - path[0]) @ turn.T)
    ]
    seen = []
    for pose, place in zip(poses, path, strict=True):
        level = (TOWN.centroids_m - place) @ rotation(pose.yaw_rad + yaw)
        level = level[np.hypot(*level.T) < 90.0]
        seen.append(FrameObservation(pose.stamp_ns, level + rng.normal(0.0, 0.8, level.shape), 105.0))
    shapes = np.clip(TOWN.shapes[near] + rng.normal(0.0, 0.03, (len(near), 4)), 0.0, 1.0)
    areas = TOWN.areas_m2[near].astype(np.float64)
    seen_map = LocalMap.whole(poses[-1].stamp_ns, near, points, areas, shapes, np.full(len(near), 3))
    return seen_map, poses, seen, path[-1], poses[-1].yaw_rad + yaw


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("seed", range(3))
def test_a_flight_ends_in_a_fix(seed: int, preset: str) -> None:
    config = matcher_config({"preset": preset})
    seen_map, poses, seen, last, yaw = flight(seed)
    matcher = Matcher(whole(TOWN, config), config)
    answer = matcher.fix(seen_map, poses, seen)
    assert isinstance(answer.result, Fix), answer.result
    fix = answer.result
    assert math.hypot(fix.easting_m - last[0], fix.northing_m - last[1]) < 5.0
    assert math.remainder(fix.yaw_rad - yaw, 2.0 * math.pi) == pytest.approx(0.0, abs=math.radians(1.5))
    assert (fix.stamp_ns, fix.altitude_m) == (seen_map.stamp_ns, 105.0)
    back = matcher.database.to_wgs84(fix.easting_m, fix.northing_m)
    assert (fix.latitude_deg, fix.longitude_deg) == back
    # Honest: the error is within three of the standard deviations reported.
    sigma = math.sqrt(fix.covariance_enu_m2[0, 0])
    assert math.hypot(fix.easting_m - last[0], fix.northing_m - last[1]) < 3.0 * sigma
    assert {"refine_observed", "refine_pairs", "match_seconds"} <= answer.funnel.keys()


def test_a_flight_without_frames_or_poses_has_no_fix() -> None:
    seen_map, poses, seen, *_ = flight(1)
    matcher = Matcher(HERE, DEFAULT)
    for arguments, text in (
        (([], seen), "no keyframes yet"),
        ((poses, []), "refinement found no buildings"),
        ((poses, [replace(s, stamp_ns=s.stamp_ns + 1) for s in seen]), "refinement found no buildings"),
    ):
        answer = matcher.fix(seen_map, *arguments)
        assert isinstance(answer.result, NoFix) and text in answer.result.reason
        assert answer.result.stamp_ns == seen_map.stamp_ns and answer.candidates


def beyond_the_town(metres: float) -> tuple[LocalMap, list[Keyframe], list[FrameObservation], FloatArray]:
    """The flight goes on, straight ahead in the axes of the map, over ground without a building."""
    seen_map, poses, seen, last, _ = flight(1)
    here, before = poses[-1], poses[-2]
    step = np.array([here.x_m - before.x_m, here.y_m - before.y_m])
    more = int(metres / np.hypot(*step))
    later = [
        replace(here, stamp_ns=here.stamp_ns + (i + 1) * SECOND, x_m=here.x_m + x, y_m=here.y_m + y)
        for i, (x, y) in enumerate((np.arange(more)[:, None] + 1.0) * step)
    ]
    nothing = [FrameObservation(k.stamp_ns, np.empty((0, 2)), 105.0) for k in later]
    path = np.array([800.0, 350.0]) / 24.0  # of a step, in the world
    return replace(seen_map, stamp_ns=later[-1].stamp_ns), poses + later, seen + nothing, last + more * path


def test_a_flight_that_has_left_the_match_is_carried_on_with_growing_uncertainty() -> None:
    sigmas = []
    for metres in (0.0, 200.0, 450.0, 600.0):
        seen_map, poses, seen, last = flight(1)[:4] if metres == 0.0 else beyond_the_town(metres)
        answer = Matcher(HERE, DEFAULT).fix(seen_map, poses, seen)
        assert isinstance(answer.result, Fix), answer.result
        error = math.hypot(answer.result.easting_m - last[0], answer.result.northing_m - last[1])
        sigmas.append(math.sqrt(np.linalg.eigvalsh(answer.result.covariance_enu_m2[:2, :2])[-1]))
        assert error < 3.0 * sigmas[-1] and answer.result.stamp_ns == poses[-1].stamp_ns
    assert sigmas == sorted(sigmas) and sigmas[-1] > 450.0 * DEFAULT.drift_share > sigmas[0]
    seen_map, poses, seen, _ = beyond_the_town(1200.0)
    answer = Matcher(HERE, DEFAULT).fix(seen_map, poses, seen)
    assert isinstance(answer.result, NoFix)
    assert "the match ends before the flight: flew" in answer.result.reason


def test_a_flight_that_goes_on_over_other_ground_than_the_reference_has_is_contradicted() -> None:
    seen_map, poses, seen, last = beyond_the_town(600.0)
    step = np.array([800.0, 350.0]) / 24.0
    beyond = len(poses) - 25
    other = []
    for number, observation in enumerate(seen):
        if number >= 25:
            place = last - (beyond - 1 - (number - 25)) * step
            level = WRONG_TOWN.centroids_m - place
            level = level[np.hypot(*level.T) < 90.0]
            observation = replace(observation, centroids_m=level)
        other.append(observation)
    answer = Matcher(HERE, DEFAULT).fix(seen_map, poses, other)
    assert isinstance(answer.result, NoFix)
    assert "the match ends before the flight: the reference has not what was seen" in answer.result.reason


@pytest.mark.parametrize("frames", [4, 8])
def test_the_end_of_a_flight_must_not_fit_better_near_by(frames: int) -> None:
    """The path of the mapper slips by 15 m before the last keyframes: most of the window lies right, and what
    the latest frames saw lies 15 m beside where they put it."""
    seen_map, poses, seen, *_ = flight(1)
    right = (25 - frames) * SECOND
    slipped = [k if k.stamp_ns <= right else replace(k, y_m=k.y_m + 15.0) for k in poses]
    answer = Matcher(HERE, DEFAULT).fix(seen_map, slipped, seen)
    assert isinstance(answer.result, NoFix)
    assert "the latest frames fit elsewhere: lead -" in answer.result.reason
    assert {"end_nats", "end_lead", "end_buildings"} <= answer.funnel.keys()


def test_the_end_of_a_flight_must_fit_by_itself() -> None:
    """Of what the latest frames saw most is nowhere in the reference, and lies nowhere near by better."""
    seen_map, poses, seen, *_ = flight(1)
    rng = np.random.default_rng(1)
    mixed = [
        one if one.stamp_ns <= 17 * SECOND else replace(
            one, centroids_m=np.concatenate([one.centroids_m[::4], rng.uniform(-80.0, 80.0, (20, 2))])
        )
        for one in seen
    ]  # fmt: skip
    answer = Matcher(HERE, DEFAULT).fix(seen_map, poses, mixed)
    assert isinstance(answer.result, NoFix)
    assert "the latest frames fit loosely: -" in answer.result.reason


def test_only_rivals_have_to_be_led() -> None:
    matcher = Matcher(HERE, DEFAULT)
    found = matcher.locate(observed(TOWN, 60, 1, 0).local_map)
    best = found.candidates[0]
    other = replace(best, x_m=best.x_m + 50.0)
    assert matcher.judge(replace(found, candidates=(best, other), rivals=())).outcome is Outcome.ACCEPTED
    ambiguous = matcher.judge(replace(found, candidates=(best, other), rivals=(other,)))
    assert ambiguous.outcome is Outcome.UNDECIDED and "leads another place by 0.0" in (ambiguous.reason or "")


# Bad maps


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 8, 11])
@pytest.mark.parametrize("config", [DEFAULT, PAPER], ids=["default", "paper"])
def test_small_maps_say_why_there_is_no_fix(count: int, config: MatcherConfig) -> None:
    matcher = Matcher(whole(TOWN, config), config)
    some = first_rows(local_map(TOWN), count)
    found = matcher.locate(some)
    assert matcher.judge(found).reason == f"undecided: map has {count} buildings, fewer than 12"
    assert found.funnel["buildings"] == count and (count > 3 or not found.candidates)
    answer = matcher.fix(some, [Keyframe(0, 0.0, 0.0, 0.0)], [])
    assert isinstance(answer.result, NoFix) and "fewer than 12" in answer.result.reason


def test_sheds_do_not_count() -> None:
    sheds = replace(local_map(TOWN), areas_m2=np.full(len(TOWN), 19.0))
    matcher = Matcher(HERE, DEFAULT)
    assert matcher.judge(matcher.locate(sheds)).reason == "undecided: map has 0 buildings, fewer than 12"


LINE = np.outer(np.arange(40.0), [25.0, 3.0])
DEGENERATE = {
    "on a line": LINE,
    "in one place": np.zeros((40, 2)),
    "in two places": np.repeat([[0.0, 0.0], [50.0, 0.0]], 20, axis=0),
    "on a line, each twice": np.repeat(LINE[:20], 2, axis=0),
    "far apart": LINE**2,
}


@pytest.mark.parametrize("points", DEGENERATE.values(), ids=DEGENERATE.keys())
@pytest.mark.parametrize("config", [DEFAULT, PAPER], ids=["default", "paper"])
def test_maps_without_a_pattern_have_no_candidate(points: FloatArray, config: MatcherConfig) -> None:
    matcher = Matcher(whole(TOWN, config), config)
    found = matcher.locate(local_map(buildings_at(points, 1)))
    assert found.funnel["stars"] == 0
    assert matcher.judge(found).outcome is not Outcome.ACCEPTED
    if config is PAPER:  # which does not try pairs
        assert found.candidates == ()
        assert "no candidate" in (matcher.judge(found).reason or "")


def test_duplicates_do_no_harm() -> None:
    seen = observed(TOWN, 80, 1, 2)
    twice = np.repeat(np.arange(80), 2)
    m = seen.local_map
    doubled = LocalMap.whole(
        0, np.arange(160), m.centroids_m[twice], m.areas_m2[twice], m.shapes[twice], np.ones(160, int)
    )
    matcher = Matcher(HERE, DEFAULT)
    found = matcher.locate(doubled)
    best = found.candidates[0]
    # Half of the buildings cannot be matched: that keeps it from a fix, and its place within a house or two.
    assert math.hypot(best.x_m - seen.centre_m[0], best.y_m - seen.centre_m[1]) < 20.0


@pytest.mark.parametrize("west", [0, 8, 18])
def test_a_regular_pattern_is_nowhere_and_everywhere(west: int) -> None:
    grid = lattice(30, 30)
    column, row = np.divmod(np.arange(900), 30)
    block = grid.select(np.flatnonzero((column >= west) & (column < west + 12) & (row >= 8) & (row < 20)))
    matcher = Matcher(whole(grid), DEFAULT)
    reason = matcher.judge(matcher.locate(local_map(block))).reason
    # It fits in 19 x 19 places and four headings; near the edge, where chance is rarer, a little better.
    assert reason is not None and "leads another place by" in reason


@pytest.mark.parametrize("name", ["centroids_m", "areas_m2", "shapes"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_figures_that_are_no_numbers_are_said(name: str, value: float) -> None:
    seen = first_rows(local_map(TOWN), 30)
    values = getattr(seen, name).copy()
    values[[3, 7]] = value
    with pytest.raises(MapError, match=r"2 buildings of the map have .* that are not numbers") as error:
        Matcher(HERE, DEFAULT).locate(replace(seen, **{name: values}))
    assert "\n" not in str(error.value)


def test_a_map_in_degrees_is_said() -> None:
    seen = first_rows(local_map(TOWN), 30)
    degrees = replace(seen, centroids_m=seen.centroids_m / 111_000.0)
    with pytest.raises(MapError, match=r"as if in degrees; project it to metres") as error:
        Matcher(HERE, DEFAULT).locate(degrees)
    assert "\n" not in str(error.value)


# 100,000 buildings


def test_a_map_of_100_000_buildings_is_located() -> None:
    city = town(111, 100_000, 9000.0)
    matcher = Matcher(whole(city), DEFAULT)
    turned = Buildings((city.centroids_m - city.centroids_m[0]) @ rotation(1.0).T, city.areas_m2, city.shapes)
    found = matcher.locate(local_map(turned))
    assert matcher.judge(found).reason is None and found.funnel["stars"] <= MOST_STARS
    at = turned.centroids_m[500]
    place = matcher.place(found, at).apply(at[None])[0]
    assert np.hypot(*(place - city.centroids_m[500])) < 1.0  # a map without errors
    assert len(found.scores[0].pairs) > 99_000


@pytest.mark.parametrize("config", [DEFAULT, PAPER], ids=["default", "paper"])
def test_a_huge_map_of_another_town_ends_with_a_reason_and_few_stars(config: MatcherConfig) -> None:
    matcher = Matcher(whole(TOWN, config), config)
    found = matcher.locate(local_map(town(112, 8000, 2600.0)))
    assert matcher.judge(found).reason is not None
    # The bound on stars bounds memory: matches and hypotheses come from them.
    assert found.funnel["stars"] == MOST_STARS
    assert found.funnel["matches"] <= MOST_STARS * max(config.matches_per_star, config.second_look_matches)


def test_databases_serve_what_they_were_made_for() -> None:
    assert HERE.epsg == UTM and len(HERE) == len(TOWN)
    matcher = Matcher(HERE, DEFAULT)
    before = matcher.locate(observed(TOWN, 60, 1, 4).local_map)
    matcher.warm_up()  # leaves no trace in what is found
    after = matcher.locate(observed(TOWN, 60, 1, 4).local_map)
    assert after.candidates == before.candidates and before.candidates


def test_any_database_warms_up() -> None:
    for points in (np.zeros((1, 2)), LINE[:3], LINE, lattice(3, 3).centroids_m):
        Matcher(whole(buildings_at(points, 1)), DEFAULT).warm_up()
