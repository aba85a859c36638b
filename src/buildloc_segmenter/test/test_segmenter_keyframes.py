"""Which images become keyframes, and what a bad frame does."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_msgs_py.types import CameraModel, Frame
from buildloc_msgs_py.wire import WireError
from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.keyframes import Moment, is_keyframe
from buildloc_segmenter.segmenter import Segmenter

SECOND = 10**9
CONFIG = SegmenterConfig()


def moment(seconds: float, heading_deg: float = 0.0) -> Moment:
    return Moment(round(seconds * SECOND), math.radians(heading_deg))


@pytest.mark.parametrize(
    ("last", "now", "expected"),
    [
        (None, moment(0.0), True),
        (moment(0.0), moment(4.99), False),
        (moment(0.0), moment(5.0), True),
        (moment(0.0), moment(1.0, 14.9), False),
        (moment(0.0), moment(1.0, 15.1), True),
        (moment(0.0), moment(1.0, -15.1), True),
        (moment(0.0, 179.0), moment(1.0, -179.0), False),  # 2 degrees across the wrap
        (moment(0.0, 175.0), moment(1.0, -169.0), True),  # 16 degrees across the wrap
        (moment(9.0), moment(8.0), True),  # the recording started again
    ],
)
def test_policy(last: Moment | None, now: Moment, expected: bool) -> None:
    assert is_keyframe(last, now, CONFIG) is expected


def frame(seconds: float, heading_deg: float = 0.0) -> Frame:
    half = math.radians(heading_deg) / 2
    camera = CameraModel(96, 64, 100.0, 100.0, 47.5, 31.5)
    image = np.full((64, 96, 3), 90, dtype=np.uint8)
    attitude = (0.0, 0.0, math.sin(half), math.cos(half))
    return Frame(round(seconds * SECOND), "camera", image, camera, 30.0, attitude)


def test_segmenter_masks_keyframes_only_with_their_stamp() -> None:
    segmenter = Segmenter(CONFIG)
    masks = [segmenter.process(frame(s, h)) for s, h in ((0, 0), (1, 0), (2, 20), (6, 20), (7, 20), (8, 20))]
    assert [m is not None for m in masks] == [True, False, True, False, True, False]
    first = masks[0]
    assert first is not None and first.stamp_ns == 0 and first.frame_id == "camera"
    assert first.pixels.shape == (64, 96)


def test_a_bad_frame_is_refused_and_leaves_the_policy_alone() -> None:
    segmenter = Segmenter(CONFIG)
    with pytest.raises(WireError, match="not a positive number"):
        segmenter.process(replace(frame(0.0), altitude_m=math.nan))
    with pytest.raises(WireError, match="camera_info says 97x64"):
        segmenter.process(replace(frame(0.0), camera=CameraModel(97, 64, 100.0, 100.0, 48.0, 31.5)))
    assert segmenter.process(frame(1.0)) is not None


def test_reset_forgets_the_flight() -> None:
    segmenter = Segmenter(CONFIG)
    assert segmenter.select(frame(0.0))
    assert not segmenter.select(frame(1.0))
    segmenter.reset()
    assert segmenter.select(frame(2.0))
