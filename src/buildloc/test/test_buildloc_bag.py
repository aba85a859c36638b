"""Frames out of bags, and one line for every kind of bad bag."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from buildloc.bag import BagError, read_frames
from buildloc_msgs_py.pairing import FrameFault
from buildloc_msgs_py.types import Frame
from tiny_bags import HEIGHT, SECOND, WIDTH, truncate, write_bag


def test_frames_come_in_order_with_their_telemetry(tmp_path: Path) -> None:
    frames = list(read_frames(write_bag(tmp_path / "bag")))
    assert all(isinstance(frame, Frame) for frame in frames)
    assert [f.stamp_ns for f in frames] == [SECOND, 2 * SECOND, 3 * SECOND]
    frame = frames[0]
    assert isinstance(frame, Frame)
    assert frame.image_bgr.shape == (HEIGHT, WIDTH, 3) and frame.altitude_m == 100.0
    assert frame.attitude_xyzw == (0.0, 0.0, 0.0, 1.0) and frame.camera.fx == 80.0


def test_a_missing_bag(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="no such bag"):
        next(read_frames(tmp_path / "absent"))


def test_a_folder_that_is_no_bag(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"without metadata\.yaml"):
        next(read_frames(tmp_path))


@pytest.mark.parametrize("keep", [0.0, 0.1, 0.5, 0.95])
def test_a_truncated_bag(tmp_path: Path, keep: float) -> None:
    with pytest.raises(BagError, match="truncated or damaged"):
        list(read_frames(truncate(write_bag(tmp_path / "bag"), keep)))


def test_an_empty_bag(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="holds no messages"):
        list(read_frames(write_bag(tmp_path / "bag", frames=0)))


@pytest.mark.parametrize(
    "topic", ["/camera/image/compressed", "/camera/camera_info", "/altitude", "/gimbal/attitude"]
)
def test_a_bag_without_a_needed_topic(tmp_path: Path, topic: str) -> None:
    with pytest.raises(BagError, match=f"no messages on .*{topic[1:]}.*record the missing topics"):
        list(read_frames(write_bag(tmp_path / "bag", without=(topic,))))


@pytest.mark.parametrize("altitude_m", [math.nan, -10.0])
def test_a_bad_altitude_makes_faults_that_say_so(tmp_path: Path, altitude_m: float) -> None:
    frames = list(read_frames(write_bag(tmp_path / "bag", altitude_m=altitude_m)))
    assert len(frames) == 3
    assert all(isinstance(f, FrameFault) and "not a positive number" in f.reason for f in frames)


def test_another_size_than_camera_info_makes_faults_that_say_so(tmp_path: Path) -> None:
    frames = list(read_frames(write_bag(tmp_path / "bag", info_width=WIDTH + 1)))
    assert all(isinstance(f, FrameFault) and "camera_info says 97x64" in f.reason for f in frames)


def test_another_encoding_makes_faults_that_say_so(tmp_path: Path) -> None:
    frames = list(read_frames(write_bag(tmp_path / "bag", encoding="bayer_rggb8")))
    assert all(isinstance(f, FrameFault) and "'bayer_rggb8' is not supported" in f.reason for f in frames)
    raw = list(read_frames(write_bag(tmp_path / "raw", encoding="rgb8")))
    assert all(isinstance(f, Frame) for f in raw) and len(raw) == 3
