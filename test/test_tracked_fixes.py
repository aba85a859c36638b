"""The matcher's node over DDS: fixes of tracked frames between keyframes, until the mapper begins anew."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

import rclpy
import shapely
from buildloc.settings import MATCHER
from buildloc_matcher.matcher_node import MatcherNode
from buildloc_msgs_py import encode, qos, topics
from buildloc_msgs_py.footprint import footprints
from buildloc_msgs_py.types import CameraModel, FloatArray, Keyframe, LocalMap, Mask, Tracked
from buildloc_msgs_py.wire import stamp_ns
from drone import LEVEL, SECOND, Drone, domain_id
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path as PathMessage
from pyproj import Transformer
from rclpy.context import Context
from reference_files import ORIGIN_DEG, build_database, write_geojson
from sensor_msgs.msg import Image, NavSatFix, NavSatStatus, PointCloud2
from std_msgs.msg import String

pytestmark = pytest.mark.dds
HEIGHT_M = 400.0
CAMERA = CameraModel(480, 360, HEIGHT_M, HEIGHT_M, 239.5, 179.5)  # a pixel is a metre
TO_UTM = Transformer.from_crs(4326, 32632, always_xy=True)
CENTRE = np.array(TO_UTM.transform(*ORIGIN_DEG))
STILL = np.zeros((4, 4))


def town() -> np.ndarray:
    """(N,) houses of many sizes on a crooked grid of 900 m, metres about its centre."""
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(np.arange(-450.0, 451.0, 36.0), np.arange(-450.0, 451.0, 36.0))
    middles = np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-8.0, 8.0, (x.size, 2))
    halves = rng.uniform(4.0, 9.0, middles.shape)
    return np.asarray(shapely.box(*(middles - halves).T, *(middles + halves).T))


HOUSES = town()


class Stages(Drone):
    """In place of the other nodes: what they would publish to the matcher, which is up."""

    def __init__(self, context: Context, node: MatcherNode) -> None:
        super().__init__(context, node)
        self.stages = {
            topic: self.create_publisher(kind, topic, profile)
            for topic, kind, profile in (
                (topics.MASK, Image, qos.SENSOR),
                (topics.MAP, PointCloud2, qos.SENSOR),
                (topics.KEYFRAMES, PathMessage, qos.SENSOR),
                (topics.TRACK, PoseWithCovarianceStamped, qos.SENSOR),
                (topics.REFERENCE_DATABASE, String, qos.LATCHED),
            )
        }
        self.until(lambda: all(p.get_subscription_count() for p in self.stages.values()))

    def keyframe(self, stamp: int, keyframes: list[Keyframe]) -> None:
        """All that comes with a keyframe that looks at the town's centre."""
        self.inputs[topics.CAMERA_INFO].publish(encode.encode_camera_info(CAMERA, stamp, "camera"))
        self.inputs[topics.ALTITUDE].publish(encode.encode_altitude(HEIGHT_M, stamp, "camera"))
        self.inputs[topics.GIMBAL_ATTITUDE].publish(encode.encode_attitude(LEVEL, stamp, "camera"))
        self.until(lambda: not self.matcher_lacks())
        pixels = np.zeros((CAMERA.height, CAMERA.width), dtype=np.uint8)
        corners = [shapely.get_coordinates(house)[:4] * (1, -1) + (CAMERA.cx, CAMERA.cy) for house in HOUSES]
        cv2.fillPoly(pixels, [np.round(ring).astype(np.int32) for ring in corners], 255)
        measured = footprints(HOUSES)
        seen = np.flatnonzero((np.abs(measured.centroids_m) < (230.0, 170.0)).all(axis=1))
        local_map = LocalMap.whole(
            stamp, seen, measured.centroids_m[seen], measured.areas_m2[seen], measured.shapes[seen],
            np.full(len(seen), 3),
        )  # fmt: skip
        self.stages[topics.MASK].publish(encode.encode_mask(Mask(stamp, "camera", pixels)))
        self.stages[topics.KEYFRAMES].publish(encode.encode_keyframes(keyframes))
        self.stages[topics.MAP].publish(encode.encode_map(local_map))

    def matcher_lacks(self) -> tuple[str, ...]:
        """Telemetry that the matcher has not received."""
        (node,) = (n for n in self.executor_.get_nodes() if isinstance(n, MatcherNode))
        return tuple(node.session.telemetry.missing())

    def track(self, stamp: int, keyframe: int, east_m: float) -> None:
        """A frame tracked this far east of a keyframe."""
        tracked = Tracked(stamp, keyframe, east_m, 0.0, 0.0, HEIGHT_M, STILL)
        self.stages[topics.TRACK].publish(encode.encode_tracked(tracked))

    def accepted(self) -> dict[int, FloatArray]:
        """East and north of the town's centre by stamp, of all fixes; none came twice or out of order."""
        fixes = [fix for fix in self.fixes if fix.status.status == NavSatStatus.STATUS_FIX]
        stamps = [stamp_ns(fix) for fix in fixes]
        assert stamps == sorted(set(stamps))
        places = [np.array(TO_UTM.transform(f.longitude, f.latitude)) - CENTRE for f in fixes]
        return dict(zip(stamps, places, strict=True))


@pytest.fixture
def stages(tmp_path: Path) -> Iterator[Stages]:
    to_degrees = Transformer.from_crs(32632, 4326, always_xy=True)
    rings = [shapely.get_coordinates(house) + CENTRE for house in HOUSES]
    geometries = [
        {"type": "Polygon", "coordinates": [np.column_stack(to_degrees.transform(*ring.T)).tolist()]}
        for ring in rings
    ]
    database = build_database(tmp_path / "town.bldb", write_geojson(tmp_path / "town.geojson", geometries))
    context = Context()
    rclpy.init(context=context, domain_id=domain_id())
    node = MatcherNode(context=context)
    made = Stages(context, node)
    made.stages[topics.REFERENCE_DATABASE].publish(String(data=str(database)))
    made.until(lambda: made.said(MATCHER, b"\x00", "no fix"))
    try:
        yield made
    finally:
        for one in (node, made):
            one.destroy_node()
        rclpy.try_shutdown(context=context)


def latest(fixes: list[NavSatFix]) -> int:
    return fixes[-1].status.status if fixes else NavSatStatus.STATUS_FIX


def test_frames_between_keyframes_have_fixes_until_the_mapper_begins_anew(stages: Stages) -> None:
    first = 10 * SECOND
    stages.track(first - 1, first, 5.0)  # before anything is known
    stages.keyframe(first, [Keyframe(first, 0.0, 0.0, 0.0)])
    stages.until(lambda: first in stages.accepted())
    tenth = SECOND // 10
    for i in range(1, 11):
        stages.track(first + i * tenth, first, 3.0 * i)
    stages.until(lambda: len(stages.accepted()) == 11)
    stages.track(first + 3 * tenth, first, 9.0)  # late, and not to be repeated
    stages.track(first + 11 * tenth, first, 33.0)
    stages.until(lambda: len(stages.accepted()) == 12)
    for stamp, place in stages.accepted().items():
        east = 30.0 * (stamp - first) * 1e-9
        assert math.dist(place, (east, 0.0)) < 1.5  # a mask of whole pixels of 1 m
    stages.until(lambda: stages.said(MATCHER, b"\x00", "fix", mode="track"))
    # Another submap: its keyframes have no place, and what was known is withdrawn at once.
    stages.fixes.clear()
    other = first + 5 * SECOND
    alien = [Keyframe(other, 0.0, 0.0, 0.0), Keyframe(other + SECOND, 30.0, 0.0, 0.0)]
    stages.stages[topics.KEYFRAMES].publish(encode.encode_keyframes(alien))
    stages.until(lambda: latest(stages.fixes) == NavSatStatus.STATUS_NO_FIX)
    stages.track(other + 2 * SECOND, other + SECOND, 1.0)
    stages.until(
        lambda: stages.said(MATCHER, b"\x00", "the mapper began another map", mode="acquire", withdrawals=1)
    )
    assert not stages.accepted()
