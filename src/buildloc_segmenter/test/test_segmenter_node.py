"""The node on the wire: masks of keyframes, a network too slow, a network that fails."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

import rclpy
from buildloc_msgs_py import encode, qos, topics, wire
from buildloc_msgs_py.types import CameraModel, Frame, Mask
from buildloc_segmenter.network import NetworkError
from buildloc_segmenter.segmenter_node import KEYFRAMES_WAITING, SegmenterNode
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import QuaternionStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Range

pytestmark = pytest.mark.dds
SECOND = 10**9
DEADLINE_S = 20.0
CAMERA = CameraModel(96, 64, 100.0, 100.0, 47.5, 31.5)
JPEG = cv2.imencode(".jpg", np.full((64, 96, 3), 90, dtype=np.uint8))[1].tobytes()
INPUTS = {
    topics.CAMERA_INFO: CameraInfo,
    topics.ALTITUDE: Range,
    topics.GIMBAL_ATTITUDE: QuaternionStamped,
    topics.IMAGE_COMPRESSED: CompressedImage,
}


class Flight(Node):  # type: ignore[misc]
    """A drone beside the node: sends frames, keeps masks and diagnostics."""

    def __init__(self, context: Context, node: SegmenterNode) -> None:
        super().__init__("flight", context=context)
        self.node = node
        self.masks: list[Mask] = []
        self.statuses: list[DiagnosticStatus] = []
        self.executor_ = SingleThreadedExecutor(context=context)
        self.executor_.add_node(self)
        self.executor_.add_node(node)
        self._inputs = {t: self.create_publisher(kind, t, qos.TELEMETRY) for t, kind in INPUTS.items()}
        keep = self.masks.append
        self.create_subscription(Image, topics.MASK, lambda m: keep(wire.decode_mask(m)), qos.SENSOR)
        self.create_subscription(
            DiagnosticArray, topics.DIAGNOSTICS, lambda m: self.statuses.extend(m.status), qos.TELEMETRY
        )
        publishers = [*self._inputs.values(), node._masks]
        self.until(lambda: all(p.get_subscription_count() for p in publishers))

    def until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, self.statuses[-1:]
            self.executor_.spin_once(timeout_sec=0.02)

    def send(self, seconds: int, altitude_m: float = 30.0) -> None:
        stamp = seconds * SECOND
        for topic, message in (
            (topics.CAMERA_INFO, encode.encode_camera_info(CAMERA, stamp, "camera")),
            (topics.ALTITUDE, encode.encode_altitude(altitude_m, stamp, "camera")),
            (topics.GIMBAL_ATTITUDE, encode.encode_attitude((0.0, 0.0, 0.0, 1.0), stamp, "camera")),
            (topics.IMAGE_COMPRESSED, encode.encode_compressed_image(JPEG, stamp, "camera")),
        ):
            self._inputs[topic].publish(message)

    def reported(self, level: bytes, **figures: int) -> bool:
        """Whether some status so far had this level and these figures."""
        return any(
            s.level == level and {f.key: f.value for f in s.values}.items() >= wanted
            for wanted in ({key: str(value) for key, value in figures.items()}.items(),)
            for s in self.statuses
        )


@pytest.fixture
def flight() -> Iterator[Flight]:
    context = Context()
    rclpy.init(context=context, domain_id=1 + os.getpid() % 200)
    node = SegmenterNode(context=context)
    drone = Flight(context, node)
    yield drone
    node.destroy_node()
    drone.destroy_node()
    rclpy.try_shutdown(context=context)


def test_keyframes_are_masked_and_counted(flight: Flight) -> None:
    for seconds in (1, 2, 6, 7, 11):
        flight.send(seconds)
    flight.until(lambda: len(flight.masks) == 3)
    assert [mask.stamp_ns for mask in flight.masks] == [1 * SECOND, 6 * SECOND, 11 * SECOND]
    assert all(m.frame_id == "camera" and m.pixels.shape == (64, 96) for m in flight.masks)
    wanted = {"frames": 5, "keyframes": 3, "keyframes_waiting": 0, "keyframes_dropped": 0}
    flight.until(lambda: flight.reported(DiagnosticStatus.OK, **wanted))


def test_a_slow_network_loses_no_frame_and_says_which_keyframes_it_dropped(
    flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    go = threading.Event()

    def slowly(frame: Frame) -> Mask:
        assert go.wait(DEADLINE_S)
        return Mask(frame.stamp_ns, frame.frame_id, np.zeros((64, 96), dtype=np.uint8))

    monkeypatch.setattr(flight.node._segmenter, "segment", slowly)
    count = KEYFRAMES_WAITING + 3
    for i in range(count):
        flight.send(10 * i)
    figures = {"frames": count, "keyframes": KEYFRAMES_WAITING, "keyframes_dropped": 3}
    flight.until(lambda: flight.reported(DiagnosticStatus.WARN, **figures))
    assert not flight.masks
    go.set()
    flight.until(lambda: len(flight.masks) == KEYFRAMES_WAITING)
    flight.until(lambda: flight.reported(DiagnosticStatus.OK, **figures))


@pytest.mark.parametrize("error", [NetworkError("net.onnx: does not run"), MemoryError("too large")])
def test_a_failing_network_is_reported_and_the_node_stays_up(
    flight: Flight, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(frame: Frame) -> Mask:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(flight.node._segmenter, "segment", fail)
        flight.send(1)
        flight.until(
            lambda: flight.reported(DiagnosticStatus.ERROR, frames=1, keyframes=0, keyframes_failed=1)
        )
        assert any(str(error) in status.message for status in flight.statuses)
    flight.send(7)
    flight.until(lambda: flight.reported(DiagnosticStatus.OK, frames=2, keyframes=1, keyframes_failed=1))
    assert [mask.stamp_ns for mask in flight.masks] == [7 * SECOND]


def test_a_frame_without_height_is_reported_and_the_next_one_is_masked(flight: Flight) -> None:
    flight.send(1, altitude_m=float("nan"))
    flight.until(lambda: flight.reported(DiagnosticStatus.WARN, frames=0, frames_unusable=1))
    assert any("altitude" in status.message for status in flight.statuses)
    flight.send(3)
    flight.until(lambda: len(flight.masks) == 1)
