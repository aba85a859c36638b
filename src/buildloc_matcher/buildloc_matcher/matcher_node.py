"""/buildloc/map, keyframes and mask in; candidates, fix and pose out.

An accepted fix is published exactly once, with the capture time of its image. While there is none,
NO_FIX goes out at 1 Hz and /diagnostics says why. Solving runs on one worker thread, so that a slow
solve never stops the NO_FIX.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from buildloc_msgs_py import encode, qos, topics, wire
from buildloc_msgs_py.ros_node import Diagnostics, declare_config, run_node
from buildloc_msgs_py.types import Fix
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, QuaternionStamped
from nav_msgs.msg import Path
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, NavSatFix, PointCloud2, Range
from std_msgs.msg import Empty, String

from buildloc_matcher.config import DEFAULT, MatcherConfig, check_matcher, preset_values
from buildloc_matcher.session import Job, Session

NO_FIX_PERIOD_S = 1.0


class MatcherNode(Node):  # type: ignore[misc]
    """Answers every map with a fix or a reason."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("matcher_node", **kwargs)
        preset = preset_values(str(self.declare_parameter("preset", DEFAULT).value))
        self.session = Session(check_matcher(declare_config(self, MatcherConfig, preset)))
        self.diagnostics = Diagnostics(self)
        self._lock = threading.Lock()
        self._worker = ThreadPoolExecutor(1, "solve")
        self._fixed = False
        self._next: Job | None = None
        self._answered = self._fixes = 0
        self._funnel: dict[str, float] = {}
        self._candidates = self.create_publisher(PointCloud2, topics.CANDIDATES, qos.SENSOR)
        self._fix = self.create_publisher(NavSatFix, topics.FIX, qos.SENSOR)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, topics.POSE, qos.SENSOR)
        telemetry = self.session.telemetry.add
        for kind, topic, profile, handle in (
            (CameraInfo, topics.CAMERA_INFO, qos.TELEMETRY, partial(telemetry, topics.CAMERA_INFO)),
            (Range, topics.ALTITUDE, qos.TELEMETRY, partial(telemetry, topics.ALTITUDE)),
            (
                QuaternionStamped,
                topics.GIMBAL_ATTITUDE,
                qos.TELEMETRY,
                partial(telemetry, topics.GIMBAL_ATTITUDE),
            ),
            (Image, topics.MASK, qos.SENSOR, partial(self._guarded, self._on_mask)),
            (PointCloud2, topics.MAP, qos.SENSOR, partial(self._guarded, self._on_map)),
            (Path, topics.KEYFRAMES, qos.SENSOR, partial(self._guarded, self._on_keyframes)),
            (Empty, topics.RESET_DONE, qos.SENSOR, lambda _: self.session.reset()),
            (String, topics.REFERENCE_DATABASE, qos.LATCHED, self._on_database),
        ):
            self.create_subscription(kind, topic, handle, profile)
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

    def _on_database(self, message: String) -> None:
        self._worker.submit(self._load, message.data)

    def _load(self, path: str) -> None:
        if self.session.load(path):
            self.get_logger().info(f"reference database {path} loaded")
        else:
            self.get_logger().error(self.session.reason)

    def _submit(self, job: Job | None) -> None:
        """Solve the job next; one that still waits is overtaken, so that answers never lag behind."""
        if job is None:
            return
        with self._lock:
            overtaken, self._next = self._next, job
            self.session.maps_skipped += overtaken is not None
        if overtaken is None:
            self._worker.submit(self._solve_next)

    def _solve_next(self) -> None:
        with self._lock:
            job, self._next = self._next, None
        if job is not None:
            self._solve(job)
            self._answered += 1

    def _solve(self, job: Job) -> None:
        try:
            answer = self.session.solve(job)
        except Exception as error:
            self.session.reason = f"solving failed: {type(error).__name__}: {error}"
            self.get_logger().error(self.session.reason)
            return
        self._funnel = answer.funnel
        self._candidates.publish(encode.encode_candidates(answer.candidates, job.local_map.stamp_ns))
        if isinstance(answer.result, Fix):
            with self._lock:
                self._fixed, self._fixes = True, self._fixes + 1
                self._fix.publish(encode.encode_fix(answer.result))
                self._pose.publish(encode.encode_pose(answer.result))

    def _on_tick(self) -> None:
        with self._lock:
            if not self._fixed:
                self._fix.publish(encode.encode_fix(self.session.waiting()))
            fixed, self._fixed = self._fixed, False
        session = self.session
        level = DiagnosticStatus.OK if session.matcher is not None else DiagnosticStatus.ERROR
        self.diagnostics.report(
            level,
            "fix" if fixed else f"no fix: {session.waiting().reason}",
            database=session.database_path,
            maps_answered=self._answered,
            fixes=self._fixes,
            frames_unusable=session.frames_unusable,
            maps_skipped=session.maps_skipped,
            **self._funnel,
        )

    def destroy_node(self) -> None:
        """Let the running solve end first."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        super().destroy_node()


def main() -> int:
    """Entry point."""
    return int(run_node(MatcherNode))


if __name__ == "__main__":
    sys.exit(main())
