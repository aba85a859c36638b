"""Where a refinement begins: a match over the first half of a flight along a straight street, by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.config import matcher_config
from buildloc_matcher.geometry import Similarity
from buildloc_matcher.match_start import START_DEG, START_M, ends, start_of
from buildloc_matcher.selection import Score
from buildloc_msgs_py.types import Keyframe
from towns import DEFAULT, alike, mapped

# Houses left and right of a street, every 25 m for 2 km; the map has all, the match those of the first km.
STREET = np.array([[25.0 * i, 15.0 * (-1) ** i] for i in range(80)])
MATCHED = np.arange(40)
PATH = [Keyframe(i, 25.0 * i, 0.0, 0.1) for i in range(80)]
AWAY = Similarity((0.0, 0.0), (5000.0, 300.0), 0.7)
GROUND = alike(AWAY.apply(STREET))
SCORE = Score(AWAY, AWAY.apply(STREET), np.column_stack([MATCHED, MATCHED]), 0.0, 1.0, 99.0)


def test_a_flight_is_tried_whole_then_where_the_match_ends_then_further_back() -> None:
    # Six matched houses within 150 m: up to the keyframe at 1,000 m (the sixth-nearest house is at 850 m).
    assert ends(SCORE, mapped(STREET), PATH, DEFAULT) == [80, 40, 30, 20]
    assert ends(SCORE, mapped(STREET), PATH[:35], DEFAULT) == [35, 25, 15]  # no piece of fewer than ten
    # Far beyond the match there is no such place.
    assert ends(SCORE, mapped(STREET), PATH[60:], DEFAULT) == [20]
    assert ends(SCORE, mapped(STREET), PATH, matcher_config({"preset": "paper"})) == [80]


def test_keyframes_lie_where_the_match_has_them() -> None:
    begun = start_of(SCORE, mapped(STREET), PATH[:40], GROUND, DEFAULT)
    assert [k.stamp_ns for k in begun.keyframes] == list(range(20, 40))
    np.testing.assert_allclose(
        begun.state.poses[:, :2], AWAY.apply(np.array([[25.0 * i, 0.0] for i in range(20, 40)])), atol=1e-6
    )
    np.testing.assert_allclose(begun.state.poses[:, 2], 0.8)
    np.testing.assert_array_equal(
        begun.covariance, np.diag(np.square([*2 * [begun.sigma_m], begun.sigma_rad]))
    )


def test_the_further_from_the_matched_houses_the_less_certain() -> None:
    sigmas = [
        start_of(SCORE, mapped(STREET), PATH[:end], GROUND, DEFAULT).sigma_m for end in (40, 50, 60, 80)
    ]
    assert sigmas == sorted(sigmas) and sigmas[0] >= START_M
    # The last keyframe is 1,975 m along, the sixth-last matched house 850 m: hypot(1125, 15) m away.
    away, walk = math.hypot(1125.0, 15.0), math.radians(DEFAULT.walk_deg)
    expected = START_M**2 + (math.radians(START_DEG) * away) ** 2 + walk**2 * away**3 / 3.0
    assert sigmas[-1] == pytest.approx(math.sqrt(expected))
    still = replace(DEFAULT, walk_deg=0.001)
    assert start_of(SCORE, mapped(STREET), PATH, GROUND, still).sigma_m < sigmas[-1]
