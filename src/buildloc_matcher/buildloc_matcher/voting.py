"""Votes in a grid of bins (Eq. 3) and rotation-consistent clusters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numba import njit
from numpy.typing import NDArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.hypotheses import Hypotheses

SEEDS = 4  # hypotheses of a cluster that a match may grow from


@dataclass(frozen=True)
class Cluster:
    """A rotation-consistent cluster of one bin: its vote-weighted mean transform, its votes, the number of
    its members and the rows of the hypotheses with the largest votes among them, SEEDS at most."""

    x_m: float
    y_m: float
    yaw_rad: float
    scale: float
    votes: float
    members: int
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Ballot:
    """The ``top_k`` clusters by falling votes, the number of bins hit, and the places (C, 2) m of all
    consistent clusters in the same order."""

    clusters: tuple[Cluster, ...]
    bins: int
    places_m: FloatArray

    @property
    def consistent(self) -> int:
        """Number of bins with a consistent cluster."""
        return len(self.places_m)


@njit(nogil=True, cache=True)
def _consistent(yaws, weights, begin, end, tolerance):  # type: ignore[no-untyped-def]
    """The yaw of a bin's rows [begin, end) whose neighbours within the tolerance weigh most; first wins."""
    best, heaviest = yaws[begin], -1.0
    for i in range(begin, end):
        total = 0.0
        for j in range(begin, end):
            if abs((yaws[j] - yaws[i] + math.pi) % (2.0 * math.pi) - math.pi) <= tolerance:
                total += weights[j]
        if total > heaviest:
            best, heaviest = yaws[i], total
    return best


@njit(nogil=True, cache=True)
def _clusters(starts, positions, yaws, scales, weights, tolerance, out):  # type: ignore[no-untyped-def]
    """Per bin: x, y, yaw, scale, votes, members of its heaviest rotation-consistent set, and its SEEDS
    heaviest rows (-1 pads), heaviest first."""
    for b in range(len(starts) - 1):
        centre = _consistent(yaws, weights, starts[b], starts[b + 1], tolerance)
        x, y, scale, c, s, votes, members = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
        seeds = out[b, 6:]
        seeds[:] = -1.0
        for i in range(starts[b], starts[b + 1]):
            if abs((yaws[i] - centre + math.pi) % (2.0 * math.pi) - math.pi) > tolerance:
                continue
            w = weights[i]
            x, y, scale = x + w * positions[i, 0], y + w * positions[i, 1], scale + w * scales[i]
            c, s, votes, members = (
                c + w * math.cos(yaws[i]),
                s + w * math.sin(yaws[i]),
                votes + w,
                members + 1,
            )
            row = i
            for k in range(SEEDS):
                if seeds[k] < 0 or weights[row] > weights[int(seeds[k])]:
                    row, seeds[k] = int(seeds[k]), row
                if row < 0:
                    break
        out[b, 0], out[b, 1], out[b, 2], out[b, 3] = x / votes, y / votes, math.atan2(s, c), scale / votes
        out[b, 4], out[b, 5] = votes, members


def vote(hypotheses: Hypotheses, config: MatcherConfig) -> Ballot:
    """One cluster per bin; bins with fewer than ``min_votes`` consistent votes have none."""
    if len(hypotheses) == 0:
        return Ballot((), 0, np.empty((0, 2)))
    keys = np.round(hypotheses.positions_m / config.bin_size_m).astype(np.int64)
    order = np.lexsort((keys[:, 1], keys[:, 0]))
    changes = np.flatnonzero(np.any(np.diff(keys[order], axis=0), axis=1)) + 1
    starts = np.concatenate([[0], changes, [len(order)]])
    table: NDArray[np.float64] = np.empty((len(starts) - 1, 6 + SEEDS))
    _clusters(
        starts, hypotheses.positions_m[order], hypotheses.yaws_rad[order], hypotheses.scales[order],
        hypotheses.weights[order], math.radians(config.rotation_tolerance_deg), table,
    )  # fmt: skip
    consistent = table[table[:, 5] >= config.min_votes]
    ranked: FloatArray = consistent[np.lexsort((consistent[:, 1], consistent[:, 0], -consistent[:, 4]))]
    clusters = tuple(
        Cluster(
            x, y, yaw, scale, votes, int(members), tuple(int(order[int(row)]) for row in seeds if row >= 0)
        )
        for x, y, yaw, scale, votes, members, *seeds in ranked[: config.top_k].tolist()
    )
    return Ballot(clusters, len(table), ranked[:, :2])
