"""Frames in, masks of keyframes out."""

from __future__ import annotations

from buildloc_msgs_py.ground import heading_rad, validate_frame
from buildloc_msgs_py.types import Frame, Mask

from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.keyframes import Moment, is_keyframe
from buildloc_segmenter.network import Network


class Segmenter:
    """Selects keyframes and segments them."""

    def __init__(self, config: SegmenterConfig) -> None:
        self._network = Network(config)
        self._config = config
        self._last: Moment | None = None

    def process(self, frame: Frame) -> Mask | None:
        """The building mask of a keyframe, in the size of its image; None when it is no keyframe.

        Raises WireError for a frame whose telemetry or size cannot be used.
        """
        validate_frame(frame)
        now = Moment(frame.stamp_ns, heading_rad(frame.attitude_xyzw))
        if not is_keyframe(self._last, now, self._config):
            return None
        pixels = self._network.segment(frame.image_bgr, frame.altitude_m / frame.camera.fx)
        self._last = now
        return Mask(frame.stamp_ns, frame.frame_id, pixels)
