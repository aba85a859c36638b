"""What every node does the same way: parameters from a config, diagnostics, frames in, start and stop."""

from __future__ import annotations

import dataclasses
import sys
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import QuaternionStamped
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Range

from buildloc_msgs_py import qos, topics
from buildloc_msgs_py.config import from_mapping
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.pairing import FrameFault, FramePairing
from buildloc_msgs_py.types import Frame

ConfigT = TypeVar("ConfigT")
Result = TypeVar("Result")
DIAGNOSTICS_PERIOD_S = 1.0
FLUSH_PERIOD_S = 0.5


def _descriptor(field: Any) -> ParameterDescriptor:
    """Documentation and range for parameter tools; dynamic typing lets from_mapping name what is wrong."""
    low, high = field.metadata.get("low"), field.metadata.get("high")
    descriptor = ParameterDescriptor(
        description=field.metadata.get("doc", ""), read_only=True, dynamic_typing=True
    )
    if low is not None and high is not None and isinstance(field.default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
        ]
    elif low is not None and high is not None and isinstance(field.default, int):
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return descriptor


def declare_config(node: Node, cls: type[ConfigT], defaults: Mapping[str, Any] | None = None) -> ConfigT:
    """Declare every field of a config dataclass as a read-only ROS parameter and read them.

    ``defaults`` stand in for those of the fields. Raises ConfigError with one line naming parameter, value
    and range.
    """
    values: dict[str, Any] = {}
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    for field in fields:
        default = (defaults or {}).get(field.name, field.default)
        default = list(default) if isinstance(default, tuple) else default
        value = node.declare_parameter(field.name, default, ParameterDescriptor(dynamic_typing=True)).value
        values[field.name] = list(value) if hasattr(value, "typecode") else value
    config = from_mapping(cls, values)
    for field in fields:  # only now: rclpy would refuse a value out of range without saying which
        node.set_descriptor(field.name, _descriptor(field))
    return config


class Diagnostics:
    """The state of one node on /diagnostics: at once when it changes, and every second."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._values: dict[str, object] = {}
        self._publisher = node.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, qos.SENSOR)
        self._status = DiagnosticStatus(level=DiagnosticStatus.OK, message="waiting for input")
        self._status.name = self._status.hardware_id = node.get_name()
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(DIAGNOSTICS_PERIOD_S, self._publish, clock=clock)

    def report(self, level: bytes, message: str, **values: object) -> None:
        """Set level (DiagnosticStatus.OK, WARN, ERROR) and message; figures stay until they are set again."""
        changed = (level, message) != (self._status.level, self._status.message)
        self._values.update(values)
        status = DiagnosticStatus(level=level, message=message)
        status.name = status.hardware_id = self._node.get_name()
        status.values = [KeyValue(key=key, value=_text(value)) for key, value in self._values.items()]
        self._status = status
        if changed:
            self._publish()

    def _publish(self) -> None:
        array = DiagnosticArray(status=[self._status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class Worker:
    """Does one thing after another on a thread of its own, so that messages keep being received; what came
    of each is told on the node's executor, in order."""

    def __init__(self, node: Node, name: str) -> None:
        self._name = name
        self._pool = ThreadPoolExecutor(1, name)
        self._done: deque[Callable[[], None]] = deque()
        self._finished = node.create_guard_condition(self._on_finished)

    def submit(self, work: Callable[[], Result], tell: Callable[[Future[Result]], None]) -> None:
        """Do ``work``, then ``tell`` its future, which is done."""

        def finished(future: Future[Result]) -> None:
            self._done.append(lambda: tell(future))
            self._finished.trigger()

        self._pool.submit(work).add_done_callback(finished)

    def _on_finished(self) -> None:
        while self._done:
            self._done.popleft()()

    def forget(self) -> None:
        """End what runs, give up what waits; nothing of it is told."""
        self.shutdown()
        self._pool = ThreadPoolExecutor(1, self._name)
        self._done.clear()

    def shutdown(self) -> None:
        """End what runs, give up what waits."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def subscribe_telemetry(node: Node, take: Callable[[str, Any], None]) -> None:
    """Call ``take`` with topic and message of everything that goes with an image."""
    for kind, topic in (
        (CameraInfo, topics.CAMERA_INFO),
        (Range, topics.ALTITUDE),
        (QuaternionStamped, topics.GIMBAL_ATTITUDE),
    ):
        node.create_subscription(kind, topic, partial(take, topic), qos.TELEMETRY)


class FrameAssembler:
    """Subscribes to images and telemetry; calls ``on_frame`` with each complete frame.

    What makes an image unusable is reported as a warning, counted in ``faults``, and the node stays up.
    """

    def __init__(self, node: Node, on_frame: Callable[[Frame], None], diagnostics: Diagnostics) -> None:
        self.frames = 0
        self.faults = 0
        self.pairing = FramePairing()
        self._on_frame = on_frame
        self._diagnostics = diagnostics
        self._messages = self._messages_before = 0
        for kind, topic in ((Image, topics.IMAGE), (CompressedImage, topics.IMAGE_COMPRESSED)):
            node.create_subscription(kind, topic, partial(self._on_message, topic), qos.SENSOR)
        subscribe_telemetry(node, self._on_message)
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(FLUSH_PERIOD_S, self._on_timer, clock=clock)

    def _on_message(self, topic: str, message: Any) -> None:
        self._messages += 1
        self._deliver(self.pairing.add(topic, message))

    def _on_timer(self) -> None:
        """Let waiting images go after a whole period without any message: the telemetry has stopped."""
        if self._messages == self._messages_before:
            self._deliver(self.pairing.flush())
        self._messages_before = self._messages

    def _deliver(self, results: list[Frame | FrameFault]) -> None:
        for result in results:
            if isinstance(result, FrameFault):
                self.faults += 1
                self._diagnostics.report(
                    DiagnosticStatus.WARN, result.reason, frames=self.frames, frames_unusable=self.faults
                )
            else:
                self.frames += 1
                self._on_frame(result)


def run_node(make: Callable[[], Node]) -> int:
    """Initialise ROS, spin the node until SIGINT or shutdown; the exit status (2: it refused to start)."""
    rclpy.init()
    try:
        node = make()
    except BuildlocError as error:
        print(f"error: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0
