"""Acquire, track, coast: hand-drawn flights along the map's x axis, which the world turns to the north."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.pursuit import (
    Agreement,
    Anchor,
    Mode,
    Place,
    Pursuit,
    agree,
    carry,
    coast,
    locate,
    prediction,
    sigma_m,
    sigmas_apart,
    withdraw,
)
from buildloc_msgs_py.types import Keyframe, Tracked

CONFIG = MatcherConfig(drift_share=0.02, drift_deg_per_km=3.0, max_coast_m=200.0, max_track_sigma_m=8.0)
SECOND = 10**9
QUARTER = math.pi / 2.0
SPREAD = np.diag([4.0, 1.0, math.radians(1.0) ** 2])
NO_ERROR = np.zeros((4, 4))
# A keyframe every second and every 50 m; the map is 2 % too small, the third keyframe's altimeter reads
# 10 % too low.
PATH = tuple(
    Keyframe(i * SECOND, 50.0 * i, 0.0, 0.0, scale) for i, scale in enumerate((1.0, 1.0, 1.1, 1.0, 1.0))
)
AGREEMENT = Agreement({SECOND: (1000.0, 2000.0, QUARTER)}, SPREAD, 1.02)


def acquired(keyframes: tuple[Keyframe, ...] = PATH[:2]) -> Pursuit:
    return agree(carry(Pursuit(), keyframes, CONFIG), AGREEMENT, CONFIG)


def frame(keyframe: int, x: float, y: float = 0.0, yaw: float = 0.0) -> Tracked:
    return Tracked(keyframe * SECOND + 7, keyframe * SECOND, x, y, yaw, 100.0, NO_ERROR)


def test_while_acquiring_keyframes_are_kept_and_no_frame_has_a_place() -> None:
    pursuit = carry(Pursuit(), PATH[:2], CONFIG)
    assert pursuit.mode is Mode.ACQUIRE and pursuit.keyframes == PATH[:2] and not pursuit.anchors
    assert isinstance(locate(pursuit, frame(1, 0.0), CONFIG), str)


def test_an_agreement_places_its_keyframe_and_the_frames_tracked_in_it() -> None:
    pursuit = acquired()
    assert pursuit.mode is Mode.TRACK and pursuit.since_agreement_m == 0.0
    place = locate(pursuit, frame(1, 10.0, 5.0, 0.3), CONFIG)
    assert isinstance(place, Place) and place.stamp_ns == SECOND + 7
    # 10 m ahead and 5 m to the left on the map; the world turns it by 90 degrees and is 2 % larger.
    assert (place.x_m, place.y_m) == pytest.approx((1000.0 - 5.1, 2000.0 + 10.2))
    assert place.yaw_rad == pytest.approx(QUARTER + 0.3)


def test_newer_keyframes_are_placed_by_the_map_and_their_own_scale() -> None:
    pursuit = carry(acquired(), PATH[:3], CONFIG)
    anchor = pursuit.anchors[2 * SECOND]
    assert (anchor.x_m, anchor.y_m, anchor.yaw_rad) == pytest.approx((1000.0, 2051.0, QUARTER))
    assert pursuit.since_agreement_m == pytest.approx(51.0)
    place = locate(pursuit, frame(2, 10.0), CONFIG)
    assert isinstance(place, Place) and place.y_m == pytest.approx(2051.0 + 10.0 * 1.1 * 1.02)


def test_a_prediction_puts_the_map_where_the_anchor_is() -> None:
    pursuit = carry(acquired(), PATH[:3], CONFIG)
    predicted = prediction(pursuit.anchors[2 * SECOND], PATH[2])
    assert predicted.apply(np.array([[100.0, 0.0], [150.0, 1.0]])) == pytest.approx(
        np.array([[1000.0, 2051.0], [1000.0 - 1.02, 2102.0]])
    )
    assert predicted.yaw_rad == pytest.approx(QUARTER) and predicted.scale == pytest.approx(1.02)


def test_an_agreement_about_an_older_keyframe_reaches_the_newest() -> None:
    pursuit = acquired(PATH[:4])
    assert pursuit.anchors[3 * SECOND].y_m == pytest.approx(2000.0 + 2 * 51.0)
    assert pursuit.since_agreement_m == pytest.approx(102.0)


def test_uncertainty_grows_with_the_distance_since_the_agreement_and_shrinks_with_the_next() -> None:
    pursuit = acquired(PATH)
    sigmas = [sigma_m(pursuit.anchors[k.stamp_ns].uncertainty(CONFIG)) for k in PATH[1:]]
    assert sigmas == sorted(sigmas) and sigmas[0] == pytest.approx(2.0)
    assert (
        pursuit.unanswered(PATH[-1].stamp_ns) == len(PATH) - 2 and pursuit.unanswered(PATH[1].stamp_ns) == 0
    )
    # 153 m north: 2 % of it drift, and the heading's degree across it.
    far = pursuit.anchors[4 * SECOND].uncertainty(CONFIG)
    assert far[1, 1] == pytest.approx(1.0 + (0.02 * 153.0) ** 2)
    assert far[0, 0] == pytest.approx(4.0 + (0.02 * 153.0) ** 2 + (153.0 * math.radians(1.0)) ** 2)
    assert far[2, 2] == pytest.approx(math.radians(1.0) ** 2 + math.radians(3.0 * 0.153) ** 2)
    tired = coast(pursuit)
    assert tired.mode is Mode.COAST and tired.anchors == pursuit.anchors
    agreed = agree(tired, Agreement({4 * SECOND: (1000.0, 2153.0, QUARTER)}, SPREAD, 1.02), CONFIG)
    assert agreed.mode is Mode.TRACK and agreed.since_agreement_m == 0.0
    assert agreed.anchors.keys() == {4 * SECOND}


def test_the_covariance_of_a_tracked_frame_is_that_of_many() -> None:
    rng = np.random.default_rng(4)
    config = MatcherConfig(drift_share=0.0, drift_deg_per_km=0.0)
    anchor = Anchor(5.0, -3.0, 0.7, 1.1, np.diag([4.0, 1.0, 4e-4]))
    spread = np.diag([0.25, 0.09, 1e-4, 1e-4])
    tracked = Tracked(1, 0, 20.0, 8.0, -0.4, 100.0, spread)
    told = locate(Pursuit(Mode.TRACK, {0: anchor}), tracked, config)
    assert isinstance(told, Place)
    drawn = []
    for _ in range(4000):
        e, n, turn = rng.normal(size=3) * np.sqrt(np.diag(anchor.covariance))
        x, y, yaw = rng.normal(size=3) * np.sqrt(np.diag(spread)[:3])
        moved = Anchor(5.0 + e, -3.0 + n, 0.7 + turn, 1.1, anchor.covariance)
        there = moved.ahead(20.0 + x, 8.0 + y, yaw - 0.4, 1.0)
        drawn.append((there.x_m, there.y_m, there.yaw_rad))
    sigmas = np.sqrt(np.diag(told.covariance))
    # 4000 draws know a correlation to 0.016.
    assert np.cov(np.array(drawn).T) / np.outer(sigmas, sigmas) == pytest.approx(
        told.covariance / np.outer(sigmas, sigmas), abs=0.08
    )


def test_a_place_is_withdrawn_when_it_was_carried_too_far() -> None:
    longer = (*PATH, Keyframe(5 * SECOND, 250.0, 0.0, 0.0))
    pursuit = carry(acquired(PATH), longer, CONFIG)
    assert pursuit.mode is Mode.ACQUIRE and not pursuit.anchors and pursuit.keyframes == longer
    assert pursuit.withdrawn == "flew 204 m without an agreement with the reference"
    ahead = locate(acquired(PATH), frame(4, 60.0), CONFIG)
    assert ahead == "flew 214 m without an agreement with the reference"


def test_a_place_is_withdrawn_when_it_became_too_uncertain() -> None:
    wide = Agreement(AGREEMENT.poses, np.diag([49.0, 49.0, 1e-4]), 1.02)
    pursuit = agree(carry(Pursuit(), PATH[:2], CONFIG), wide, CONFIG)
    assert pursuit.mode is Mode.TRACK
    assert carry(pursuit, PATH[:3], CONFIG).mode is Mode.TRACK  # hypot(7, 0.01 * 51, 0.02 * 51) m
    wider = replace(CONFIG, max_track_sigma_m=7.5)
    assert carry(pursuit, PATH, wider).withdrawn == "uncertainty grew to 8 m, above 7.5 m"


def test_another_submap_ends_a_track_and_its_older_agreement_comes_to_nothing() -> None:
    foreign = (Keyframe(9 * SECOND, 0.0, 0.0, 0.0), Keyframe(10 * SECOND, 30.0, 0.0, 0.0))
    pursuit = carry(acquired(), foreign, CONFIG)
    assert pursuit.mode is Mode.ACQUIRE
    assert pursuit.withdrawn == "the mapper began another map: tracking was lost"
    assert agree(pursuit, AGREEMENT, CONFIG).mode is Mode.ACQUIRE


def test_a_graph_that_moved_leaves_the_world_where_it_was() -> None:
    """The map is turned and shifted as a whole: anchors stay, and newer keyframes are placed alike."""
    turn = 0.4
    c, s = math.cos(turn), math.sin(turn)
    moved = tuple(
        Keyframe(k.stamp_ns, c * k.x_m - s * k.y_m + 7.0, s * k.x_m + c * k.y_m, k.yaw_rad + turn, k.scale)
        for k in PATH
    )
    one, other = (carry(acquired(), path, CONFIG).anchors[4 * SECOND] for path in (PATH, moved))
    assert (one.x_m, one.y_m, one.yaw_rad) == pytest.approx((other.x_m, other.y_m, other.yaw_rad))


def test_a_frame_of_a_keyframe_without_a_place_has_none() -> None:
    assert locate(acquired(), frame(3, 0.0), CONFIG) == (
        "the frame is tracked in a keyframe that has no place yet"
    )


def test_withdrawn_is_withdrawn() -> None:
    pursuit = withdraw(acquired(), "said so")
    assert (pursuit.mode, pursuit.withdrawn, len(pursuit.anchors)) == (Mode.ACQUIRE, "said so", 0)
    assert coast(pursuit).mode is Mode.ACQUIRE and math.isnan(pursuit.since_agreement_m)


def test_offsets_are_told_in_standard_deviations() -> None:
    none = np.zeros((3, 3))
    assert sigmas_apart(np.array([6.0, 0.0, 0.0]), SPREAD, none, none) == pytest.approx(3.0)
    assert sigmas_apart(np.array([0.0, 0.0, math.radians(5.0)]), SPREAD, none, none) == pytest.approx(5.0)
    # What both places share is no difference between them: 6 m of 2 (4 - 3) m2 and not of 2 * 4.
    shared = np.diag([3.0, 3.0, 0.0])
    assert sigmas_apart(np.array([6.0, 0.0, 0.0]), SPREAD, SPREAD, shared) == pytest.approx(math.sqrt(18.0))
