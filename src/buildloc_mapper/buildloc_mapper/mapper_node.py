"""Images with telemetry and /buildloc/mask in; /buildloc/map, /buildloc/keyframes and /buildloc/track out.

Keyframes are added on one thread and frames are tracked on another, so that neither waits for the other.
"""

from __future__ import annotations

import sys
from concurrent.futures import Future
from typing import Any

from buildloc_msgs_py import encode, qos, topics, wire
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ros_node import Diagnostics, FrameAssembler, Worker, declare_config, run_node
from buildloc_msgs_py.types import Frame, Mask, Tracked
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Empty
from std_srvs.srv import Trigger

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.mapper import Mapper, MapUpdate
from buildloc_mapper.tracking import Lost

LOG_PERIOD_S = 5.0  # of the same complaint
FRAMES_KEPT = 100  # that wait for a mask; a busy segmenter may lag by seconds


class MapperNode(Node):  # type: ignore[misc]
    """Adds every masked keyframe to the map and publishes both; publishes where the frames between are."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("mapper_node", **kwargs)
        self._mapper = Mapper(declare_config(self, MapperConfig))
        self._diagnostics = Diagnostics(self)
        self._frames: dict[int, Frame] = {}
        self._masks: dict[int, Mask] = {}
        self._mapping, self._tracking = Worker(self, "map"), Worker(self, "track")
        self._untracked: Frame | None = None  # the newest frame, while another is tracked
        self._tracks = False
        self._received = self._published = self._dropped = self._refused = 0
        self._tracked = self._lost = self._skipped = 0
        self._map = self.create_publisher(PointCloud2, topics.MAP, qos.SENSOR)
        self._keyframes = self.create_publisher(Path, topics.KEYFRAMES, qos.SENSOR)
        self._track = self.create_publisher(PoseWithCovarianceStamped, topics.TRACK, qos.SENSOR)
        self._assembler = FrameAssembler(self, self._on_frame, self._diagnostics)
        self.create_subscription(Image, topics.MASK, self._on_mask, qos.SENSOR)
        self.create_service(Trigger, topics.RESET, self._on_reset)
        self._reset_done = self.create_publisher(Empty, topics.RESET_DONE, qos.SENSOR)

    def _on_frame(self, frame: Frame) -> None:
        self._frames[frame.stamp_ns] = frame
        self._add(frame.stamp_ns)
        self._skipped += self._untracked is not None
        self._untracked = frame
        self._track_next()

    def _track_next(self) -> None:
        """Track the newest frame; those that came while another was tracked are overtaken."""
        if self._tracks or self._untracked is None:
            return
        frame, self._untracked, self._tracks = self._untracked, None, True
        self._tracking.submit(lambda: self._mapper.track(frame), self._on_tracked)

    def _on_tracked(self, done: Future[Tracked | Lost]) -> None:
        self._tracks = False
        try:
            answer = done.result()
        except BuildlocError as error:
            self._refuse(error)
        else:
            if isinstance(answer, Tracked):
                self._track.publish(encode.encode_tracked(answer))
            self._tracked += isinstance(answer, Tracked)
            self._lost += not isinstance(answer, Tracked)
        self._track_next()

    def _on_mask(self, message: Image) -> None:
        try:
            mask = wire.decode_mask(message)
        except wire.WireError as error:
            self._report(DiagnosticStatus.WARN, str(error))
            return
        self._masks[mask.stamp_ns] = mask
        self._add(mask.stamp_ns)

    def _add(self, stamp_ns: int) -> None:
        """Add a keyframe once its image and its mask are both here."""
        newest_mask = max(self._masks, default=0)
        if stamp_ns in self._frames and stamp_ns in self._masks:
            frame, mask = self._frames.pop(stamp_ns), self._masks.pop(stamp_ns)
            self._mapping.submit(lambda: self._mapper.add(frame, mask), self._on_mapped)
        for passed in [frame for frame in self._frames if frame < newest_mask]:  # masks come in order
            del self._frames[passed]
        while len(self._frames) > FRAMES_KEPT:
            self._frames.pop(next(iter(self._frames)))
        newest = next(reversed(self._frames), 0)
        for late in [mask for mask in self._masks if mask < newest]:  # images are in order: its own is gone
            del self._masks[late]
            self._dropped += 1
            self._report(DiagnosticStatus.WARN, "a mask came too late for its image; use a faster network")

    def _on_mapped(self, done: Future[MapUpdate | None]) -> None:
        self._received += 1
        try:
            update = done.result()
        except BuildlocError as error:
            self._refuse(error)
            return
        if update is None:
            self._report(DiagnosticStatus.WARN, "keyframe links to none of the latest keyframes")
            return
        self._keyframes.publish(encode.encode_keyframes(update.keyframes))
        self._map.publish(encode.encode_map(update.local_map))
        self._published += 1
        self._report(DiagnosticStatus.OK, "mapping", **update.funnel)

    def _refuse(self, error: BuildlocError) -> None:
        self._refused += 1
        self.get_logger().warning(f"frame skipped: {error}", throttle_duration_sec=LOG_PERIOD_S)
        self._report(DiagnosticStatus.WARN, str(error))

    def _report(self, level: bytes, message: str, **figures: float) -> None:
        counts = {
            "masks": self._received, "maps": self._published, "masks_without_image": self._dropped,
            "frames_tracked": self._tracked, "frames_lost": self._lost, "frames_skipped": self._skipped,
            "frames_refused": self._refused,
        }  # fmt: skip
        self._diagnostics.report(level, message, **counts, **figures)

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        for worker in (self._mapping, self._tracking):
            worker.forget()
        self._untracked, self._tracks = None, False
        self._mapper.reset()
        self._assembler.pairing.reset()
        self._frames.clear()
        self._masks.clear()
        self._reset_done.publish(Empty())
        self._report(DiagnosticStatus.OK, "flight forgotten")
        response.success, response.message = True, "flight forgotten; the reference is kept"
        return response

    def destroy_node(self) -> None:
        """Let what runs end first."""
        for worker in (self._mapping, self._tracking):
            worker.shutdown()
        super().destroy_node()


def main() -> int:
    """Entry point."""
    return int(run_node(MapperNode))


if __name__ == "__main__":
    sys.exit(main())
