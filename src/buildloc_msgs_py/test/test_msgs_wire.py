"""Every row of the wire: encoded with ROS messages, serialised, decoded by rclpy's types and by rosbags."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import cv2
import numpy as np
import pytest
from buildloc_msgs_py import encode, wire
from buildloc_msgs_py.types import CameraModel, Candidate, Fix, Keyframe, LocalMap, Mask, NoFix, Tracked
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import PointField

STAMP = 1_700_000_000_123_456_789
STORE = get_typestore(Stores.ROS2_JAZZY)


def by_rclpy(message: Any) -> Any:
    return deserialize_message(serialize_message(message), type(message))


def by_rosbags(message: Any) -> Any:
    package = type(message).__module__.partition(".msg.")[0]
    return STORE.deserialize_cdr(serialize_message(message), f"{package}/msg/{type(message).__name__}")


wires = pytest.mark.parametrize("travel", [by_rclpy, by_rosbags])
Travel = Callable[[Any], Any]


def same(one: Any, other: Any) -> None:
    assert type(one) is type(other)
    for field in fields(one):
        np.testing.assert_array_equal(
            getattr(one, field.name), getattr(other, field.name), err_msg=field.name
        )


@wires
def test_image(travel: Travel) -> None:
    image = np.random.default_rng(1).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    message = travel(encode.encode_image(image[:, ::1], STAMP, "camera"))
    assert (wire.stamp_ns(message), message.header.frame_id) == (STAMP, "camera")
    assert np.array_equal(wire.decode_image(message), image)


@wires
def test_image_other_encodings(travel: Travel) -> None:
    image = np.random.default_rng(2).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    message = encode.encode_image(image, STAMP, "camera")
    message.encoding = "rgb8"
    assert np.array_equal(wire.decode_image(travel(message)), image[:, :, ::-1])
    message.encoding = "16UC1"
    with pytest.raises(wire.WireError, match="'16UC1' is not supported; publish rgb8, bgr8 or mono8"):
        wire.decode_image(travel(message))
    message.encoding, message.height = "bgr8", 5
    with pytest.raises(wire.WireError, match="image 6x5 with step 18 has 72 bytes"):
        wire.decode_image(travel(message))


@wires
def test_compressed_image(travel: Travel) -> None:
    image = np.full((16, 24, 3), (30, 90, 200), dtype=np.uint8)
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    decoded = wire.decode_compressed_image(travel(encode.encode_compressed_image(jpeg, STAMP, "camera")))
    assert decoded.shape == image.shape and np.abs(decoded.astype(int) - image).max() <= 3
    with pytest.raises(wire.WireError, match="cannot be decoded"):
        wire.decode_compressed_image(travel(encode.encode_compressed_image(b"no jpeg", STAMP, "camera")))


@wires
def test_camera_info(travel: Travel) -> None:
    camera = CameraModel(1280, 720, 900.5, 901.5, 640.25, 359.75, (0.1, -0.2, 0.001, 0.002, 0.05))
    same(wire.decode_camera_info(travel(encode.encode_camera_info(camera, STAMP, "camera"))), camera)
    rational = replace(camera, distortion=(0.1,) * 8, distortion_model="rational_polynomial")
    fisheye = replace(camera, distortion=(0.1,) * 4, distortion_model="equidistant")
    rectified = replace(camera, distortion=())
    for lens in (rational, fisheye, rectified):
        same(wire.decode_camera_info(travel(encode.encode_camera_info(lens, STAMP, "camera"))), lens)
    for odd in (replace(fisheye, distortion_model="omni"), replace(fisheye, distortion=(0.1,) * 5)):
        with pytest.raises(wire.WireError, match=r"model '\w+' with \d coefficients; publish"):
            wire.decode_camera_info(travel(encode.encode_camera_info(odd, STAMP, "camera")))
    endless = replace(fisheye, distortion=(math.nan,) * 4)
    with pytest.raises(wire.WireError, match="not finite"):
        wire.decode_camera_info(travel(encode.encode_camera_info(endless, STAMP, "camera")))
    bare = CameraModel(1280, 720, 0.0, 0.0, 0.0, 0.0)
    with pytest.raises(wire.WireError, match="not calibrated"):
        wire.decode_camera_info(travel(encode.encode_camera_info(bare, STAMP, "camera")))


@wires
def test_altitude(travel: Travel) -> None:
    assert wire.decode_altitude(travel(encode.encode_altitude(104.5, STAMP, "camera"))) == 104.5
    for bad in (math.nan, -3.0, 0.0, math.inf):
        with pytest.raises(wire.WireError, match="not a positive number"):
            wire.decode_altitude(travel(encode.encode_altitude(bad, STAMP, "camera")))


@wires
def test_attitude(travel: Travel) -> None:
    q = (0.5, -0.5, 0.1, math.sqrt(1 - 0.51))
    decoded = wire.decode_attitude(travel(encode.encode_attitude(q, STAMP, "camera")))
    assert decoded == pytest.approx(q, abs=1e-12)
    with pytest.raises(wire.WireError, match="not a unit quaternion"):
        wire.decode_attitude(travel(encode.encode_attitude((0.0, 0.0, 0.0, 0.0), STAMP, "camera")))


@wires
def test_mask(travel: Travel) -> None:
    pixels = (np.arange(35).reshape(5, 7) % 2 * 255).astype(np.uint8)
    mask = Mask(STAMP, "camera", pixels)
    same(wire.decode_mask(travel(encode.encode_mask(mask))), mask)
    with pytest.raises(wire.WireError, match="'bgr8' is not mono8"):
        wire.decode_mask(travel(encode.encode_image(np.zeros((2, 2, 3), np.uint8), STAMP, "camera")))


@wires
def test_keyframes(travel: Travel) -> None:
    sent = (Keyframe(STAMP, 1.5, -2.5, 3.0, 1.25), Keyframe(STAMP + 1, 1e4, 2e4, -3.1, 0.75))
    received = wire.decode_keyframes(travel(encode.encode_keyframes(sent)))
    for one, other in zip(received, sent, strict=True):
        assert one.stamp_ns == other.stamp_ns and one.scale == other.scale
        assert (one.x_m, one.y_m, one.yaw_rad) == pytest.approx((other.x_m, other.y_m, other.yaw_rad))
    assert wire.decode_keyframes(travel(encode.encode_keyframes(()))) == ()


@wires
@pytest.mark.parametrize("count", [0, 1, 5])
def test_map(travel: Travel, count: int) -> None:
    rng = np.random.default_rng(count)
    spread = rng.normal(size=(count, 2, 2))
    sent = LocalMap(
        STAMP, np.arange(count, dtype=np.int64) + 2**24, rng.normal(size=(count, 2)) * 5000,
        rng.uniform(20, 500, count), rng.uniform(size=(count, 4)), rng.integers(1, 9, count),
        spread @ spread.swapaxes(1, 2), rng.uniform(size=count) < 0.5,
    )  # fmt: skip
    message = travel(encode.encode_map(sent))
    received = wire.decode_map(message)
    assert np.abs(received.centroids_m - sent.centroids_m).max(initial=0.0) < 1e-3  # float32 of kilometres
    same(received, replace(sent, centroids_m=received.centroids_m))
    unknown = LocalMap.whole(STAMP, sent.ids, received.centroids_m, *(
        getattr(sent, name) for name in ("areas_m2", "shapes", "observations")
    ))  # fmt: skip
    same(wire.decode_map(travel(encode.encode_map(unknown))), unknown)


@wires
def test_rviz_can_draw_the_map(travel: Travel) -> None:
    none = np.empty(0, dtype=np.int64)
    empty = LocalMap.whole(STAMP, none, np.empty((0, 2)), np.empty(0), np.empty((0, 4)), none)
    # Its only transformer of positions asks for these three, as FLOAT32.
    kinds = {f.name: f.datatype for f in travel(encode.encode_map(empty)).fields}
    assert [kinds[name] for name in ("x", "y", "z")] == [PointField.FLOAT32] * 3


@wires
def test_a_map_recorded_without_covariances_is_read(travel: Travel) -> None:
    names = (
        "id", "x", "y", "area", "compactness", "elongation", "rectangularity", "convexity", "observations",
    )  # fmt: skip
    rows = np.random.default_rng(1).integers(1, 9, (3, 9)).astype(np.float64)
    row = np.dtype([(name, "<f8") for name in names])
    received = wire.decode_map(travel(encode.encode_cloud(rows.view(row)[:, 0], STAMP, "buildloc_map")))
    whole = LocalMap.whole(
        STAMP, rows[:, 0].astype(int), rows[:, 1:3], rows[:, 3], rows[:, 4:8], rows[:, 8].astype(int)
    )
    same(received, whole)
    assert not received.cut.any() and np.isnan(received.covariances_m2).all()


@wires
def test_a_cloud_that_does_not_fit_its_fields_is_refused(travel: Travel) -> None:
    cloud = encode.encode_candidates((Candidate(3e5, 4.7e6, 1.0, 1.01, 12.5, 0.61, 1.7),), STAMP)
    cloud.width = 2
    with pytest.raises(wire.WireError, match="does not fit its width"):
        wire.decode_candidates(travel(cloud))
    cloud.width, cloud.point_step = 1, 8
    with pytest.raises(wire.WireError, match="do not fit its rows"):
        wire.decode_candidates(travel(cloud))


@wires
def test_candidates(travel: Travel) -> None:
    sent = (
        Candidate(3e5, 4.7e6, 1.0, 1.01, 12.5, 0.61, 1.7),
        Candidate(3e5, 4.8e6, -1.0, 0.99, 2.5, 0.2, 0.5),
    )
    assert wire.decode_candidates(travel(encode.encode_candidates(sent, STAMP))) == sent
    with pytest.raises(wire.WireError, match="point cloud has fields x, y, yaw"):
        wire.decode_map(travel(encode.encode_candidates(sent, STAMP)))


FIX = Fix(STAMP, 42.447, -71.225, 104.0, 317000.5, 4701000.25, 0.7, np.diag([4.0, 9.0, 1e4]))


@wires
def test_fix(travel: Travel) -> None:
    message = travel(encode.encode_fix(FIX))
    assert message.status.status == 0 and message.header.frame_id == "camera"
    received = wire.decode_fix(message)
    assert isinstance(received, Fix) and math.isnan(received.easting_m)
    assert (received.stamp_ns, received.latitude_deg, received.longitude_deg, received.altitude_m) == (
        STAMP, 42.447, -71.225, 104.0,
    )  # fmt: skip
    assert np.array_equal(received.covariance_enu_m2, FIX.covariance_enu_m2)


@wires
def test_no_fix_has_no_position(travel: Travel) -> None:
    message = travel(encode.encode_fix(NoFix(STAMP, "nothing convincing")))
    assert message.status.status == -1 and message.position_covariance_type == 0
    assert all(math.isnan(v) for v in (message.latitude, message.longitude, message.altitude))
    assert wire.decode_fix(message) == NoFix(STAMP, "STATUS_NO_FIX")


@pytest.mark.parametrize(("field", "value"), [("z", 0.0), ("z", -1.0), ("x", math.nan), ("y", math.inf)])
def test_a_tracked_pose_that_is_none_is_refused(field: str, value: float) -> None:
    message = encode.encode_tracked(Tracked(STAMP, STAMP - 7, 12.0, -3.0, 0.5, 102.0, np.eye(4)))
    setattr(message.pose.pose.position, field, value)
    with pytest.raises(wire.WireError, match="not finite or has no height"):
        wire.decode_tracked(message)


@wires
def test_tracked(travel: Travel) -> None:
    spread = np.random.default_rng(2).normal(size=(4, 4)) * 0.1
    tracked = Tracked(STAMP, STAMP - 7, 12.0, -3.0, 0.5, 102.0, spread @ spread.T)
    message = travel(encode.encode_tracked(tracked))
    assert message.header.frame_id == f"buildloc_keyframe/{STAMP - 7}"
    six = np.reshape(message.pose.covariance, (6, 6))
    assert six[5, 5] == pytest.approx(tracked.covariance[2, 2])
    assert six[2, 2] == pytest.approx(102.0**2 * tracked.covariance[3, 3])
    assert np.linalg.eigvalsh(six).min() > -1e-9
    received = wire.decode_tracked(message)
    assert (received.stamp_ns, received.keyframe_ns) == (STAMP, STAMP - 7)
    pose = (received.x_m, received.y_m, received.yaw_rad, received.height_m)
    assert pose == pytest.approx((12.0, -3.0, 0.5, 102.0))
    assert received.covariance == pytest.approx(tracked.covariance)
    message.header.frame_id = "buildloc_map"
    with pytest.raises(wire.WireError, match="in frame 'buildloc_map', not in that of a keyframe"):
        wire.decode_tracked(message)


@wires
def test_pose(travel: Travel) -> None:
    message = travel(encode.encode_pose(FIX))
    assert message.header.frame_id == "map"
    assert wire.decode_pose(message) == pytest.approx((317000.5, 4701000.25, 0.7))
    assert np.array_equal(np.reshape(message.pose.covariance, (6, 6))[:3, :3], FIX.covariance_enu_m2)
    surer = encode.encode_pose(replace(FIX, yaw_variance_rad2=1e-4))
    assert surer.pose.covariance[35] == 1e-4 < message.pose.covariance[35]
