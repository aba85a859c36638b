"""Votes in a grid of bins (Eq. 3) and rotation-consistent clusters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.geometry import wrap
from buildloc_matcher.hypotheses import Hypotheses


@dataclass(frozen=True)
class Cluster:
    """A rotation-consistent cluster of one bin: its vote-weighted mean transform and its votes."""

    x_m: float
    y_m: float
    yaw_rad: float
    scale: float
    votes: float
    members: int


@dataclass(frozen=True)
class Ballot:
    """Clusters by falling votes, the number of bins hit and of bins without a consistent cluster."""

    clusters: tuple[Cluster, ...]
    bins: int
    inconsistent: int


def consistent(yaws_rad: FloatArray, weights: FloatArray, tolerance_rad: float) -> NDArray[np.int64]:
    """Indices of the heaviest set of yaws within the tolerance of one of them."""
    order = np.argsort(wrap(yaws_rad), kind="stable")
    turned = np.concatenate([wrap(yaws_rad)[order] + shift for shift in (-2 * math.pi, 0.0, 2 * math.pi)])
    total = np.concatenate([[0.0], np.cumsum(np.tile(weights[order], 3))])
    own = turned[len(order) : 2 * len(order)]
    first = np.searchsorted(turned, own - tolerance_rad, "left")
    last = np.searchsorted(turned, own + tolerance_rad, "right")
    best = int(np.argmax(total[last] - total[first]))
    return np.asarray(np.unique(order[np.arange(first[best], last[best]) % len(order)]), dtype=np.int64)


def vote(hypotheses: Hypotheses, config: MatcherConfig) -> Ballot:
    """One cluster per bin; bins with fewer than ``min_votes`` consistent votes have none."""
    if len(hypotheses) == 0:
        return Ballot((), 0, 0)
    keys = np.round(hypotheses.positions_m / config.bin_size_m).astype(np.int64)
    _, bins, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(bins.reshape(-1), kind="stable")
    starts = np.concatenate([[0], np.cumsum(counts)])
    tolerance = math.radians(config.rotation_tolerance_deg)
    clusters = []
    for b in np.flatnonzero(counts >= config.min_votes):
        inside = order[starts[b] : starts[b + 1]]
        group = inside[consistent(hypotheses.yaws_rad[inside], hypotheses.weights[inside], tolerance)]
        if len(group) < config.min_votes:
            continue
        weights = hypotheses.weights[group]
        position = np.average(hypotheses.positions_m[group], axis=0, weights=weights)
        yaw = np.angle(np.sum(weights * np.exp(1j * hypotheses.yaws_rad[group])))
        scale = np.average(hypotheses.scales[group], weights=weights)
        clusters.append(
            Cluster(
                float(position[0]),
                float(position[1]),
                float(yaw),
                float(scale),
                float(weights.sum()),
                len(group),
            )
        )
    clusters.sort(key=lambda c: (-c.votes, c.x_m, c.y_m))
    return Ballot(tuple(clusters), len(counts), len(counts) - len(clusters))
