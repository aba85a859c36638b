"""What keeps a candidate from being a fix: every figure by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.acceptance import lead, log_odds, refuse_coarse, refuse_refined
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


@pytest.mark.parametrize(
    ("score", "lead_nats", "odds", "text"),
    [
        (GOOD, 31.0, 29.9, "could be chance: log-odds 29.9, below 30"),
        (replace(GOOD, jaccard=0.15), 31.0, 31.0, "MNN-Jaccard 0.15, below 0.2"),
        (GOOD, 29.9, 31.0, "leads another place by 29.9 nats, below 30"),
        (replace(GOOD, pairs=np.zeros((9, 2), np.int64)), 31.0, 31.0, "matches 9 buildings, fewer than 10"),
        (replace(GOOD, rms_m=10.1), 31.0, 31.0, "residuals of 10.1 m, above 10 m"),
    ],
)
def test_each_figure_that_falls_short_is_named(
    score: Score, lead_nats: float, odds: float, text: str
) -> None:
    reason = refuse_coarse(score, lead_nats, odds, CONFIG)
    assert reason is not None and text in reason
    assert refuse_coarse(GOOD, 30.0, 30.0, CONFIG) is None


def test_each_figure_of_the_refinement_that_falls_short_is_named() -> None:
    good = Refined(np.zeros(2), 0.0, np.eye(3), {}, 50, 40, 20, 2.0)
    assert refuse_refined(good, CONFIG) is None
    for refined, text in (
        (replace(good, buildings=9), "matched 9 buildings, fewer than 10"),
        (replace(good, rms_m=11.0), "residuals of 11.0 m, above 10 m"),
    ):
        reason = refuse_refined(refined, CONFIG)
        assert reason is not None and text in reason
