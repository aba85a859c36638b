"""What keeps a candidate from being a fix: every figure by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.acceptance import (
    Outcome,
    Verdict,
    judge_candidate,
    lead,
    log_odds,
    odds_against_all,
    refuse_refined,
    score,
)
from buildloc_matcher.calibration import PROTECTED, Errors, Tail, measured, protection_level_m, threshold
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.geometry import Similarity
from buildloc_matcher.refinement import Refined
from buildloc_matcher.selection import Score
from buildloc_msgs_py.types import Candidate

CONFIG = MatcherConfig()


def candidate(x_m: float, yaw_deg: float, nats: float) -> Candidate:
    return Candidate(x_m, 0.0, math.radians(yaw_deg), 1.0, 1.0, 0.5, nats)


def test_the_lead_is_over_the_best_other_pose() -> None:
    best = candidate(0.0, 179.0, 50.0)
    beside, turned_little = candidate(14.0, 179.0, 49.0), candidate(0.0, -162.0, 48.0)
    elsewhere, turned = candidate(16.0, 179.0, 30.0), candidate(0.0, -160.0, 35.0)
    assert lead(best, [], CONFIG) == lead(best, [beside, turned_little], CONFIG) == math.inf
    assert lead(best, [beside, elsewhere], CONFIG) == 20.0
    assert lead(best, [beside, elsewhere, turned], CONFIG) == 15.0  # 21 degrees over the seam


def test_evidence_is_weighed_against_the_room_for_chance() -> None:
    config = replace(CONFIG, sigma_m=2.0)
    disc = math.pi * 36.0
    assert log_odds(10.0, 1000.0 * disc, config) == pytest.approx(10.0 - math.log(36_000.0))
    assert log_odds(10.0, 0.0, config) == pytest.approx(10.0 - math.log(36.0))  # never less than one disc
    # A reference ten times as large takes that much more evidence.
    assert log_odds(10.0, 1e9, config) - log_odds(10.0, 1e10, config) == pytest.approx(math.log(10.0))


GOOD = Score(Similarity((0, 0), (0, 0), 0.0), np.zeros((20, 2)), np.zeros((20, 2), np.int64), 2.0, 0.6, 60.0)


def judged(best_nats: float, found: Score = GOOD, others: tuple[Candidate, ...] = ()) -> Verdict:
    return judge_candidate(candidate(0.0, 0.0, best_nats), others, found, CONFIG)


def test_the_score_is_the_odds_against_everything_else() -> None:
    best, rival = candidate(0.0, 0.0, 50.0), candidate(100.0, 0.0, 50.0)
    assert odds_against_all(best, [], CONFIG) == pytest.approx(50.0)
    assert odds_against_all(best, [rival], CONFIG) == pytest.approx(0.0)
    assert odds_against_all(best, [rival, rival], CONFIG) == pytest.approx(-math.log(2.0))  # two like it
    beside = candidate(10.0, 0.0, 50.0)  # the same answer
    assert odds_against_all(best, [beside], CONFIG) == pytest.approx(50.0)


def test_odds_count_by_the_root_of_the_evidence() -> None:
    """Four times the buildings lead another place that looks alike by twice as much, by chance."""
    best, rival = candidate(0.0, 0.0, 50.0), candidate(100.0, 0.0, 30.0)
    assert score(best, [rival], CONFIG) == odds_against_all(best, [rival], CONFIG)
    best, rival = candidate(0.0, 0.0, 200.0), candidate(100.0, 0.0, 160.0)
    assert score(best, [rival], CONFIG) == pytest.approx(20.0)
    assert score(best, [], CONFIG) == pytest.approx(100.0)
    assert score(candidate(0.0, 0.0, -3.0), [], CONFIG) < 0.0


def test_three_outcomes() -> None:
    enough = threshold(CONFIG.target_false_fix_rate)
    fix = judged(enough + 0.1)
    assert fix.outcome is Outcome.ACCEPTED and fix.reason is None
    assert fix.false_fix_probability < CONFIG.target_false_fix_rate
    chance = judged(-0.1)
    assert chance.outcome is Outcome.REJECTED and "no more than chance: log-odds -0.1" in (
        chance.reason or ""
    )
    between = judged(enough - 0.1)
    assert between.outcome is Outcome.UNDECIDED and "could be chance: score" in (between.reason or "")
    rival = candidate(500.0, 0.0, enough + 100.0)
    ambiguous = judged(enough + 105.0, others=(rival,))
    assert ambiguous.outcome is Outcome.UNDECIDED and "leads another place by 5.0" in (ambiguous.reason or "")


@pytest.mark.parametrize(
    ("found", "text"),
    [
        (replace(GOOD, jaccard=0.15), "MNN-Jaccard 0.15, below 0.2"),
        (replace(GOOD, pairs=np.zeros((9, 2), np.int64)), "matches 9 buildings, fewer than 10"),
        (replace(GOOD, rms_m=10.1), "residuals of 10.1 m, above 10 m"),
    ],
)
def test_each_figure_that_falls_short_is_named(found: Score, text: str) -> None:
    verdict = judged(1000.0, found)
    assert verdict.outcome is Outcome.UNDECIDED and text in (verdict.reason or "")
    assert (verdict.reason or "").startswith("undecided: ")


def test_the_threshold_follows_from_the_rate_asked_for() -> None:
    tail = Tail(start_nats=4.0, share=0.1, scale_nats=3.0)
    assert tail.exceedance(4.0) == pytest.approx(0.1) and tail.exceedance(-100.0) == 1.0
    assert tail.quantile(0.1) == pytest.approx(4.0) == tail.quantile(0.5)  # nothing was fitted below
    for rate in (1e-2, 1e-6):
        assert tail.exceedance(tail.quantile(rate)) == pytest.approx(rate)
    assert threshold(1e-6) > threshold(1e-5) > measured().tail.start_nats


def test_errors_with_a_heavy_tail_are_protected_against_further_out() -> None:
    normal, heavy = Errors(1.0, 1e6), Errors(1.0, 8.0)
    assert normal.radius(PROTECTED) == pytest.approx(3.717, abs=1e-3)  # root of chi-square's 13.82
    assert heavy.radius(PROTECTED) == pytest.approx(6.08, abs=0.01)  # root of twice the 18.49 of F(2, 8)
    north = np.diag([1.0, 4.0])
    turned = np.array([[2.5, 1.5], [1.5, 2.5]])  # the same, by 45 degrees
    both = protection_level_m(np.stack([north, turned]))
    assert both == pytest.approx(2.0 * measured().errors.radius(PROTECTED))


def test_each_figure_of_the_refinement_that_falls_short_is_named() -> None:
    good = Refined(np.zeros(2), 0.0, np.eye(3), {}, 50, 40, 20, 2.0)
    assert refuse_refined(good, CONFIG) is None
    for refined, text in (
        (replace(good, buildings=2), "matched 2 buildings, fewer than 3"),
        (replace(good, rms_m=11.0), "residuals of 11.0 m, above 10 m"),
    ):
        reason = refuse_refined(refined, CONFIG)
        assert reason is not None and text in reason
