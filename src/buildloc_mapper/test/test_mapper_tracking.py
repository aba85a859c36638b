"""Frames between keyframes over a textured plane: where they are comes back, or why not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.mapper import Mapper
from buildloc_mapper.registration import Registration
from buildloc_mapper.similarity import Similarity
from buildloc_mapper.tracking import Lost, Tracker
from buildloc_msgs_py.types import Frame, Tracked
from buildloc_msgs_py.wire import WireError
from textured import shoot, tilt

TENTH = 10**8  # of a second
CONFIG = MapperConfig()
REGISTRATION = Registration(CONFIG)


def at(tenth: int, x: float, y: float, yaw: float = 0.0, altitude: float = 60.0) -> Frame:
    return shoot(tenth * TENTH, x, y, yaw, altitude, tilt(0.02, -0.01))[0]


def tracked(tracker: Tracker, frame: Frame) -> Tracked:
    answer = tracker.track(frame)
    assert isinstance(answer, Tracked), answer
    return answer


def based(frame: Frame) -> Tracker:
    tracker = Tracker(CONFIG, REGISTRATION)
    tracker.rebase(frame, REGISTRATION.prepare(frame), None)
    return tracker


def test_frames_of_a_flight_are_where_they_were_taken() -> None:
    """A bend at 15 m/s and 20 degrees per second, five frames per second, altitude changing."""
    tracker = based(at(0, -20.0, 0.0))
    for i in range(1, 10):
        x, y, yaw = -20.0 + 3.0 * i, 0.1 * i * i, math.radians(4.0 * i)
        found = tracked(tracker, at(2 * i, x, y, yaw, 60.0 + 0.3 * i))
        assert (found.stamp_ns, found.keyframe_ns) == (2 * i * TENTH, 0)
        # Half a pixel of 0.15 m.
        assert (found.x_m, found.y_m) == pytest.approx((x + 20.0, y), abs=0.07)
        assert found.yaw_rad == pytest.approx(yaw, abs=0.003)
        assert found.height_m == pytest.approx(60.0 + 0.3 * i, rel=0.004)
        assert 0.0 < math.sqrt(found.covariance[0, 0]) < 0.5


def test_a_frame_that_no_prediction_reaches_is_found_again() -> None:
    tracker = based(at(0, -20.0, 0.0))
    found = tracked(tracker, at(20, 5.0, 12.0, 1.2))
    assert (found.x_m, found.y_m) == pytest.approx((25.0, 12.0), abs=0.1)


def test_what_cannot_be_tracked_is_lost_and_the_next_frame_is_not() -> None:
    frame = at(0, -20.0, 0.0)
    tracker = based(frame)
    black = replace(frame, stamp_ns=1, image_bgr=np.zeros_like(frame.image_bgr))
    assert isinstance(tracker.track(black), Lost)
    foreign = np.random.default_rng(1).integers(0, 255, frame.image_bgr.shape, dtype=np.uint8)
    assert isinstance(tracker.track(replace(frame, stamp_ns=2, image_bgr=foreign)), Lost)
    assert isinstance(tracker.track(at(5, 85.0, 70.0)), Lost)  # no overlap
    assert tracker.track(replace(at(6, -18.0, 0.0), altitude_m=90.0)) == Lost(6 * TENTH, "scale")
    tracked(tracker, at(7, -18.0, 0.0))
    with pytest.raises(WireError):
        tracker.track(replace(frame, altitude_m=math.nan))


def test_before_the_first_keyframe_and_after_a_reset_there_is_nothing_to_track_against() -> None:
    tracker = Tracker(CONFIG, REGISTRATION)
    assert tracker.track(at(1, 0.0, 0.0)) == Lost(TENTH, "no_keyframe")
    tracker.rebase(at(0, 0.0, 0.0), REGISTRATION.prepare(at(0, 0.0, 0.0)), None)
    tracked(tracker, at(1, 0.0, 0.0))
    tracker.reset()
    assert tracker.track(at(2, 0.0, 0.0)) == Lost(2 * TENTH, "no_keyframe")


def test_a_new_keyframe_takes_the_motion_over() -> None:
    tracker = based(at(0, -20.0, 0.0))
    for i in (1, 2, 3):
        tracked(tracker, at(4 * i, -20.0 + 8.0 * i, 0.0))
    # 32 m from the old keyframe, 12 m from the new one: 80 px, far beyond what corners can be followed from.
    keyframe = at(11, 0.0, 0.0)
    tracker.rebase(keyframe, REGISTRATION.prepare(keyframe), Similarity(-20.0, 0.0, 0.0, 1.0))
    found = tracked(tracker, at(16, 12.0, 0.0))
    assert found.keyframe_ns == keyframe.stamp_ns
    assert (found.x_m, found.y_m) == pytest.approx((12.0, 0.0), abs=0.1)


def test_the_mapper_tracks_in_its_latest_keyframe() -> None:
    mapper = Mapper(CONFIG)
    assert isinstance(mapper.track(at(0, -40.0, 0.0)), Lost)
    for i in range(3):
        mapper.add(*shoot(50 * i * TENTH, -40.0 + 15.0 * i, 0.0, 0.3))
    answer = mapper.track(shoot(120 * TENTH, -4.0, 2.0, 0.4)[0])
    assert isinstance(answer, Tracked) and answer.keyframe_ns == 100 * TENTH
    c, s = math.cos(0.3), math.sin(0.3)
    assert (answer.x_m, answer.y_m) == pytest.approx((6.0 * c + 2.0 * s, 2.0 * c - 6.0 * s), abs=0.1)
    assert answer.yaw_rad == pytest.approx(0.1, abs=0.005)
    assert np.linalg.eigvalsh(answer.covariance).min() > 0.0
    mapper.reset()
    assert isinstance(mapper.track(at(0, -40.0, 0.0)), Lost)


def test_inverse_undoes_a_similarity() -> None:
    pose = Similarity(5.0, -3.0, 2.7, 1.1)
    for both in (pose.compose(pose.inverse()), pose.inverse().compose(pose)):
        assert both == pytest.approx((0.0, 0.0, 0.0, 1.0), abs=1e-12)
