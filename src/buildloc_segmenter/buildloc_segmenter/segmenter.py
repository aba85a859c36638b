"""Frames in, masks of keyframes out."""

from __future__ import annotations

import logging

from buildloc_msgs_py.ground import heading_rad, validate_frame
from buildloc_msgs_py.types import Frame, Mask

from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.keyframes import Moment, is_keyframe
from buildloc_segmenter.network import Network, Segmentation


def gsd_m(frame: Frame) -> float:
    """Metres per pixel of a frame below the camera."""
    return frame.altitude_m / frame.camera.fx


class Segmenter:
    """Selects keyframes and segments them.

    ``select`` is cheap and belongs to one thread; ``segment`` keeps no state and may run on another.
    """

    def __init__(self, config: SegmenterConfig) -> None:
        self._network = Network(config)
        self._config = config
        self._last: Moment | None = None
        self._doubted = False

    @property
    def provider(self) -> str:
        """The ONNX Runtime provider that runs the network."""
        return self._network.provider

    def warm_up(self) -> None:
        """Run the network once at its largest size. Raises NetworkError."""
        self._network.warm_up()

    def doubt(self, frame: Frame) -> str | None:
        """Why the mask of a frame may be poor: it was taken from too high or too low for the network."""
        return self._network.doubt(gsd_m(frame))

    def select(self, frame: Frame) -> bool:
        """Whether the frame is the next keyframe; later frames are then measured from it.

        The first doubt about the masks of a flight is logged. Raises WireError for a frame whose telemetry or
        size cannot be used.
        """
        validate_frame(frame)
        now = Moment(frame.stamp_ns, heading_rad(frame.attitude_xyzw))
        if not is_keyframe(self._last, now, self._config):
            return False
        self._last = now
        doubt = self.doubt(frame)
        if doubt is not None and not self._doubted:
            self._doubted = True
            logging.getLogger(__name__).warning("%s", doubt)
        return True

    def segment(self, frame: Frame) -> Mask:
        """The building mask of a frame, in the size of its image. Raises NetworkError."""
        pixels = self._network.segment(frame.image_bgr, gsd_m(frame))
        return Mask(frame.stamp_ns, frame.frame_id, pixels)

    def segment_buildings(self, frame: Frame) -> Segmentation:
        """The mask of a frame and its buildings, with outlines in pixels. Raises NetworkError."""
        return self._network.segment_buildings(frame.image_bgr, gsd_m(frame))

    def process(self, frame: Frame) -> Mask | None:
        """The building mask of a keyframe; None when the frame is none. Raises WireError or NetworkError."""
        return self.segment(frame) if self.select(frame) else None

    def reset(self) -> None:
        """Forget the flight: the next frame is a keyframe."""
        self._last = None
        self._doubted = False
