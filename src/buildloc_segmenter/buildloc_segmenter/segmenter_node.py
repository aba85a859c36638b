"""Images with telemetry in; /buildloc/mask out."""

from __future__ import annotations

import sys
import time
from typing import Any

from buildloc_msgs_py import encode, qos, topics
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ros_node import Diagnostics, FrameAssembler, declare_config, run_node
from buildloc_msgs_py.types import Frame
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import Image

from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.segmenter import Segmenter


class SegmenterNode(Node):  # type: ignore[misc]
    """Masks every keyframe."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("segmenter_node", **kwargs)
        self._segmenter = Segmenter(declare_config(self, SegmenterConfig))
        self._diagnostics = Diagnostics(self)
        self._keyframes = 0
        self._masks = self.create_publisher(Image, topics.MASK, qos.SENSOR)
        self._assembler = FrameAssembler(self, self._on_frame, self._diagnostics)

    def _on_frame(self, frame: Frame) -> None:
        started = time.perf_counter()
        try:
            mask = self._segmenter.process(frame)
        except BuildlocError as error:
            self._diagnostics.report(DiagnosticStatus.WARN, str(error), frames=self._assembler.frames)
            return
        figures: dict[str, object] = {"frames": self._assembler.frames}
        if mask is not None:
            self._keyframes += 1
            figures |= {"keyframes": self._keyframes, "seconds": time.perf_counter() - started}
            self._masks.publish(encode.encode_mask(mask))
        self._diagnostics.report(DiagnosticStatus.OK, "segmenting", **figures)


def main() -> int:
    """Entry point."""
    return int(run_node(SegmenterNode))


if __name__ == "__main__":
    sys.exit(main())
