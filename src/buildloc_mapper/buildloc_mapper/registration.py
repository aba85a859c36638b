"""Registers two keyframes: SIFT correspondences on the ground and a RANSAC similarity (map stitching)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from buildloc_msgs_py.ground import pixels_to_level
from buildloc_msgs_py.types import FloatArray, Frame
from numpy.typing import NDArray

from buildloc_mapper.config import MapperConfig

MIN_MATCHES = 3


class Similarity(NamedTuple):
    """p_to = translation + scale R(yaw) p_from; metres, radians."""

    x_m: float
    y_m: float
    yaw_rad: float
    scale: float

    def apply(self, points_m: FloatArray) -> FloatArray:
        """(N, 2) -> (N, 2)."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        rotation = np.array([[c, -s], [s, c]])
        return np.asarray(self.scale * points_m @ rotation.T + (self.x_m, self.y_m), dtype=np.float64)

    def compose(self, other: Similarity) -> Similarity:
        """Apply ``other`` first, then this one."""
        x, y = self.apply(np.array([[other.x_m, other.y_m]]))[0]
        yaw = math.remainder(self.yaw_rad + other.yaw_rad, math.tau)
        return Similarity(float(x), float(y), yaw, self.scale * other.scale)


@dataclass(frozen=True)
class Features:
    """Feature positions (N, 2) in the level camera frame, metres, and descriptors (N, 128)."""

    points_m: FloatArray
    descriptors: NDArray[np.float32]


@dataclass(frozen=True)
class Link:
    """Relative pose of a keyframe in an earlier one, in metres, and its RANSAC inliers.

    Features are already metric by their own altitudes, so the altitude ratio of the pair is divided
    out: the scale is 1 up to errors of altitude and terrain.
    """

    transform: Similarity
    inliers: int


@dataclass(frozen=True)
class Rejection:
    """Why a pair was not linked: ``few_matches``, ``few_inliers`` or ``scale``."""

    reason: str


def extract(frame: Frame, config: MapperConfig) -> Features:
    """SIFT features of a frame, put on the ground by altitude and tilt."""
    grey = cv2.cvtColor(frame.image_bgr, cv2.COLOR_BGR2GRAY)
    shrink = min(1.0, config.feature_width_px / grey.shape[1])
    if shrink < 1.0:
        grey = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = cv2.SIFT.create(nfeatures=config.features).detectAndCompute(grey, None)
    if descriptors is None:
        return Features(np.empty((0, 2)), np.empty((0, 128), dtype=np.float32))
    # Pixel centres are whole numbers, so shrinking maps u to (u + 0.5) shrink - 0.5.
    uv = (np.array([k.pt for k in keypoints]) + 0.5) / shrink - 0.5
    points = pixels_to_level(uv, frame.camera, frame.altitude_m, frame.attitude_xyzw)
    return Features(points, np.asarray(descriptors, dtype=np.float32))


def correspondences(one: Features, other: Features, ratio: float) -> NDArray[np.int64]:
    """(M, 2) indices of matches from ``one`` to ``other`` that pass the ratio test, one to one."""
    if len(one.points_m) < 2 or len(other.points_m) < 2:
        return np.empty((0, 2), dtype=np.int64)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(one.descriptors, other.descriptors, k=2)
    kept = sorted((m.distance, m.queryIdx, m.trainIdx) for m, n in pairs if m.distance < ratio * n.distance)
    taken: dict[int, int] = {}
    for _, query, train in kept:
        taken.setdefault(train, query)
    return np.array([(q, t) for t, q in taken.items()], dtype=np.int64).reshape(-1, 2)


def register(earlier: Features, later: Features, config: MapperConfig) -> Link | Rejection:
    """The later keyframe's pose in the earlier one, or why the pair is rejected."""
    matches = correspondences(later, earlier, config.match_ratio)
    if len(matches) < max(MIN_MATCHES, config.min_inliers):
        return Rejection("few_matches")
    source, target = later.points_m[matches[:, 0]], earlier.points_m[matches[:, 1]]
    affine, inliers = cv2.estimateAffinePartial2D(
        source, target, method=cv2.RANSAC, ransacReprojThreshold=config.ransac_threshold_m,
        maxIters=5000, confidence=0.999, refineIters=20,
    )  # fmt: skip
    count = 0 if affine is None else int(inliers.sum())
    if affine is None or count < config.min_inliers:
        return Rejection("few_inliers")
    scale = math.hypot(affine[0, 0], affine[1, 0])
    if abs(scale - 1.0) > config.max_scale_deviation:
        return Rejection("scale")
    yaw = math.atan2(affine[1, 0], affine[0, 0])
    return Link(Similarity(float(affine[0, 2]), float(affine[1, 2]), yaw, scale), count)
