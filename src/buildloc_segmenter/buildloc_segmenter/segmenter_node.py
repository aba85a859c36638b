"""Images with telemetry in; /buildloc/mask out.

Inference runs on one worker thread, so that a slow network never keeps images from being received.
Keyframes that it cannot keep up with are dropped, the oldest first, counted and reported. The network is
warm when the node is there: nothing is received or reported before.
"""

from __future__ import annotations

import sys
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from time import perf_counter
from typing import Any

from buildloc_msgs_py import encode, qos, topics
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ros_node import Diagnostics, FrameAssembler, declare_config, run_node
from buildloc_msgs_py.types import Frame, Mask
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Empty

from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.segmenter import Segmenter

KEYFRAMES_WAITING = 8
FINE = (DiagnosticStatus.OK, "segmenting")
FORGOTTEN = (DiagnosticStatus.OK, "flight forgotten")
TOO_SLOW = (
    DiagnosticStatus.WARN,
    "a keyframe was dropped, inference is slower than they come; use a faster network or provider",
)


class SegmenterNode(Node):  # type: ignore[misc]
    """Masks every keyframe."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("segmenter_node", **kwargs)
        self._segmenter = Segmenter(declare_config(self, SegmenterConfig))
        self._segmenter.warm_up()
        self._diagnostics = Diagnostics(self)
        self._worker = ThreadPoolExecutor(1, "segment")
        self._waiting: deque[Frame] = deque()
        self._job: Future[tuple[Mask, float]] | None = None
        self._keyframes = self._dropped = self._failed = 0
        self._inference_ms = 0.0
        self._state = self._fine = FINE
        self._masks = self.create_publisher(Image, topics.MASK, qos.SENSOR)
        self._finished = self.create_guard_condition(self._on_finished)
        self._assembler = FrameAssembler(self, self._on_frame, self._diagnostics)
        self.create_subscription(Empty, topics.RESET_DONE, self._on_reset, qos.SENSOR)

    def _on_frame(self, frame: Frame) -> None:
        if self._segmenter.select(frame):
            doubt = self._segmenter.doubt(frame)
            self._fine = FINE if doubt is None else (DiagnosticStatus.WARN, doubt)
            self._waiting.append(frame)
            self._keyframes += 1  # before its mask is there: whoever counts masks knows that one is to come
            self._start_next()
        if len(self._waiting) > KEYFRAMES_WAITING:
            self._waiting.popleft()
            self._keyframes -= 1
            self._dropped += 1
            self._state = TOO_SLOW
        self._report()

    def _start_next(self) -> None:
        if self._job is None and self._waiting:
            self._job = self._worker.submit(self._segment, self._waiting.popleft())
            self._job.add_done_callback(lambda _: self._finished.trigger())

    def _segment(self, frame: Frame) -> tuple[Mask, float]:
        """On the worker: the mask and its milliseconds."""
        started = perf_counter()
        return self._segmenter.segment(frame), 1e3 * (perf_counter() - started)

    def _on_finished(self) -> None:
        if self._job is None or not self._job.done():
            return
        error = self._job.exception()
        if error is None:
            mask, self._inference_ms = self._job.result()
            self._masks.publish(encode.encode_mask(mask))
            self._state = self._fine
        else:
            self._keyframes -= 1
            self._failed += 1
            name = "" if isinstance(error, BuildlocError) else f"{type(error).__name__}: "
            self._state = (DiagnosticStatus.ERROR, f"segmentation failed: {name}{error}")
        self._job = None
        self._start_next()
        self._report()

    def _on_reset(self, message: Empty) -> None:
        self._segmenter.reset()
        self._assembler.pairing.reset()
        self._state = FORGOTTEN
        self._report()

    def _report(self) -> None:
        level, message = self._state
        self._diagnostics.report(
            level, message, frames=self._assembler.frames, keyframes=self._keyframes,
            keyframes_waiting=len(self._waiting) + (self._job is not None), keyframes_dropped=self._dropped,
            keyframes_failed=self._failed, inference_ms=self._inference_ms,
            provider=self._segmenter.provider,
        )  # fmt: skip

    def destroy_node(self) -> None:
        """Finish the inference that runs, give up the waiting ones."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        super().destroy_node()


def main() -> int:
    """Entry point."""
    return int(run_node(SegmenterNode))


if __name__ == "__main__":
    sys.exit(main())
