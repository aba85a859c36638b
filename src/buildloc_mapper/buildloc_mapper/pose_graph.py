"""Pose graph over [x, y, theta, log s] per keyframe (paper, map stitching). The only module with gtsam."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.similarity import Similarity

FREE = 1e4  # metres or radians: a prior this wide says nothing
FIXED = 1e-6


@dataclass(frozen=True)
class Edge:
    """Measured pose of keyframe ``later`` in keyframe ``earlier``."""

    earlier: int
    later: int
    transform: Similarity
    inliers: int
    loop: bool = False


def _to_gtsam(pose: Similarity) -> gtsam.Similarity2:
    # gtsam scales after translating: p' = s (R p + t).
    translation = np.array([pose.x_m, pose.y_m]) / pose.scale
    return gtsam.Similarity2(gtsam.Rot2(pose.yaw_rad), translation, pose.scale)


def _from_gtsam(pose: gtsam.Similarity2) -> Similarity:
    scale = float(pose.scale())
    x, y = scale * np.asarray(pose.translation())
    return Similarity(float(x), float(y), float(pose.rotation().theta()), scale)


def _edge_noise(edge: Edge, config: MapperConfig) -> gtsam.noiseModel.Base:
    """Sigmas shrink with the root of the inliers; loop closures weigh more; Huber on top."""
    weight = math.sqrt(edge.inliers / config.min_inliers) * (config.loop_weight if edge.loop else 1.0)
    sigmas = np.array(
        [
            config.sigma_position_m, config.sigma_position_m,
            math.radians(config.sigma_rotation_deg), config.sigma_log_scale,
        ]
    )  # fmt: skip
    gaussian = gtsam.noiseModel.Diagonal.Sigmas(sigmas / weight)
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(config.huber_k), gaussian)


def optimize(poses: Sequence[Similarity], edges: Sequence[Edge], config: MapperConfig) -> list[Similarity]:
    """Optimised poses of all keyframes in the frame of the first, from initial ``poses`` and links.

    The first pose is held; every other has a prior of unit scale.
    """
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    anchor = gtsam.noiseModel.Diagonal.Sigmas(np.array([FIXED] * 4))
    unit = gtsam.noiseModel.Diagonal.Sigmas(np.array([FREE, FREE, FREE, config.sigma_unit_scale]))
    for i, pose in enumerate(poses):
        initial.insert(i, _to_gtsam(pose))
        prior = pose if i == 0 else pose._replace(scale=1.0)
        graph.add(gtsam.PriorFactorSimilarity2(i, _to_gtsam(prior), anchor if i == 0 else unit))
    for edge in edges:
        noise = _edge_noise(edge, config)
        graph.add(gtsam.BetweenFactorSimilarity2(edge.earlier, edge.later, _to_gtsam(edge.transform), noise))
    result = gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize()
    return [_from_gtsam(result.atSimilarity2(i)) for i in range(len(poses))]
