"""Tiny bags for tests: a handful of images with telemetry, and every fault a recording can have."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
WIDTH, HEIGHT = 96, 64
SECOND = 10**9


def write_bag(
    path: Path,
    frames: int = 3,
    without: tuple[str, ...] = (),
    altitude_m: float = 100.0,
    info_width: int = WIDTH,
    encoding: str | None = None,
    bad_altitude_at: tuple[int, ...] = (),
) -> Path:
    """Frames at 1 Hz from stamp 1 s, with telemetry of the same stamps.

    ``encoding``: raw images of it. ``bad_altitude_at``: seconds at which the altitude is NaN.
    """
    types = STORE.types
    rng = np.random.default_rng(5)

    def header(stamp_ns: int) -> object:
        time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
        return types["std_msgs/msg/Header"](stamp=time, frame_id="camera")

    def messages(stamp_ns: int) -> dict[str, object]:
        image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        h = header(stamp_ns)
        roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        k = np.array([80.0, 0, 47.5, 0, 80.0, 31.5, 0, 0, 1])
        jpeg = np.frombuffer(cv2.imencode(".jpg", image)[1].tobytes(), dtype=np.uint8)
        compressed = types["sensor_msgs/msg/CompressedImage"](h, "jpeg", jpeg)
        height_m = math.nan if stamp_ns // SECOND in bad_altitude_at else altitude_m
        raw = types["sensor_msgs/msg/Image"](h, HEIGHT, WIDTH, encoding or "", 0, 3 * WIDTH, image.ravel())
        return {
            "/camera/camera_info": types["sensor_msgs/msg/CameraInfo"](
                h, HEIGHT, info_width, "plumb_bob", np.empty(0), k, np.eye(3).ravel(), np.zeros(12), 0, 0, roi
            ),
            "/altitude": types["sensor_msgs/msg/Range"](h, 1, 0.1, 0.0, math.inf, height_m, 0.0),
            "/gimbal/attitude": types["geometry_msgs/msg/QuaternionStamped"](
                h, types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
            ),
            **({"/camera/image": raw} if encoding else {"/camera/image/compressed": compressed}),
        }

    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            topic: writer.add_connection(topic, message.__msgtype__, typestore=STORE)  # type: ignore[attr-defined]
            for topic, message in messages(0).items()
            if topic not in without
        }
        for i in range(1, frames + 1):
            for topic, message in messages(i * SECOND).items():
                if topic in connections:
                    data = STORE.serialize_cdr(message, message.__msgtype__)  # type: ignore[attr-defined]
                    writer.write(connections[topic], i * SECOND, data)
    return path


def truncate(path: Path, keep: float) -> Path:
    """Cut the storage file of a bag."""
    (storage,) = path.glob("*.mcap")
    data = storage.read_bytes()
    storage.write_bytes(data[: int(len(data) * keep)])
    return path
