"""Multi-frame refinement: recent frames against the reference, pooled, one rigid correction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray, FrameObservation, Keyframe
from scipy.spatial import cKDTree

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import Ground
from buildloc_matcher.geometry import Similarity, fit_rigid, rotation
from buildloc_matcher.point_grid import within


@dataclass(frozen=True)
class Refined:
    """Camera position of the last keyframe (2,) m and its heading in the world, with the evidence:
    observations pooled, matched pairs, distinct reference buildings, and the residuals' RMS in m."""

    position_m: FloatArray
    yaw_rad: float
    observed: int
    pairs: int
    buildings: int
    rms_m: float
    variance_m2: float
    poses: Mapping[int, tuple[float, float, float]]
    covariance: FloatArray


def observed_in_world(
    coarse: Similarity, keyframes: Sequence[Keyframe], observations: Sequence[FrameObservation], frames: int
) -> FloatArray:
    """(N, 2) building centroids of the last frames in the world. The scale within a frame is fixed by
    its altitude; only the frame's place and heading come from the map and the coarse candidate."""
    poses = {keyframe.stamp_ns: keyframe for keyframe in keyframes}
    seen = sorted((o for o in observations if o.stamp_ns in poses), key=lambda o: o.stamp_ns)[-frames:]
    placed = [np.empty((0, 2))]
    for observation in seen:
        pose = poses[observation.stamp_ns]
        place = coarse.apply(np.array([[pose.x_m, pose.y_m]]))
        placed.append(place + observation.centroids_m @ rotation(pose.yaw_rad + coarse.yaw_rad).T)
    return np.concatenate(placed)


def refine(
    coarse: Similarity,
    keyframes: Sequence[Keyframe],
    observations: Sequence[FrameObservation],
    reference: Ground,
    config: MatcherConfig,
) -> Refined | None:
    """Correct the coarse pose of the last keyframe; None when fewer than three pairs are found.

    1-NN with a distance that shrinks from ``refine_distance_m`` to ``refine_last_distance_m``; every
    step is one SVD over the pooled pairs of all frames.
    """
    if not keyframes:
        return None
    last = max(keyframes, key=lambda k: k.stamp_ns)
    points = observed_in_world(coarse, keyframes, observations, config.refine_frames)
    position = coarse.apply(np.array([[last.x_m, last.y_m]]))
    yaw = coarse.yaw_rad + last.yaw_rad
    if len(points) == 0:
        return None
    reach = 2.0 * config.refine_distance_m
    rows = within(reference.grid, *(points.min(axis=0) - reach), *(points.max(axis=0) + reach))
    if len(rows) == 0:
        return None
    reference_m = reference.buildings_m[rows]
    tree = cKDTree(reference_m)
    shrink = np.geomspace(config.refine_distance_m, config.refine_last_distance_m, config.refine_iterations)
    for distance_m in shrink:
        distance, nearest = tree.query(points)
        close = distance < distance_m
        if close.sum() < 3:
            return None
        step = fit_rigid(points[close], reference_m[nearest[close]])
        points, position, yaw = step.apply(points), step.apply(position), yaw + step.yaw_rad
    distance, nearest = tree.query(points)
    close = distance < config.refine_last_distance_m
    if close.sum() < 3:
        return None
    matched = nearest[close]
    rms = math.sqrt(float(np.mean(distance[close] ** 2)))
    distinct = np.unique(matched)
    variance = horizontal_variance(position[0], reference_m[distinct], rms, config)
    yaw = math.atan2(math.sin(yaw), math.cos(yaw))
    return Refined(
        position[0],
        yaw,
        len(points),
        int(close.sum()),
        len(distinct),
        rms,
        variance,
        {last.stamp_ns: (float(position[0, 0]), float(position[0, 1]), yaw)},
        np.diag([variance, variance, math.radians(2.0) ** 2]),
    )


def horizontal_variance(
    position_m: FloatArray, matched_m: FloatArray, rms_m: float, config: MatcherConfig
) -> float:
    """Variance per axis, m2, of a position that is carried by distinct matched buildings (M, 2).

    The residual variance over the square root of their number (errors of neighbours are not independent),
    with the lever arm to the position, inflated, and never below the floor.
    """
    centre = matched_m.mean(axis=0)
    spread = float(np.mean(np.sum((matched_m - centre) ** 2, axis=1)))
    lever = float(np.sum((position_m - centre) ** 2))
    variance = rms_m**2 / math.sqrt(len(matched_m)) * (1.0 + lever / max(spread, 1.0))
    return max(config.sigma_floor_m**2, config.sigma_inflation**2 * variance)


def covariance_enu(covariance: FloatArray, config: MatcherConfig) -> FloatArray:
    """(3, 3) m2, east, north, up, of one over east, north and yaw. The altitude is above ground, not above
    the ellipsoid: wide."""
    enu = np.zeros((3, 3))
    enu[:2, :2] = covariance[:2, :2]
    enu[2, 2] = config.sigma_up_m**2
    return enu
