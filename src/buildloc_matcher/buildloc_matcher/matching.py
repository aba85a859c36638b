"""Compatibility filter (Eq. 1) and star score (Eq. 2) of query stars against all reference stars."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.descriptors import TRIANGLE_FEATURES, Stars

ROUNDING = 1e-9


@dataclass(frozen=True)
class Matches:
    """Pairs of a query and a reference star (M,), with the score (M,) in [0, 1]."""

    query: NDArray[np.int64]
    reference: NDArray[np.int64]
    score: FloatArray
    compatible: int

    def __len__(self) -> int:
        return len(self.score)


@dataclass(frozen=True)
class StarIndex:
    """Reference stars sorted by the central perimeter: what the filter passes lies in one window."""

    order: NDArray[np.int64]
    features: FloatArray
    perimeters_m: FloatArray


def index_stars(reference: Stars) -> StarIndex:
    """Sort the reference stars by their central perimeter."""
    order = np.argsort(reference.features[:, 3], kind="stable")
    features = np.ascontiguousarray(reference.features[order])
    return StarIndex(order, features, np.ascontiguousarray(features[:, 3]))


def score_pairs(query: FloatArray, reference: FloatArray, tau_angle_rad: float) -> FloatArray:
    """Star score of one query star (32,) with reference stars (M, 32) -> (M,)."""
    q = query.reshape(1, 4, TRIANGLE_FEATURES)
    r = reference.reshape(-1, 4, TRIANGLE_FEATURES)
    d_angle = np.abs(r[:, :, :3] - q[:, :, :3]).sum(axis=2)
    s_angle = np.maximum(0.0, 1.0 - d_angle / tau_angle_rad)
    s_perimeter = np.minimum(r[:, :, 3], q[:, :, 3]) / np.maximum(r[:, :, 3], q[:, :, 3])
    s_shape = 1.0 - np.abs(r[:, :, 4:] - q[:, :, 4:]).sum(axis=2) / 4.0
    return np.asarray(((2.0 * s_angle + s_perimeter + s_shape) / 4.0).mean(axis=1), dtype=np.float64)


def match_stars(query: Stars, index: StarIndex, config: MatcherConfig) -> Matches:
    """The best ``matches_per_star`` compatible reference stars of every query star.

    Ties go to the lower reference index, so the answer does not depend on the order of the work.
    """
    tau_angle = math.radians(config.tau_angle_deg)
    keep = 1.0 - config.tau_perimeter
    queries, references, scores, compatible = [], [], [], 0
    for i, star in enumerate(query.features):
        low = int(np.searchsorted(index.perimeters_m, star[3] * keep * (1.0 - ROUNDING), "left"))
        high = int(np.searchsorted(index.perimeters_m, star[3] / keep * (1.0 + ROUNDING), "right"))
        window = index.features[low:high]
        close = np.flatnonzero(np.abs(window[:, :3] - star[:3]).sum(axis=1) < tau_angle)
        near = window[close]
        d_perimeter = np.abs(near[:, 3] - star[3]) / np.maximum(near[:, 3], star[3])
        d_shape = np.abs(near[:, 4:8] - star[4:8]).sum(axis=1) / 4.0
        passed = close[(d_perimeter <= config.tau_perimeter) & (d_shape <= config.tau_shape)]
        score = score_pairs(star, window[passed], tau_angle)
        found = index.order[low + passed]
        best = np.lexsort((found, -score))[: config.matches_per_star]
        compatible += len(passed)
        queries.append(np.full(len(best), i, dtype=np.int64))
        references.append(found[best])
        scores.append(score[best])
    if not queries:
        return Matches(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0), 0)
    return Matches(np.concatenate(queries), np.concatenate(references), np.concatenate(scores), compatible)
