"""Decode the messages on the wire. No ROS import: works on rclpy's messages and on those rosbags reads."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from buildloc_msgs_py import topics
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import SHAPE_METRICS
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
    Tracked,
)

# One row per building. x, y, z are float32, and z (0) is there, because RViz draws no other clouds; a
# float32 holds 10 km to half a millimetre.
MAP_ROW = np.dtype(
    [
        ("id", "<f8"), ("x", "<f4"), ("y", "<f4"), ("area", "<f8"), ("compactness", "<f8"),
        ("elongation", "<f8"), ("rectangularity", "<f8"), ("convexity", "<f8"), ("observations", "<f8"),
        ("covariance_xx", "<f8"), ("covariance_xy", "<f8"), ("covariance_yy", "<f8"), ("cut", "u1"),
        ("z", "<f4"),
    ],
    align=True,
)  # fmt: skip
MAP_OPTIONAL = ("covariance_xx", "covariance_xy", "covariance_yy", "cut", "z")  # not in older recordings
CANDIDATE_FIELDS = ("x", "y", "yaw", "scale", "votes", "mnn_jaccard", "acceptance")
CANDIDATE_ROW = np.dtype([(name, "<f8") for name in CANDIDATE_FIELDS])
# Types of PointField's datatype.
POINT_TYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}
STATUS_NO_FIX = -1
TRACKED_AXES = (0, 1, 5, 2)  # x, y, yaw and z in the (6, 6) covariance of a pose


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


def decode_cloud(msg: Any, needed: Collection[str]) -> NDArray[np.void]:
    """(N,) rows of a little-endian PointCloud2, one column per field; WireError without the needed ones."""
    names = [str(f.name) for f in msg.fields]
    missing = [name for name in needed if name not in names]
    if missing or any(int(f.datatype) not in POINT_TYPES or int(f.count) != 1 for f in msg.fields):
        raise WireError(f"point cloud has fields {', '.join(names)}; expected {', '.join(needed)}")
    step, size = int(msg.point_step), int(msg.width) * int(msg.height)
    data = _bytes(msg.data)
    try:
        row = np.dtype(
            {
                "names": names,
                "formats": [POINT_TYPES[int(f.datatype)] for f in msg.fields],
                "offsets": [int(f.offset) for f in msg.fields],
                "itemsize": step,
            }
        )
    except ValueError as error:
        raise WireError(f"point cloud has fields that do not fit its rows ({error})") from error
    if data.size != size * step:
        raise WireError("point cloud data does not fit its width and fields")
    return data.view(row)


def _columns(rows: NDArray[np.void], names: Sequence[str]) -> NDArray[np.float64]:
    return np.column_stack([rows[name].astype(np.float64) for name in names])


def decode_map(msg: Any) -> LocalMap:
    """The local map of a sensor_msgs/PointCloud2, one row per building."""
    rows = decode_cloud(msg, [str(name) for name in MAP_ROW.fields or () if name not in MAP_OPTIONAL])
    local_map = LocalMap.whole(
        stamp_ns(msg), rows["id"].astype(np.int64), _columns(rows, ("x", "y")),
        rows["area"].astype(np.float64), _columns(rows, SHAPE_METRICS), rows["observations"].astype(np.int64),
    )  # fmt: skip
    if not set(MAP_OPTIONAL) <= set(rows.dtype.names or ()):
        return local_map
    covariances = _columns(rows, ("covariance_xx", "covariance_xy", "covariance_xy", "covariance_yy"))
    return replace(local_map, covariances_m2=covariances.reshape(-1, 2, 2), cut=rows["cut"] > 0)


def decode_candidates(msg: Any) -> tuple[Candidate, ...]:
    """Ranked hypotheses of a sensor_msgs/PointCloud2, best first."""
    rows = _columns(decode_cloud(msg, CANDIDATE_FIELDS), CANDIDATE_FIELDS)
    return tuple(Candidate(*row) for row in rows.tolist())


def decode_fix(msg: Any) -> Fix | NoFix:
    """A sensor_msgs/NavSatFix; easting, northing and heading travel on /buildloc/pose and are NaN here."""
    if int(msg.status.status) == STATUS_NO_FIX or not math.isfinite(float(msg.latitude)):
        return NoFix(stamp_ns(msg), "STATUS_NO_FIX")
    covariance = np.asarray(msg.position_covariance, dtype=np.float64).reshape(3, 3)
    return Fix(
        stamp_ns(msg), float(msg.latitude), float(msg.longitude), float(msg.altitude),
        math.nan, math.nan, math.nan, covariance,
    )  # fmt: skip


def decode_tracked(msg: Any) -> Tracked:
    """A tracked frame of a geometry_msgs/PoseWithCovarianceStamped; WireError when it names no keyframe."""
    frame, _, keyframe = str(msg.header.frame_id).rpartition("/")
    if frame != topics.FRAME_KEYFRAME or not keyframe.isdecimal():
        raise WireError(
            f"tracked pose is in frame {msg.header.frame_id!r}, not in that of a keyframe; "
            "feed /buildloc/track from the mapper"
        )
    position, spread = msg.pose.pose.position, np.reshape(msg.pose.covariance, (6, 6))
    height, told = float(position.z), np.array([position.x, position.y, position.z, *spread.ravel()])
    if not (np.isfinite(told).all() and height > 0.0):
        raise WireError("tracked pose is not finite or has no height; check the altitude source")
    scaled = np.diag([1.0, 1.0, 1.0, 1.0 / height])
    return Tracked(
        stamp_ns(msg), int(keyframe), float(position.x), float(position.y), _yaw(msg.pose.pose.orientation),
        height, scaled @ spread[np.ix_(TRACKED_AXES, TRACKED_AXES)] @ scaled,
    )  # fmt: skip


def decode_pose(msg: Any) -> tuple[float, float, float]:
    """Easting, northing (m) and ENU yaw (rad) of a geometry_msgs/PoseWithCovarianceStamped."""
    pose = msg.pose.pose
    return float(pose.position.x), float(pose.position.y), _yaw(pose.orientation)
