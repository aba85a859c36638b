"""Fuses keyframe masks on the ground by counting observations (paper, map stitching)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import border, level_to_ray, pixels_to_level, resample
from buildloc_msgs_py.types import ByteArray, CameraModel, FloatArray
from numpy.typing import NDArray

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.similarity import Similarity

MAX_CANVAS_PX = 400_000_000


@dataclass(frozen=True)
class View:
    """The mask of one keyframe, (H, W) uint8, with what puts it on the ground."""

    mask: ByteArray
    camera: CameraModel
    altitude_m: float
    attitude_xyzw: tuple[float, float, float, float]

    def edge_m(self) -> FloatArray:
        """(N, 2) outer edge of the image in the level camera frame."""
        return pixels_to_level(border(self.camera), self.camera, self.altitude_m, self.attitude_xyzw)


@dataclass(frozen=True)
class FusedMap:
    """Counts per pixel, row 0 at the top: keyframes that saw it, and that saw a building there.

    ``left_m`` and ``top_m`` are the outer corner of pixel (0, 0) in ``buildloc_map``.
    """

    left_m: float
    top_m: float
    gsd_m: float
    seen: NDArray[np.uint16]
    building: NDArray[np.uint16]

    def confirmed(self, config: MapperConfig) -> ByteArray:
        """0 or 255: building in enough keyframes and in a large enough share of its views."""
        enough = self.building >= config.min_observations
        share = self.building >= config.min_share * self.seen
        return (enough & share).astype(np.uint8) * np.uint8(255)


def _map_to_level(pose: Similarity) -> FloatArray:
    c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    forward = np.array(
        [[pose.scale * c, -pose.scale * s, pose.x_m], [pose.scale * s, pose.scale * c, pose.y_m], [0, 0, 1.0]]
    )
    return np.asarray(np.linalg.inv(forward), dtype=np.float64)


def fuse(views: Sequence[View], poses: Sequence[Similarity], config: MapperConfig) -> FusedMap:
    """Warp every mask to the map and count. Raises BuildlocError when the map is impossibly large."""
    gsd = config.map_gsd_m
    edges = [pose.apply(view.edge_m()) for view, pose in zip(views, poses, strict=True)]
    low, high = np.vstack(edges).min(axis=0), np.vstack(edges).max(axis=0)
    left, top = float(low[0]), float(high[1])
    width, height = (int(v) + 1 for v in np.ceil((high - low) / gsd))
    if width * height > MAX_CANVAS_PX:
        raise BuildlocError(
            f"the map would be {width}x{height} pixels; raise map_gsd_m or check the altitude telemetry"
        )
    seen = np.zeros((height, width), dtype=np.uint16)
    building = np.zeros_like(seen)
    for view, pose, edge in zip(views, poses, edges, strict=True):
        c0, r0 = np.floor([(edge[:, 0].min() - left) / gsd, (top - edge[:, 1].max()) / gsd]).astype(int)
        c1, r1 = np.ceil([(edge[:, 0].max() - left) / gsd, (top - edge[:, 1].min()) / gsd]).astype(int)
        pixel_to_map = np.array(
            [[gsd, 0.0, left + (c0 + 0.5) * gsd], [0.0, -gsd, top - (r0 + 0.5) * gsd], [0, 0, 1.0]]
        )
        to_ray = level_to_ray(view.altitude_m, view.attitude_xyzw) @ _map_to_level(pose) @ pixel_to_map
        size = (int(c1 - c0), int(r1 - r0))
        window = np.s_[r0:r1, c0:c1]
        footprint = np.zeros((int(r1 - r0), int(c1 - c0)), dtype=np.uint8)
        outline = (edge - (left + c0 * gsd, top - r0 * gsd)) * [1.0, -1.0] / gsd - 0.5
        cv2.fillPoly(footprint, [np.round(outline * 16).astype(np.int32)], 1, cv2.LINE_8, 4)
        seen[window] += footprint
        building[window] += resample(view.mask, view.camera, to_ray, size) > 127
    return FusedMap(left, top, gsd, seen, building)
