"""Frames as the messages that a drone would send, for the pairing that comes before every stage."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

from buildloc_msgs_py import topics
from buildloc_msgs_py.pairing import FrameFault, FramePairing
from buildloc_msgs_py.types import Frame


def messages(frame: Frame) -> dict[str, Any]:
    """One message per topic, all of the frame's stamp."""
    seconds, nanoseconds = divmod(frame.stamp_ns, 10**9)
    stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)

    def stamped(**values: Any) -> SimpleNamespace:
        return SimpleNamespace(header=SimpleNamespace(stamp=stamp, frame_id=frame.frame_id), **values)

    camera, (x, y, z, w) = frame.camera, frame.attitude_xyzw
    height, width = frame.image_bgr.shape[:2]
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    data = frame.image_bgr.tobytes()
    return {
        topics.IMAGE: stamped(width=width, height=height, step=3 * width, encoding="bgr8", data=data),
        topics.CAMERA_INFO: stamped(width=camera.width, height=camera.height, k=k, d=[]),
        topics.ALTITUDE: stamped(range=frame.altitude_m),
        topics.GIMBAL_ATTITUDE: stamped(quaternion=SimpleNamespace(x=x, y=y, z=z, w=w)),
    }


def paired(flight: Iterable[tuple[Frame, tuple[str, ...]]]) -> list[Frame | FrameFault]:
    """What comes out of the pairing when frames are sent, each without the topics named beside it."""
    pairing, out = FramePairing(), list[Frame | FrameFault]()
    for frame, silent in flight:
        for topic, message in messages(frame).items():
            if topic not in silent:
                out += pairing.add(topic, message)
    return out + pairing.flush()
