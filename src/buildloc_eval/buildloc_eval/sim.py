"""Writes a simulated flight as an MCAP bag. Ground truth goes on a topic that no node subscribes to."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from buildloc_msgs_py import topics
from buildloc_msgs_py.errors import BuildlocError
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from buildloc_eval.camera import attitude, camera_model, photograph
from buildloc_eval.flight import FlightConfig, Trajectory
from buildloc_eval.world import World

SECOND = 10**9
TELEMETRY_NS = 100_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)
IMAGE = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
RANGE = "sensor_msgs/msg/Range"
ATTITUDE = "geometry_msgs/msg/QuaternionStamped"
POSE = "geometry_msgs/msg/PoseStamped"
TYPES = {
    f"/{topics.IMAGE_COMPRESSED}": IMAGE,
    f"/{topics.CAMERA_INFO}": INFO,
    f"/{topics.ALTITUDE}": RANGE,
    f"/{topics.GIMBAL_ATTITUDE}": ATTITUDE,
    topics.GROUND_TRUTH: POSE,
}


class SimError(BuildlocError):
    """A bag cannot be written."""


def _header(stamp_ns: int, frame_id: str) -> Any:
    time = STORE.types["builtin_interfaces/msg/Time"](sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    return STORE.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def _quaternion(x: float, y: float, z: float, w: float) -> Any:
    return STORE.types["geometry_msgs/msg/Quaternion"](x, y, z, w)


def write_flight(
    path: Path,
    world: World,
    trajectory: Trajectory,
    config: FlightConfig,
    seed: int,
    progress: Callable[[int, int], None],
) -> int:
    """Photograph the world along the trajectory; returns the number of images.

    Telemetry comes at 10 Hz with noise. The heading that the gimbal reports is turned by a constant that
    the seed draws: nothing may rely on a compass. A bag that could not be finished is removed.
    Raises SimError when the bag exists, WorldError when the flight leaves the world.
    """
    if path.exists():
        raise SimError(f"{path}: exists; choose another --out or give --force")
    try:
        return _write(path, world, trajectory, config, seed, progress)
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise


def remove_bag(path: Path) -> None:
    """Remove a bag of an earlier run, if any. Raises SimError for anything that is not a bag folder."""
    if not path.exists():
        return
    if path.is_symlink() or not (path / "metadata.yaml").is_file():
        raise SimError(f"{path}: exists and is not a bag; choose another --out")
    shutil.rmtree(path)


def _write(
    path: Path,
    world: World,
    trajectory: Trajectory,
    config: FlightConfig,
    seed: int,
    progress: Callable[[int, int], None],
) -> int:
    rng = np.random.default_rng([seed, 1])
    camera = camera_model(config)
    turned = rng.uniform(-math.pi, math.pi)
    first, last = int(trajectory.stamps_ns[0]), int(trajectory.stamps_ns[-1])
    step = round(SECOND / config.rate_hz)
    images = range(first, last + 1, step)
    events = [(stamp, 0) for stamp in range(first, last + 2 * TELEMETRY_NS, TELEMETRY_NS)]
    events += [(stamp, 1) for stamp in images]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {t: writer.add_connection(t, kind, typestore=STORE) for t, kind in TYPES.items()}

        def write(topic: str, stamp_ns: int, *values: Any) -> None:
            kind = TYPES[topic]
            writer.write(connections[topic], stamp_ns, STORE.serialize_cdr(STORE.types[kind](*values), kind))

        done = 0
        for stamp, image_due in sorted(events):
            x, y, altitude_m, yaw, roll, pitch = trajectory.at(stamp)
            header = _header(stamp, topics.FRAME_CAMERA)
            # The level frame's z points down: ENU yaw counts the other way round.
            true_attitude = attitude(roll, pitch, -yaw)
            if not image_due:
                noise = math.radians(config.attitude_noise_deg) * rng.standard_normal(2)
                told = attitude(roll + noise[0], pitch + noise[1], -yaw + turned)
                write(f"/{topics.GIMBAL_ATTITUDE}", stamp, header, _quaternion(*told))
                measured = altitude_m + config.altitude_noise_m * rng.standard_normal()
                write(f"/{topics.ALTITUDE}", stamp, header, 1, 0.1, 0.0, math.inf, measured, 0.0)
                continue
            picture = photograph(world, camera, (x, y, altitude_m, yaw), true_attitude, config, rng)
            ok, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality])
            if not ok:
                raise SimError("OpenCV could not encode a JPEG; check its installation")
            k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1])
            p = np.array([camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0])
            region = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            write(
                f"/{topics.CAMERA_INFO}", stamp, header, camera.height, camera.width, "plumb_bob",
                np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, region,
            )  # fmt: skip
            write(f"/{topics.IMAGE_COMPRESSED}", stamp, header, "jpeg", np.asarray(jpeg).ravel())
            position = STORE.types["geometry_msgs/msg/Point"](x, y, altitude_m)
            heading = _quaternion(0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))
            pose = STORE.types["geometry_msgs/msg/Pose"](position, heading)
            write(topics.GROUND_TRUTH, stamp, _header(stamp, f"utm:{world.epsg}"), pose)
            done += 1
            progress(done, len(images))
    return len(images)
