"""Hypotheses from pairs of buildings, tried wherever the reference has two like them.

A star needs a triangle of the reference's triangulation whose corners are all in the map. Over open country,
where half of what the map shows may be invented, a map may have no such triangle and yet a dozen buildings in
their right places. A pair needs two. It fits in many more places, and so only a few are tried.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import GATE_SIGMAS, Ground, QueryMap, seed_evidence, witnesses
from buildloc_matcher.hypotheses import Hypotheses
from buildloc_matcher.point_grid import _reach, nearest

LENGTHS_M = (15.0, 120.0)
LENGTH_OFF_M, LENGTH_OFF = 3.0, 0.03  # how much longer or shorter it may be in the reference: m, and share
LOG_AREA_OFF = 0.6
HOPELESS = -12.0  # a pair that has sunk below this is given up
USED_OFTEN = 3  # pairs of one building, so that not all of them fail with it


def choose_pairs(query: QueryMap, reference: Ground) -> NDArray[np.int64]:
    """(P, 2) buildings of the map: pairs that the reference likely has, and few others like them, first; of
    each the rarer building."""
    sizes, theirs = query.sizes, np.sort(reference.sizes)
    alike = np.searchsorted(theirs, sizes + LOG_AREA_OFF) - np.searchsorted(theirs, sizes - LOG_AREA_OFF)
    ends = np.array([(i, k) for i, near in enumerate(query.neighbours.tolist()) for k in near])
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    lengths = np.hypot(*(query.points_m[ends[:, 1]] - query.points_m[ends[:, 0]]).T)
    ends, lengths = (some[(lengths >= LENGTHS_M[0]) & (lengths <= LENGTHS_M[1])] for some in (ends, lengths))
    worth = np.log(query.shares[ends]).sum(axis=1) - 0.5 * np.log(np.maximum(alike[ends], 1)).sum(axis=1)
    used = np.zeros(len(query.points_m), dtype=np.int64)
    chosen = []
    for pair in ends[np.argsort(0.5 * np.log(lengths) - worth, kind="stable")]:
        if (used[pair] < USED_OFTEN).all():
            used[pair] += 1
            chosen.append(pair[np.argsort(alike[pair])])
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)


@njit(nogil=True, cache=True)
def _like(length, off, first, second, sizes, points, starts, frame):  # type: ignore[no-untyped-def]
    """(H, 2) places of the reference so far apart whose sizes are near the first and the second."""
    found, count = np.empty((1024, 2), np.int64), 0
    reach = length + off
    low, high = (length - off) ** 2, reach**2
    for p in range(len(points)):
        if abs(sizes[p] - first) > LOG_AREA_OFF:
            continue
        x, y = points[p, 0], points[p, 1]
        first_column, last_column, first_row, last_row = _reach(frame, x, y, reach)
        for row in range(first_row, last_row + 1):
            begin = row * frame[3]
            for q in range(starts[begin + first_column], starts[begin + last_column + 1]):
                if abs(sizes[q] - second) > LOG_AREA_OFF:
                    continue
                squared = (points[q, 0] - x) ** 2 + (points[q, 1] - y) ** 2
                if low <= squared <= high:
                    if count == len(found):
                        found = np.concatenate((found, np.empty_like(found)))
                    found[count, 0], found[count, 1] = p, q
                    count += 1
    return found[:count]


@njit(nogil=True, cache=True)
def _thirds(query, pairs, others, turns, places, points, starts, frame, gate, corners, corner_places):  # type: ignore[no-untyped-def]
    """The nearest other building of the map that a hypothesis finds in the reference, as its third corner."""
    for h in range(len(pairs)):
        i, k = pairs[h]
        corners[h, 0], corners[h, 1], corners[h, 2] = i, k, -1
        for j in others[h]:
            if j < 0:
                break
            x, y = query[j, 0] - query[i, 0], query[j, 1] - query[i, 1]
            u = points[places[h, 0], 0] + turns[h].real * x - turns[h].imag * y
            v = points[places[h, 0], 1] + turns[h].imag * x + turns[h].real * y
            place, _ = nearest(points, starts, frame, u, v, gate)
            if place >= 0 and place != places[h, 0] and place != places[h, 1]:
                corners[h, 2] = j
                corner_places[h, 0], corner_places[h, 1] = points[places[h, 0]], points[places[h, 1]]
                corner_places[h, 2] = points[place]
                break


def pair_hypotheses(
    query: QueryMap, reference: Ground, most: int, config: MatcherConfig
) -> tuple[NDArray[np.int64], Hypotheses]:
    """Corners (H, 3) of the map, and the hypotheses with the same numbers whose surroundings speak for them,
    of pairs that are tried in so many places at most; their votes are their likelihoods."""
    pairs, grid = choose_pairs(query, reference), reference.grid
    where = (grid.points_m, grid.starts, grid.frame)
    tried = [np.empty((0, 2), dtype=np.int64)]
    for pair in pairs:
        length = float(np.hypot(*(query.points_m[pair[1]] - query.points_m[pair[0]])))
        first, second = query.sizes[pair]
        like = _like(length, LENGTH_OFF_M + LENGTH_OFF * length, first, second, reference.sizes, *where)
        if sum(map(len, tried)) + len(like) > most:
            break
        tried.append(like)
    places = np.concatenate(tried)
    numbers = np.repeat(np.arange(len(tried) - 1), [len(like) for like in tried[1:]])
    nats = seed_evidence(query, pairs, numbers, grid.points_m[places], reference, config, HOPELESS)
    good = nats > 0.0
    places, numbers, nats = places[good], numbers[good], nats[good]
    ends, theirs = query.points_m[pairs[numbers]] @ (1.0, 1.0j), grid.points_m[places] @ (1.0, 1.0j)
    turns = (theirs[:, 1] - theirs[:, 0]) / (ends[:, 1] - ends[:, 0])
    corners, corner_places = np.empty((len(places), 3), dtype=np.int64), np.empty((len(places), 3, 2))
    _thirds(
        query.points_m, pairs[numbers], witnesses(query, pairs)[numbers], turns, places, *where,
        GATE_SIGMAS * math.sqrt(2.0) * config.sigma_m, corners, corner_places,
    )  # fmt: skip
    whole = corners[:, 2] >= 0
    centre = query.points_m.mean(axis=0) @ (1.0, 1.0j)
    moved = theirs.mean(axis=1) + turns * (centre - ends.mean(axis=1))
    return corners[whole], Hypotheses(
        np.arange(whole.sum()), corner_places[whole], np.column_stack([moved.real, moved.imag])[whole],
        np.angle(turns)[whole], np.abs(turns)[whole], np.exp(nats[whole]), mirrored=0, off_scale=0,
    )  # fmt: skip
