"""Plays a bag into live topics: serialized messages as they are, at a rate, with /clock."""

from __future__ import annotations

import importlib
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from buildloc_msgs_py import qos, topics, wire
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import Keyframe, LocalMap
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Path as PathMessage
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from buildloc.bag import IMAGES, TELEMETRY, open_bag, raw_messages, require_topics
from buildloc.settings import MAPPER, MATCHER, NODES, REFERENCE_DB, SEGMENTER, Settings
from buildloc.supervisor import Supervisor, dds_environment, failures
from buildloc.timing import Timing, timing

START_TIMEOUT_S = 90.0
STALL_TIMEOUT_S = 60.0
CLOCK_PERIOD_S = 0.05
POLL_S = 0.02
SETTLE_S = 0.5  # a subscription is seen here a moment before it can hear
SUBSCRIBERS = {**dict.fromkeys(IMAGES, 2), **dict.fromkeys(TELEMETRY, 3)}


class ReplayError(BuildlocError):
    """The replay could not be carried out."""


@dataclass(frozen=True)
class ReplayReport:
    """Images published, frames the segmenter took or refused, keyframes masked and those lost because a node
    was too slow, maps, and maps overtaken.
    """

    images: int
    frames: int
    frames_unusable: int
    keyframes: int
    keyframes_lost: int
    maps: int
    maps_answered: int
    maps_skipped: int
    seconds: float

    @property
    def dropped(self) -> int:
        """Images that reached no node."""
        return self.images - self.frames - self.frames_unusable


@dataclass(frozen=True)
class Replay:
    """What came of a replay: the figures, how often and how late fixes came (None without any), and the
    latest map with its keyframes (None, () without one)."""

    report: ReplayReport
    timing: Timing | None
    local_map: LocalMap | None
    keyframes: tuple[Keyframe, ...]


class ReplayNode(Node):  # type: ignore[misc]
    """Publishers for what the bag holds, and the nodes' latest diagnostics."""

    def __init__(self, context: Context) -> None:
        super().__init__("replay", context=context)
        self.levels: dict[str, bytes] = {}
        self.figures: dict[str, dict[str, str]] = {}
        self.messages: dict[str, str] = {}
        self._clock = self.create_publisher(Clock, "/clock", 10)
        self.outputs: dict[str, Any] = {}
        self.latest: dict[str, Any] = {}
        self.create_subscription(
            PointCloud2, topics.MAP, partial(self.latest.__setitem__, topics.MAP), qos.SENSOR
        )
        self.create_subscription(
            PathMessage, topics.KEYFRAMES, partial(self.latest.__setitem__, topics.KEYFRAMES), qos.SENSOR
        )
        self.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, qos.SENSOR)

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            self.levels[status.name], self.messages[status.name] = status.level, status.message
            self.figures[status.name] = {value.key: value.value for value in status.values}

    def offer(self, topic: str, message_type: str) -> bool:
        """Create the publisher of a recorded topic; False when its message type is not installed."""
        package, _, name = message_type.partition("/msg/")
        try:
            cls = getattr(importlib.import_module(f"{package}.msg"), name)
        except (ImportError, AttributeError):
            return False
        profile = qos.SENSOR if topic.lstrip("/") in IMAGES else qos.TELEMETRY
        self.outputs[topic] = self.create_publisher(cls, topic, profile)
        return True

    def tick(self, time_ns: int) -> None:
        """Publish /clock."""
        self._clock.publish(Clock(clock=Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)))

    def count(self, node: str, key: str) -> int:
        """A figure from a node's diagnostics, 0 before it was reported."""
        return int(float(self.figures.get(node, {}).get(key, "0")))

    def connected(self) -> bool:
        """Whether the nodes subscribe to all inputs that are offered."""
        wanted = ((self.outputs.get(f"/{topic}"), n) for topic, n in SUBSCRIBERS.items())
        return all(
            publisher.get_subscription_count() >= n for publisher, n in wanted if publisher is not None
        )

    def ready(self) -> bool:
        """Whether all nodes speak and the reference was loaded or refused."""
        loaded = self.levels.get(MATCHER) == DiagnosticStatus.OK and self.figures[MATCHER].get("database")
        settled = loaded or self.levels.get(REFERENCE_DB) != DiagnosticStatus.OK
        return all(name in self.levels for name in NODES) and self.connected() and bool(settled)

    def report(self, images: int, seconds: float) -> ReplayReport:
        """The figures of the nodes now."""
        lost = (self.count(SEGMENTER, key) for key in ("keyframes_dropped", "keyframes_failed"))
        return ReplayReport(
            images, self.count(SEGMENTER, "frames"), self.count(SEGMENTER, "frames_unusable"),
            self.count(SEGMENTER, "keyframes"), sum(lost) + self.count(MAPPER, "masks_without_image"),
            self.count(MAPPER, "maps"),
            self.count(MATCHER, "maps_answered"), self.count(MATCHER, "maps_skipped"), seconds,
        )  # fmt: skip

    def drained(self, images: int) -> bool:
        """Whether every image published has gone all the way through."""
        now = self.report(images, 0.0)
        return (
            now.dropped <= 0
            and self.count(MAPPER, "masks") + self.count(MAPPER, "masks_without_image") >= now.keyframes
            and now.maps_answered + now.maps_skipped >= now.maps
        )


def _spin(executor: SingleThreadedExecutor) -> None:
    with suppress(ExternalShutdownException):
        executor.spin()


def _wait(condition: Callable[[], bool], timeout_s: float, alive: Callable[[], None]) -> bool:
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        alive()
        if condition():
            return True
        time.sleep(POLL_S)
    return False


def _stamp_ns(data: bytes) -> int:
    """The header's stamp of a serialized message that begins with one."""
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def _play(node: ReplayNode, bag: Path, rate: float, alive: Callable[[], None]) -> dict[int, int]:
    """Publish everything in time; returns when each image was published, ns by the clock on the wall, by
    its stamp."""
    published: dict[int, int] = {}
    with open_bag(bag) as reader:
        started, first_ns = time.monotonic(), reader.start_time
        for connection, stamp_ns, data in raw_messages(reader, bag):
            publisher = node.outputs.get(connection.topic)
            if publisher is None:
                continue
            due = started + (stamp_ns - first_ns) * 1e-9 / rate
            while (wait := due - time.monotonic()) > 0.0:
                alive()
                node.tick(int(stamp_ns - wait * rate * 1e9))
                time.sleep(min(wait, CLOCK_PERIOD_S))
            node.tick(stamp_ns)
            if connection.topic.lstrip("/") in IMAGES:
                published.setdefault(_stamp_ns(data), time.time_ns())
            publisher.publish(bytes(data))
    return published


def _drain(node: ReplayNode, images: int, alive: Callable[[], None]) -> None:
    """Wait until the nodes have worked through everything, or make no progress for a long time."""
    progress, since = node.report(images, 0.0), time.monotonic()
    while not node.drained(images) and time.monotonic() - since < STALL_TIMEOUT_S:
        alive()
        time.sleep(POLL_S)
        if (now := node.report(images, 0.0)) != progress:
            progress, since = now, time.monotonic()
    if not node.drained(images):
        print(f"warning: the nodes left work undone: {progress}", file=sys.stderr)


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """SIGTERM leaves the block as an exception, so that processes that were started are stopped."""
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def replay(bag: Path, settings: Settings | None, rate: float, folder: Path, fixes: Path) -> Replay:
    """Play a bag into the node graph and record /buildloc/fix with a process of its own.

    ``settings`` None: the nodes are someone else's and run already. ``folder`` takes the parameter file,
    ``fixes`` the JSON lines of the listener. Raises BagError, or ReplayError when a node dies.
    """
    if not rate > 0.0:
        raise ReplayError(f"rate {rate:g} is not positive; 1 is real time")
    with open_bag(bag) as reader:
        require_topics(reader, bag)
        recorded = {c.topic: c.msgtype for c in reader.connections if not c.topic.startswith("/buildloc/")}
    with ExitStack() as stack:
        stack.enter_context(ended_by_sigterm())
        supervisor = None if settings is None else stack.enter_context(Supervisor(settings, folder))
        listener = subprocess.Popen(
            [sys.executable, "-m", "buildloc.fix_listener", "--out", str(fixes)],
            env=dds_environment(), start_new_session=True,
        )  # fmt: skip
        stack.callback(listener.wait)
        stack.callback(listener.send_signal, signal.SIGINT)

        def alive() -> None:
            died = failures(supervisor.dead()) if supervisor is not None else []
            if supervisor is not None and supervisor.dead():
                raise ReplayError("; ".join(died) or "a node ended early; see its output above")

        context = Context()
        rclpy.init(context=context)
        node = ReplayNode(context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        thread = threading.Thread(target=_spin, args=(executor,), name="replay")
        thread.start()
        try:
            for topic, message_type in sorted(recorded.items()):
                if not node.offer(topic, message_type):
                    print(f"warning: {topic} is not played: {message_type} is not installed", file=sys.stderr)
            ready = node.ready if supervisor is not None else node.connected
            if not _wait(ready, START_TIMEOUT_S, alive):
                raise ReplayError("the nodes did not come up in time; see their output above")
            time.sleep(SETTLE_S)
            started = time.monotonic()
            published_ns = _play(node, bag, rate, alive)
            _drain(node, len(published_ns), alive)
            report = node.report(len(published_ns), time.monotonic() - started)
            recorded_map, path = node.latest.get(topics.MAP), node.latest.get(topics.KEYFRAMES)
            return Replay(
                report,
                timing(fixes, published_ns),
                None if recorded_map is None else wire.decode_map(recorded_map),
                () if path is None else wire.decode_keyframes(path),
            )
        finally:
            rclpy.try_shutdown(context=context)
            thread.join()
