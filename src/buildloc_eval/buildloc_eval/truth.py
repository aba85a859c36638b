"""Ground truth of a simulated flight. Only this package reads it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from buildloc.bag import open_bag, raw_messages
from buildloc_msgs_py import topics
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import Fix, FloatArray
from buildloc_msgs_py.wire import stamp_ns
from pyproj import Transformer


class TruthError(BuildlocError):
    """A bag has no usable ground truth."""


@dataclass(frozen=True)
class TruePose:
    """Where the camera was: UTM metres, height above ground, ENU yaw of image-right."""

    x_m: float
    y_m: float
    altitude_m: float
    yaw_rad: float


@dataclass(frozen=True)
class Truth:
    """True poses by image stamp, in one UTM zone."""

    epsg: int
    poses: dict[int, TruePose]

    def offset_m(self, fix: Fix) -> FloatArray:
        """(2,) east and north from the truth of its own stamp to a fix; raises TruthError without one."""
        pose = self.poses.get(fix.stamp_ns)
        if pose is None:
            raise TruthError(f"fix at {fix.stamp_ns} has no ground truth; is it from another bag?")
        east, north = _to_utm(self.epsg).transform(fix.longitude_deg, fix.latitude_deg)
        return np.array([east - pose.x_m, north - pose.y_m])

    def error_m(self, fix: Fix) -> float:
        """Horizontal distance of a fix to the truth of its own stamp; raises TruthError without one."""
        return math.hypot(*self.offset_m(fix))


@cache
def _to_utm(epsg: int) -> Transformer:
    return Transformer.from_crs(4326, epsg, always_xy=True)


def read_truth(bag: Path) -> Truth:
    """Ground truth of a bag that `buildloc sim` wrote; raises TruthError when there is none."""
    poses: dict[int, TruePose] = {}
    frame_id = ""
    with open_bag(bag) as reader:
        for connection, _, data in raw_messages(reader, bag, {topics.GROUND_TRUTH.lstrip("/")}):
            message: Any = reader.deserialize(data, connection.msgtype)
            position, q = message.pose.position, message.pose.orientation
            yaw = 2.0 * math.atan2(q.z, q.w)
            poses[stamp_ns(message)] = TruePose(position.x, position.y, position.z, yaw)
            frame_id = message.header.frame_id
    if not poses or not frame_id.startswith("utm:"):
        raise TruthError(
            f"{bag}: has no {topics.GROUND_TRUTH}; errors are known for `buildloc sim` bags only"
        )
    return Truth(int(frame_id.removeprefix("utm:")), poses)
