"""/buildloc/map, keyframes, track and mask in; candidates, fix and pose out.

A fix is published exactly once, in the order of the images, with the capture time of its own. While there
is none, NO_FIX goes out at 1 Hz, and at once when a place is withdrawn; /diagnostics says why. Solving runs
on one worker thread, so that a slow solve stops neither tracked fixes nor the NO_FIX.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from buildloc_msgs_py import encode, qos, topics, wire
from buildloc_msgs_py.ros_node import Diagnostics, declare_config, run_node
from buildloc_msgs_py.types import Fix, NoFix
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
FIXES_KEPT = 50  # whose rate and latency are told


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
        self._answered = self._fixes = self._withdrawals = 0
        self._recent: deque[tuple[float, float]] = deque(maxlen=FIXES_KEPT)  # when and how late, s
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
            (PoseWithCovarianceStamped, topics.TRACK, qos.SENSOR, partial(self._guarded, self._on_track)),
            (Empty, topics.RESET_DONE, qos.SENSOR, self._on_reset),
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
        self._give(self.session.waiting())

    def _on_track(self, message: PoseWithCovarianceStamped) -> None:
        self._give(self.session.locate(wire.decode_tracked(message)))

    def _on_reset(self, message: Empty) -> None:
        self.session.reset()
        self._recent.clear()

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
            reason = f"solving failed: {type(error).__name__}: {error}"
            self.get_logger().error(reason)
            if self.session.seeker is not None:
                self.session.seeker.reason = reason
            return
        self._funnel = answer.funnel
        self._candidates.publish(encode.encode_candidates(answer.candidates, job.local_map.stamp_ns))
        self._give(answer.result)

    def _give(self, result: Fix | NoFix) -> None:
        """Publish a fix unless a later one is out; the lack of one only when a place was just withdrawn."""
        seeker = self.session.seeker
        if seeker is None:
            return
        with self._lock:
            if isinstance(result, Fix) and seeker.fresh(result):
                self._fixed, self._fixes = True, self._fixes + 1
                self._fix.publish(encode.encode_fix(result))
                self._pose.publish(encode.encode_pose(result))
                late_ns = self.get_clock().now().nanoseconds - result.stamp_ns
                self._recent.append((time.monotonic(), late_ns * 1e-9))
            elif self._withdrawals != seeker.withdrawals:
                self._fix.publish(encode.encode_fix(self.session.waiting()))
            self._withdrawals = seeker.withdrawals

    def _on_tick(self) -> None:
        with self._lock:
            if not self._fixed:
                self._fix.publish(encode.encode_fix(self.session.waiting()))
            fixed, self._fixed = self._fixed, False
        session = self.session
        level = DiagnosticStatus.OK if session.seeker is not None else DiagnosticStatus.ERROR
        self.diagnostics.report(
            level,
            "fix" if fixed else f"no fix: {session.waiting().reason}",
            database=session.database_path,
            maps_answered=self._answered,
            fixes=self._fixes,
            frames_unusable=session.frames_unusable,
            maps_skipped=session.maps_skipped,
            **self._tracking(),
            **self._funnel,
        )

    def _tracking(self) -> dict[str, object]:
        """How the pursuit stands, and rate and latency of the latest fixes."""
        if (seeker := self.session.seeker) is None:
            return {}
        pursuit = seeker.pursuit
        with self._lock:
            recent = list(self._recent)
        span_s = recent[-1][0] - recent[0][0] if len(recent) > 1 else 0.0
        late_s = sorted(late for _, late in recent)
        return {
            "mode": pursuit.mode.value,
            "since_agreement_m": pursuit.since_agreement_m,
            "withdrawals": seeker.withdrawals,
            "withdrawn": pursuit.withdrawn,
            "fixes_per_second": (len(recent) - 1) / span_s if span_s > 0.0 else 0.0,
            "latency_p95_seconds": late_s[int(0.95 * len(late_s))] if late_s else 0.0,
        }

    def destroy_node(self) -> None:
        """Let the running solve end first."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        super().destroy_node()


def main() -> int:
    """Entry point."""
    return int(run_node(MatcherNode))


if __name__ == "__main__":
    sys.exit(main())
