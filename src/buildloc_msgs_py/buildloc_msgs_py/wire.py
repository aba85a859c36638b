"""Decode the messages on the wire. No ROS import: works on rclpy's messages and on those rosbags reads."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import (
    DISTORTION_MODELS,
    ByteArray,
    CameraModel,
    Candidate,
    Fix,
    Keyframe,
    LocalMap,
    Mask,
    NoFix,
)

MAP_FIELDS = (
    "id", "x", "y", "area", "compactness", "elongation", "rectangularity", "convexity", "observations",
)  # fmt: skip
CANDIDATE_FIELDS = ("x", "y", "yaw", "scale", "votes", "mnn_jaccard", "acceptance")
STATUS_NO_FIX = -1


class WireError(BuildlocError):
    """A message that does not say what it should."""


def stamp_ns(msg: Any) -> int:
    """Header stamp in nanoseconds."""
    return int(msg.header.stamp.sec) * 1_000_000_000 + int(msg.header.stamp.nanosec)


def _bytes(data: Any) -> ByteArray:
    return np.frombuffer(memoryview(data).cast("B"), dtype=np.uint8)


def _raster(msg: Any, channels: int) -> ByteArray:
    data = _bytes(msg.data)
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    if height <= 0 or width <= 0 or step < width * channels or data.size != step * height:
        raise WireError(
            f"image {width}x{height} with step {step} has {data.size} bytes; the driver is at fault"
        )
    return data.reshape(height, step)[:, : width * channels].reshape(height, width, channels)


def decode_image(msg: Any) -> ByteArray:
    """(H, W, 3) uint8 BGR of a sensor_msgs/Image in rgb8, bgr8 or mono8; WireError otherwise."""
    if msg.encoding == "bgr8":
        return _raster(msg, 3).copy()
    if msg.encoding == "rgb8":
        return np.ascontiguousarray(_raster(msg, 3)[:, :, ::-1])
    if msg.encoding == "mono8":
        return np.repeat(_raster(msg, 1), 3, axis=2)
    raise WireError(f"image encoding {msg.encoding!r} is not supported; publish rgb8, bgr8 or mono8")


def decode_compressed_image(msg: Any) -> ByteArray:
    """(H, W, 3) uint8 BGR of a sensor_msgs/CompressedImage (JPEG or PNG)."""
    data = _bytes(msg.data)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if image is None:
        raise WireError(f"compressed image of format {msg.format!r} cannot be decoded; publish JPEG or PNG")
    return np.asarray(image, dtype=np.uint8)


def decode_camera_info(msg: Any) -> CameraModel:
    """Intrinsics of a sensor_msgs/CameraInfo; WireError when it is uncalibrated or its lens unknown."""
    k = np.asarray(msg.k if hasattr(msg, "k") else msg.K, dtype=np.float64)
    distortion = np.asarray(msg.d if hasattr(msg, "d") else msg.D, dtype=np.float64)
    if not (np.isfinite(k).all() and k[0] > 0 and k[4] > 0 and msg.width > 0 and msg.height > 0):
        raise WireError(
            "camera_info is not calibrated (fx, fy or size is zero); publish the camera's calibration"
        )
    model = str(msg.distortion_model) if len(distortion) else "plumb_bob"
    if len(distortion) and len(distortion) not in DISTORTION_MODELS.get(model, ()):
        known = "; ".join(f"{n} {' or '.join(map(str, c))}" for n, c in DISTORTION_MODELS.items())
        raise WireError(
            f"camera_info has distortion model {model!r} with {len(distortion)} coefficients; "
            f"publish one of: {known}, or rectified images without coefficients"
        )
    if not np.isfinite(distortion).all():
        raise WireError("camera_info has a distortion that is not finite; publish the camera's calibration")
    return CameraModel(
        int(msg.width), int(msg.height), float(k[0]), float(k[4]), float(k[2]), float(k[5]),
        tuple(float(v) for v in distortion), model,
    )  # fmt: skip


def decode_altitude(msg: Any) -> float:
    """Height above ground in metres of a sensor_msgs/Range; WireError when not finite and positive."""
    altitude = float(msg.range)
    if not (math.isfinite(altitude) and altitude > 0.0):
        raise WireError(f"altitude {altitude} m is not a positive number; check the rangefinder or barometer")
    return altitude


def decode_attitude(msg: Any) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w) of a geometry_msgs/QuaternionStamped."""
    q = np.array([msg.quaternion.x, msg.quaternion.y, msg.quaternion.z, msg.quaternion.w], dtype=np.float64)
    norm = float(np.linalg.norm(q))
    if not (math.isfinite(norm) and 0.5 < norm < 2.0):
        raise WireError("gimbal attitude is not a unit quaternion; check the gimbal driver")
    x, y, z, w = (q / norm).tolist()
    return x, y, z, w


def decode_mask(msg: Any) -> Mask:
    """Building mask of a sensor_msgs/Image mono8."""
    if msg.encoding != "mono8":
        raise WireError(
            f"mask encoding {msg.encoding!r} is not mono8; feed /buildloc/mask from the segmenter"
        )
    return Mask(stamp_ns(msg), str(msg.header.frame_id), _raster(msg, 1)[:, :, 0].copy())


def _yaw(q: Any) -> float:
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def decode_keyframes(msg: Any) -> tuple[Keyframe, ...]:
    """Keyframes of a nav_msgs/Path. A pose's z carries the scale minus 1 (the map itself is planar)."""
    return tuple(
        Keyframe(
            stamp_ns(pose), float(pose.pose.position.x), float(pose.pose.position.y),
            _yaw(pose.pose.orientation), 1.0 + float(pose.pose.position.z),
        )
        for pose in msg.poses
    )  # fmt: skip


def decode_rows(msg: Any, fields: tuple[str, ...]) -> NDArray[np.float64]:
    """(N, len(fields)) rows of a PointCloud2 of little-endian float64 columns with these names."""
    names = tuple(str(f.name) for f in msg.fields)
    if names != fields:
        raise WireError(f"point cloud has fields {', '.join(names)}; expected {', '.join(fields)}")
    rows = _bytes(msg.data)
    if rows.size != int(msg.width) * int(msg.height) * 8 * len(fields):
        raise WireError("point cloud data does not fit its width and fields")
    return rows.view("<f8").reshape(-1, len(fields)).astype(np.float64)


def decode_map(msg: Any) -> LocalMap:
    """The local map of a sensor_msgs/PointCloud2, one row per building."""
    rows = decode_rows(msg, MAP_FIELDS)
    return LocalMap(
        stamp_ns(msg), rows[:, 0].astype(np.int64), rows[:, 1:3], rows[:, 3], rows[:, 4:8],
        rows[:, 8].astype(np.int64),
    )  # fmt: skip


def decode_candidates(msg: Any) -> tuple[Candidate, ...]:
    """Ranked hypotheses of a sensor_msgs/PointCloud2, best first."""
    return tuple(Candidate(*(float(v) for v in row)) for row in decode_rows(msg, CANDIDATE_FIELDS))


def decode_fix(msg: Any) -> Fix | NoFix:
    """A sensor_msgs/NavSatFix; easting, northing and heading travel on /buildloc/pose and are NaN here."""
    if int(msg.status.status) == STATUS_NO_FIX or not math.isfinite(float(msg.latitude)):
        return NoFix(stamp_ns(msg), "STATUS_NO_FIX")
    covariance = np.asarray(msg.position_covariance, dtype=np.float64).reshape(3, 3)
    return Fix(
        stamp_ns(msg), float(msg.latitude), float(msg.longitude), float(msg.altitude),
        math.nan, math.nan, math.nan, covariance,
    )  # fmt: skip


def decode_pose(msg: Any) -> tuple[float, float, float]:
    """Easting, northing (m) and ENU yaw (rad) of a geometry_msgs/PoseWithCovarianceStamped."""
    pose = msg.pose.pose
    return float(pose.position.x), float(pose.position.y), _yaw(pose.orientation)
