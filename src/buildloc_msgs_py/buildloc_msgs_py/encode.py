"""Encode what travels as standard ROS messages. Every number is cast: rclpy corrupts NumPy scalars."""

from __future__ import annotations

import array
import math
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Quaternion, QuaternionStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from sensor_msgs.msg import (
    CameraInfo,
    CompressedImage,
    Image,
    NavSatFix,
    NavSatStatus,
    PointCloud2,
    PointField,
    Range,
)
from std_msgs.msg import Header

from buildloc_msgs_py import topics
from buildloc_msgs_py.footprint import SHAPE_METRICS
from buildloc_msgs_py.types import (
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
from buildloc_msgs_py.wire import CANDIDATE_ROW, MAP_ROW, POINT_TYPES, TRACKED_AXES

LEVEL_SIGMA_RAD = math.radians(5.0)


def header(stamp_ns: int, frame_id: str) -> Header:
    """Header with a stamp in nanoseconds."""
    stamp = Time(sec=int(stamp_ns // 1_000_000_000), nanosec=int(stamp_ns % 1_000_000_000))
    return Header(stamp=stamp, frame_id=frame_id)


def _image(pixels: ByteArray, encoding: str, stamp_ns: int, frame_id: str) -> Image:
    contiguous = np.ascontiguousarray(pixels)
    return Image(
        header=header(stamp_ns, frame_id), height=int(pixels.shape[0]), width=int(pixels.shape[1]),
        encoding=encoding, is_bigendian=0, step=int(contiguous.strides[0]),
        data=array.array("B", contiguous.tobytes()),
    )  # fmt: skip


def encode_image(image_bgr: ByteArray, stamp_ns: int, frame_id: str) -> Image:
    """(H, W, 3) uint8 BGR -> sensor_msgs/Image bgr8."""
    return _image(image_bgr, "bgr8", stamp_ns, frame_id)


def encode_compressed_image(jpeg: bytes, stamp_ns: int, frame_id: str) -> CompressedImage:
    """JPEG bytes -> sensor_msgs/CompressedImage."""
    return CompressedImage(header=header(stamp_ns, frame_id), format="jpeg", data=array.array("B", jpeg))


def encode_camera_info(camera: CameraModel, stamp_ns: int, frame_id: str) -> CameraInfo:
    """Intrinsics -> sensor_msgs/CameraInfo."""
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    return CameraInfo(
        header=header(stamp_ns, frame_id), width=int(camera.width), height=int(camera.height),
        distortion_model=camera.distortion_model, d=array.array("d", [float(v) for v in camera.distortion]),
        k=[float(v) for v in k], r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[float(v) for v in (*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0)],
    )  # fmt: skip


def encode_altitude(altitude_m: float, stamp_ns: int, frame_id: str) -> Range:
    """Height above ground -> sensor_msgs/Range."""
    return Range(
        header=header(stamp_ns, frame_id), radiation_type=Range.INFRARED, min_range=0.0,
        max_range=math.inf, range=float(altitude_m),
    )  # fmt: skip


def encode_attitude(
    attitude_xyzw: tuple[float, float, float, float], stamp_ns: int, frame_id: str
) -> QuaternionStamped:
    """Camera attitude -> geometry_msgs/QuaternionStamped."""
    x, y, z, w = (float(v) for v in attitude_xyzw)
    return QuaternionStamped(header=header(stamp_ns, frame_id), quaternion=Quaternion(x=x, y=y, z=z, w=w))


def encode_mask(mask: Mask) -> Image:
    """Mask -> sensor_msgs/Image mono8 with the image's stamp and frame_id."""
    return _image(mask.pixels, "mono8", mask.stamp_ns, mask.frame_id)


def _yaw_quaternion(yaw_rad: float) -> Quaternion:
    return Quaternion(x=0.0, y=0.0, z=math.sin(yaw_rad / 2.0), w=math.cos(yaw_rad / 2.0))


def encode_keyframes(keyframes: Sequence[Keyframe]) -> Path:
    """Keyframes -> nav_msgs/Path in ``buildloc_map``; a pose's z carries the scale minus 1."""
    path = Path(header=header(keyframes[-1].stamp_ns if keyframes else 0, topics.FRAME_MAP))
    for keyframe in keyframes:
        pose = PoseStamped(header=header(keyframe.stamp_ns, topics.FRAME_MAP))
        pose.pose.position.x = float(keyframe.x_m)
        pose.pose.position.y = float(keyframe.y_m)
        pose.pose.position.z = float(keyframe.scale) - 1.0
        pose.pose.orientation = _yaw_quaternion(keyframe.yaw_rad)
        path.poses.append(pose)
    return path


def encode_tracked(tracked: Tracked) -> PoseWithCovarianceStamped:
    """A frame's pose in the level camera frame of its keyframe, z the height above ground. Roll and pitch
    are the gimbal's, which are taken out."""
    frame_id = f"{topics.FRAME_KEYFRAME}/{tracked.keyframe_ns}"
    message = PoseWithCovarianceStamped(header=header(tracked.stamp_ns, frame_id))
    position = message.pose.pose.position
    position.x, position.y, position.z = float(tracked.x_m), float(tracked.y_m), float(tracked.height_m)
    message.pose.pose.orientation = _yaw_quaternion(tracked.yaw_rad)
    spread = np.zeros((6, 6))  # over x, y, z, and turns about the three axes
    scaled = np.diag([1.0, 1.0, 1.0, tracked.height_m])
    spread[np.ix_(TRACKED_AXES, TRACKED_AXES)] = scaled @ tracked.covariance @ scaled
    spread[3, 3] = spread[4, 4] = LEVEL_SIGMA_RAD**2
    message.pose.covariance = [float(v) for v in spread.ravel()]
    return message


def encode_cloud(rows: NDArray[np.void], stamp_ns: int, frame_id: str) -> PointCloud2:
    """(N,) rows of a structured array -> PointCloud2, a field per column."""
    count, step = len(rows), int(rows.dtype.itemsize)
    datatypes = {np.dtype(name): number for number, name in POINT_TYPES.items()}
    return PointCloud2(
        header=header(stamp_ns, frame_id), height=1, width=int(count),
        fields=[
            PointField(name=name, offset=int(offset), datatype=datatypes[kind], count=1)
            for name, (kind, offset, *_) in (rows.dtype.fields or {}).items()
        ],
        is_bigendian=False, point_step=step, row_step=step * count, is_dense=True,
        data=array.array("B", rows.tobytes()),
    )  # fmt: skip


def encode_map(local_map: LocalMap) -> PointCloud2:
    """LocalMap -> PointCloud2, one row per building."""
    rows = np.zeros(len(local_map), dtype=MAP_ROW)
    rows["id"], rows["area"], rows["observations"] = local_map.ids, local_map.areas_m2, local_map.observations
    rows["x"], rows["y"] = local_map.centroids_m.T
    for name, values in zip(SHAPE_METRICS, local_map.shapes.T, strict=True):
        rows[name] = values
    covariances = local_map.covariances_m2
    rows["covariance_xx"], rows["covariance_yy"] = covariances[:, 0, 0], covariances[:, 1, 1]
    rows["covariance_xy"], rows["cut"] = covariances[:, 0, 1], local_map.cut
    return encode_cloud(rows, local_map.stamp_ns, topics.FRAME_MAP)


def encode_candidates(candidates: Sequence[Candidate], stamp_ns: int) -> PointCloud2:
    """Candidates, best first -> PointCloud2 in the world frame."""
    rows = [(c.x_m, c.y_m, c.yaw_rad, c.scale, c.votes, c.mnn_jaccard, c.acceptance) for c in candidates]
    return encode_cloud(np.array(rows, dtype=CANDIDATE_ROW), stamp_ns, topics.FRAME_WORLD)


def encode_fix(fix: Fix | NoFix) -> NavSatFix:
    """A fix, or STATUS_NO_FIX with a NaN position and unknown covariance."""
    msg = NavSatFix(header=header(fix.stamp_ns, topics.FRAME_CAMERA))
    msg.status.service = NavSatStatus.SERVICE_GPS
    if isinstance(fix, NoFix):
        msg.status.status = NavSatStatus.STATUS_NO_FIX
        msg.latitude = msg.longitude = msg.altitude = math.nan
        msg.position_covariance_type = NavSatFix.COVARIANCE_TYPE_UNKNOWN
        return msg
    msg.status.status = NavSatStatus.STATUS_FIX
    msg.latitude, msg.longitude = float(fix.latitude_deg), float(fix.longitude_deg)
    msg.altitude = float(fix.altitude_m)
    msg.position_covariance = [float(v) for v in fix.covariance_enu_m2.ravel()]
    msg.position_covariance_type = NavSatFix.COVARIANCE_TYPE_KNOWN
    return msg


def encode_pose(fix: Fix) -> PoseWithCovarianceStamped:
    """The fix in the metric world frame (UTM easting, northing) with its heading; a wide one if unknown."""
    msg = PoseWithCovarianceStamped(header=header(fix.stamp_ns, topics.FRAME_WORLD))
    msg.pose.pose.position.x = float(fix.easting_m)
    msg.pose.pose.position.y = float(fix.northing_m)
    msg.pose.pose.position.z = float(fix.altitude_m)
    msg.pose.pose.orientation = _yaw_quaternion(fix.yaw_rad)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = fix.covariance_enu_m2
    covariance[3, 3] = covariance[4, 4] = covariance[5, 5] = LEVEL_SIGMA_RAD**2
    if math.isfinite(fix.yaw_variance_rad2):
        covariance[5, 5] = fix.yaw_variance_rad2
    msg.pose.covariance = [float(v) for v in covariance.ravel()]
    return msg
