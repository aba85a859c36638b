"""/buildloc/map, keyframes, track and mask in; candidates, fix and pose out.

A fix is published exactly once, in the order of the images, with the capture time of its own. While there
is none, NO_FIX goes out at 1 Hz, and at once when a place is withdrawn; /diagnostics says why. Solving has a
thread of its own, so that a slow solve stops neither tracked fixes nor the NO_FIX.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any

from buildloc_msgs_py import encode, qos, topics, wire
from buildloc_msgs_py.ros_node import Diagnostics, Worker, declare_config, run_node, subscribe_telemetry
from buildloc_msgs_py.types import Fix, NoFix
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Image, NavSatFix, PointCloud2
from std_msgs.msg import Empty, String

from buildloc_matcher.config import DEFAULT, MatcherConfig, check_matcher, preset_values
from buildloc_matcher.matcher import Answer
from buildloc_matcher.pace import Pace
from buildloc_matcher.session import Job, Session

NO_FIX_PERIOD_S = 1.0


class MatcherNode(Node):  # type: ignore[misc]
    """Answers every map and every tracked frame with a fix or a reason."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("matcher_node", **kwargs)
        preset = preset_values(str(self.declare_parameter("preset", DEFAULT).value))
        self.session = Session(check_matcher(declare_config(self, MatcherConfig, preset)))
        self.diagnostics = Diagnostics(self)
        self._worker = Worker(self, "solve")
        self._solving = self._fixed = False
        self._next: Job | None = None
        self._answered = self._fixes = self._withdrawals = 0
        self._pace = Pace()
        self._funnel: dict[str, float] = {}
        self._candidates = self.create_publisher(PointCloud2, topics.CANDIDATES, qos.SENSOR)
        self._fix = self.create_publisher(NavSatFix, topics.FIX, qos.SENSOR)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, topics.POSE, qos.SENSOR)
        subscribe_telemetry(self, self.session.telemetry.add)
        for kind, topic, handle in (
            (Image, topics.MASK, self._on_mask),
            (PointCloud2, topics.MAP, self._on_map),
            (Path, topics.KEYFRAMES, self._on_keyframes),
            (PoseWithCovarianceStamped, topics.TRACK, self._on_track),
            (Empty, topics.RESET_DONE, self._on_reset),
        ):
            self.create_subscription(kind, topic, partial(self._guarded, handle), qos.SENSOR)
        self.create_subscription(String, topics.REFERENCE_DATABASE, self._on_database, qos.LATCHED)
        self.create_timer(NO_FIX_PERIOD_S, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _guarded(self, handle: Callable[[Any], None], message: Any) -> None:
        try:
            handle(message)
        except wire.WireError as error:
            self.diagnostics.report(DiagnosticStatus.WARN, str(error))

    def _on_mask(self, message: Image) -> None:
        self._submit(self.session.add_mask(wire.decode_mask(message)))

    def _on_map(self, message: PointCloud2) -> None:
        self._submit(self.session.add_map(wire.decode_map(message)))

    def _on_keyframes(self, message: Path) -> None:
        self._submit(self.session.add_keyframes(wire.decode_keyframes(message)))
        self._give(self.session.waiting())

    def _on_track(self, message: PoseWithCovarianceStamped) -> None:
        self._give(self.session.locate(wire.decode_tracked(message)))

    def _on_reset(self, message: Empty) -> None:
        self._next, self._fixed = None, False
        self.session.reset()
        self._pace.reset()

    def _on_database(self, message: String) -> None:
        self._worker.submit(partial(self.session.load, message.data), self._on_loaded)

    def _on_loaded(self, done: Future[bool]) -> None:
        if done.result():
            self.get_logger().info(f"reference database {self.session.database_path} loaded")
        else:
            self.get_logger().error(self.session.reason)

    def _submit(self, job: Job | None) -> None:
        """Solve the job next; one that still waits is overtaken, so that answers never lag behind."""
        if job is not None:
            self.session.maps_skipped += self._next is not None
            self._next = job
            self._solve_next()

    def _solve_next(self) -> None:
        job = self._next
        if job is not None and not self._solving:
            self._next, self._solving = None, True
            self._worker.submit(partial(self.session.solve, job), partial(self._on_solved, job))

    def _on_solved(self, job: Job, done: Future[Answer]) -> None:
        self._solving = False
        self._answered += 1
        if (error := done.exception()) is not None:
            self.session.failed(f"solving failed: {type(error).__name__}: {error}")
            self.get_logger().error(self.session.waiting().reason)
        elif job.flight == self.session.flight:
            self._funnel = (answer := done.result()).funnel
            self._candidates.publish(encode.encode_candidates(answer.candidates, job.local_map.stamp_ns))
            self._give(answer.result)
        self._solve_next()

    def _give(self, result: Fix | NoFix) -> None:
        """Publish a fix unless a later one is out; the lack of one only when a place was just withdrawn."""
        if (seeker := self.session.seeker) is None:
            return
        if self._withdrawals != seeker.withdrawals:
            self._withdrawals = seeker.withdrawals
            self._fix.publish(encode.encode_fix(self.session.waiting()))
        if isinstance(result, Fix) and seeker.fresh(result):
            self._fixed, self._fixes = True, self._fixes + 1
            self._fix.publish(encode.encode_fix(result))
            self._pose.publish(encode.encode_pose(result))
            late_ns = self.get_clock().now().nanoseconds - result.stamp_ns
            self._pace.add(time.monotonic(), 1e-9 * late_ns)

    def _on_tick(self) -> None:
        if not self._fixed:
            self._fix.publish(encode.encode_fix(self.session.waiting()))
        level = DiagnosticStatus.OK if self.session.seeker is not None else DiagnosticStatus.ERROR
        self.diagnostics.report(
            level, "fix" if self._fixed else f"no fix: {self.session.waiting().reason}",
            maps_answered=self._answered, fixes=self._fixes, **self.session.figures(),
            **self._pace.figures(), **self._funnel,
        )  # fmt: skip
        self._fixed = False

    def destroy_node(self) -> None:
        """Let the running solve end first."""
        self._worker.shutdown()
        super().destroy_node()


def main() -> int:
    """Entry point."""
    return int(run_node(MatcherNode))


if __name__ == "__main__":
    sys.exit(main())
