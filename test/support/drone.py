"""A drone beside the nodes under test: sends what its sensors would, keeps what the nodes say."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from buildloc_msgs_py import encode, qos, topics
from buildloc_msgs_py.types import CameraModel
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import QuaternionStamped
from nav_msgs.msg import Path
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, NavSatFix, Range

SECOND = 10**9
DEADLINE_S = 40.0
CAMERA = CameraModel(96, 64, 100.0, 100.0, 47.5, 31.5)
JPEG = cv2.imencode(".jpg", np.full((64, 96, 3), 90, dtype=np.uint8))[1].tobytes()
LEVEL = (0.0, 0.0, 0.0, 1.0)
INPUTS = {
    topics.IMAGE: Image,
    topics.IMAGE_COMPRESSED: CompressedImage,
    topics.CAMERA_INFO: CameraInfo,
    topics.ALTITUDE: Range,
    topics.GIMBAL_ATTITUDE: QuaternionStamped,
}


def domain_id() -> int:
    """A ROS domain of this test process alone; DDS allows 232."""
    return 1 + os.getpid() % 200


class Drone(Node):  # type: ignore[misc]
    """Publishers of all inputs, and everything heard: masks, keyframes, fixes and diagnostics."""

    def __init__(self, context: Context, *nodes: Node) -> None:
        super().__init__("drone", context=context)
        self.masks: list[Image] = []
        self.paths: list[Path] = []
        self.fixes: list[NavSatFix] = []
        self.statuses: list[DiagnosticStatus] = []
        self.executor_ = SingleThreadedExecutor(context=context)
        for node in (self, *nodes):
            self.executor_.add_node(node)
        self.inputs = {t: self.create_publisher(kind, t, qos.TELEMETRY) for t, kind in INPUTS.items()}
        for kind, topic, handle in (
            (Image, topics.MASK, self.masks.append),
            (Path, topics.KEYFRAMES, self.paths.append),
            (NavSatFix, topics.FIX, self.fixes.append),
            (DiagnosticArray, topics.DIAGNOSTICS, lambda array: self.statuses.extend(array.status)),
        ):
            self.create_subscription(kind, topic, handle, qos.TELEMETRY)

    @property
    def states(self) -> dict[str, DiagnosticStatus]:
        """The latest status of every node."""
        return {status.name: status for status in self.statuses}

    def until(self, condition: Callable[[], Any]) -> None:
        """Spin until something holds; fails with the latest states when it takes too long."""
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, {s.name: s.message for s in self.states.values()}
            self.executor_.spin_once(timeout_sec=0.02)

    def connected(self, subscribers: int) -> bool:
        """Whether every input has that many subscribers."""
        return all(p.get_subscription_count() >= subscribers for p in self.inputs.values())

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """The response of a service."""
        client = self.create_client(kind, service)
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        self.destroy_client(client)
        return future.result()

    def send(
        self, stamp_ns: int, image: Any = None, camera: CameraModel = CAMERA, altitude_m: float = 30.0,
        attitude: tuple[float, float, float, float] | None = LEVEL,
    ) -> None:  # fmt: skip
        """One image (a grey JPEG unless given) and then its telemetry; ``attitude`` None: no gimbal."""
        image = image or encode.encode_compressed_image(JPEG, stamp_ns, "camera")
        self.inputs[topics.IMAGE if isinstance(image, Image) else topics.IMAGE_COMPRESSED].publish(image)
        self.inputs[topics.CAMERA_INFO].publish(encode.encode_camera_info(camera, stamp_ns, "camera"))
        self.inputs[topics.ALTITUDE].publish(encode.encode_altitude(altitude_m, stamp_ns, "camera"))
        if attitude is not None:
            message = encode.encode_attitude(attitude, stamp_ns, "camera")
            self.inputs[topics.GIMBAL_ATTITUDE].publish(message)

    def said(self, node: str, level: bytes, text: str = "", **figures: object) -> bool:
        """Whether some status of a node so far had this level, text and figures."""
        wanted = {key: str(value) for key, value in figures.items()}.items()
        return any(
            s.name == node and s.level == level and text in s.message
            and {value.key: value.value for value in s.values}.items() >= wanted
            for s in self.statuses
        )  # fmt: skip
