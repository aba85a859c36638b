"""Pairing of masks, telemetry, maps and keyframes, and what a session says when something is missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.session import PENDING, Session
from buildloc_msgs_py.types import CameraModel, Keyframe, LocalMap, Mask, NoFix

CAMERA = CameraModel(8, 6, 10.0, 10.0, 4.0, 3.0)
SECOND = 10**9


def mask(stamp_ns: int, width: int = 8) -> Mask:
    return Mask(stamp_ns, "camera", np.zeros((6, width), dtype=np.uint8))


def empty_map(stamp_ns: int) -> LocalMap:
    none = np.empty(0, dtype=np.int64)
    return LocalMap.whole(stamp_ns, none, np.empty((0, 2)), np.empty(0), np.empty((0, 4)), none)


def with_telemetry() -> Session:
    session = Session(MatcherConfig())
    session.telemetry.camera.add(0, CAMERA)
    for second in range(100):
        session.telemetry.altitude.add(second * SECOND, 100.0 + second)
        session.telemetry.attitude.add(second * SECOND, (0.0, 0.0, 0.0, 1.0))
    return session


@pytest.mark.parametrize("order", ["mask map keys", "keys map mask", "map mask keys"])
def test_a_job_is_complete_once_in_any_order(order: str) -> None:
    session, stamp = with_telemetry(), 7 * SECOND
    session.add_mask(mask(5 * SECOND))
    add = {
        "mask": lambda: session.add_mask(mask(stamp)),
        "map": lambda: session.add_map(empty_map(stamp)),
        "keys": lambda: session.add_keyframes(
            (Keyframe(5 * SECOND, 0.0, 0.0, 0.0), Keyframe(stamp, 1.0, 0.0, 0.0))
        ),
    }
    jobs = [add[name]() for name in order.split()]
    assert jobs[:2] == [None, None] and jobs[2] is not None
    assert [o.altitude_m for o in jobs[2].observations] == [105.0, 107.0]
    assert len(jobs[2].keyframes) == 2 and jobs[2].local_map.stamp_ns == stamp
    assert session.add_mask(mask(stamp)) is None and session.add_keyframes(()) is None


def test_missing_telemetry_and_another_size_are_said_and_do_not_block() -> None:
    session = Session(MatcherConfig())
    session.telemetry.camera.add(0, CAMERA)
    session.telemetry.altitude.add(SECOND, 100.0)
    session.load(str(Path("nowhere") / "absent.arrow"))
    session.add_mask(mask(SECOND))
    assert session.telemetry_fault == "no gimbal/attitude received; check that it is published or recorded"
    assert "absent.arrow" in session.waiting().reason and session.waiting().stamp_ns == SECOND
    session.telemetry.attitude.add(SECOND, (0.0, 0.0, 0.0, 1.0))
    session.add_mask(mask(SECOND, 9))
    assert session.telemetry_fault == "mask is 9x6, camera_info says 8x6" and session.frames_unusable == 2
    session.add_map(empty_map(SECOND))
    job = session.add_keyframes((Keyframe(SECOND, 0.0, 0.0, 0.0),))
    assert job is not None and job.observations == ()
    answer = session.solve(job)
    assert isinstance(answer.result, NoFix) and "no such reference database" in answer.result.reason


def test_maps_that_never_complete_are_dropped_and_counted() -> None:
    session = with_telemetry()
    for i in range(PENDING + 3):
        assert session.add_map(empty_map(i)) is None
    assert session.maps_skipped == 3
