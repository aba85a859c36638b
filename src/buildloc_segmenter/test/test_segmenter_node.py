"""The node on the wire: masks of keyframes, a network too slow, a network that fails."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

import rclpy
from buildloc_msgs_py.types import Frame, Mask
from buildloc_msgs_py.wire import decode_mask, stamp_ns
from buildloc_segmenter.network import TILE_PX, Network, NetworkError
from buildloc_segmenter.segmenter_node import KEYFRAMES_WAITING, SegmenterNode
from diagnostic_msgs.msg import DiagnosticStatus
from drone import DEADLINE_S, SECOND, Drone, domain_id
from rclpy.context import Context

pytestmark = pytest.mark.dds


class Flight(Drone):
    """A drone with the node alone."""

    def __init__(self, context: Context) -> None:
        self.node = SegmenterNode(context=context)
        super().__init__(context, self.node)
        self.until(lambda: self.connected(1) and self.node._masks.get_subscription_count())

    def reported(self, level: bytes, **figures: int) -> bool:
        """Whether the node said this so far."""
        return self.said("segmenter_node", level, **figures)


@pytest.fixture
def flight() -> Iterator[Flight]:
    context = Context()
    rclpy.init(context=context, domain_id=domain_id())
    drone = Flight(context)
    yield drone
    drone.node.destroy_node()
    drone.destroy_node()
    rclpy.try_shutdown(context=context)


def test_keyframes_are_masked_and_counted(flight: Flight) -> None:
    for seconds in (1, 2, 6, 7, 11):
        flight.send(seconds * SECOND)
    flight.until(lambda: len(flight.masks) == 3)
    assert [stamp_ns(mask) for mask in flight.masks] == [1 * SECOND, 6 * SECOND, 11 * SECOND]
    assert all(m.frame_id == "camera" and m.pixels.shape == (64, 96) for m in map(decode_mask, flight.masks))
    wanted = {"frames": 5, "keyframes": 3, "keyframes_waiting": 0, "keyframes_dropped": 0}
    flight.until(lambda: flight.reported(DiagnosticStatus.OK, **wanted))


def test_a_slow_network_loses_no_frame_and_drops_the_oldest_keyframes_that_wait(
    flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    go = threading.Event()

    def slowly(frame: Frame) -> Mask:
        assert go.wait(DEADLINE_S)
        return Mask(frame.stamp_ns, frame.frame_id, np.zeros((64, 96), dtype=np.uint8))

    monkeypatch.setattr(flight.node._segmenter, "segment", slowly)
    count = KEYFRAMES_WAITING + 3
    for i in range(count):
        flight.send(10 * i * SECOND)
    figures = {"frames": count, "keyframes": KEYFRAMES_WAITING + 1, "keyframes_dropped": 2}
    flight.until(lambda: flight.reported(DiagnosticStatus.WARN, **figures))
    assert not flight.masks
    go.set()
    flight.until(lambda: len(flight.masks) == KEYFRAMES_WAITING + 1)
    flight.until(lambda: flight.reported(DiagnosticStatus.OK, **figures, keyframes_waiting=0))
    # The first was being segmented; the oldest of those that waited made room for the newest.
    wanted = [0, *range(3, count)]
    assert [stamp_ns(mask) for mask in flight.masks] == [10 * i * SECOND for i in wanted]


@pytest.mark.parametrize("error", [NetworkError("net.onnx: does not run"), MemoryError("too large")])
def test_a_failing_network_is_reported_and_the_node_stays_up(
    flight: Flight, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(frame: Frame) -> Mask:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(flight.node._segmenter, "segment", fail)
        flight.send(1 * SECOND)
        flight.until(
            lambda: flight.reported(DiagnosticStatus.ERROR, frames=1, keyframes=0, keyframes_failed=1)
        )
        assert any(str(error) in status.message for status in flight.statuses)
    flight.send(7 * SECOND)
    flight.until(lambda: flight.reported(DiagnosticStatus.OK, frames=2, keyframes=1, keyframes_failed=1))
    assert [stamp_ns(mask) for mask in flight.masks] == [7 * SECOND]


def test_a_frame_without_height_is_reported_and_the_next_one_is_masked(flight: Flight) -> None:
    flight.send(1 * SECOND, altitude_m=float("nan"))
    flight.until(lambda: flight.reported(DiagnosticStatus.WARN, frames=0, frames_unusable=1))
    assert any("altitude" in status.message for status in flight.statuses)
    flight.send(3 * SECOND)
    flight.until(lambda: len(flight.masks) == 1)


def test_a_flight_too_high_for_the_network_is_masked_with_a_warning(flight: Flight) -> None:
    flight.send(1 * SECOND, altitude_m=300.0)  # 3 m per pixel
    flight.until(lambda: flight.reported(DiagnosticStatus.WARN, keyframes=1, keyframes_waiting=0))
    assert len(flight.masks) == 1
    assert any("3 m per pixel, outside of the 0.1 to 0.5 m" in status.message for status in flight.statuses)


def test_the_provider_that_runs_is_reported(flight: Flight) -> None:
    flight.send(1 * SECOND)
    flight.until(lambda: len(flight.masks) == 1)
    values = {v.key: v.value for v in flight.states["segmenter_node"].values}
    assert values["provider"] == "CPUExecutionProvider"


def test_the_network_is_warm_before_the_node_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[tuple[int, ...]] = []
    real = Network._run
    monkeypatch.setattr(Network, "_run", lambda self, tile: (sizes.append(tile.shape), real(self, tile))[1])
    context = Context()
    rclpy.init(context=context, domain_id=domain_id())
    try:
        SegmenterNode(context=context).destroy_node()
    finally:
        rclpy.try_shutdown(context=context)
    assert (TILE_PX, TILE_PX, 3) in sizes
