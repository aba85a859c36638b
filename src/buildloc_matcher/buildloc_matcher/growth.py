"""A match that grows: from a seed over neighbouring buildings, with a similarity that follows the map's bend.

One rigid transform for a whole flight throws true matches away where the stitched map has bent. Here every
building is looked for where its matched neighbours predict it.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numba import njit
from numpy.typing import NDArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import (
    GATE_SIGMAS,
    MAX_GATE_M,
    NO_MATCH,
    TOUCHING_M,
    Ground,
    QueryMap,
    _alike,
    _density,
    _either,
    _gains,
    surroundings,
)
from buildloc_matcher.matching import THREADS
from buildloc_matcher.point_grid import nearest

UNKNOWN = -2
HELPFUL_M = 40.0  # neighbours further away than this predict worse
STIFFNESS_M2 = 3.0 * 60.0**2  # how much a building's turn and scale hold to those of its neighbours
PASSES = 2
GIVE_UP = -12.0
BLOCK = 64  # buildings whose largest support is kept, so that a map of many is not searched at every step


@dataclass(frozen=True)
class Grown:
    """``matches`` (N,) rows of the reference's buildings, NO_MATCH where there is none; ``predicted`` (N, 2)
    where the match puts every building of the map (NaN where it never got); ``evidence`` of the places, and
    ``alike`` of the areas, in nats."""

    matches: NDArray[np.int64]
    predicted_m: FloatArray
    evidence: float
    alike: float


@njit(nogil=True, cache=True)
def _predict(j, query, near, state, points, turn, sigma):  # type: ignore[no-untyped-def]
    """Where matched neighbours put building j: x, y, its turn (a, b), variance; weight 0 without any."""
    x, y, a, b, weight, squares, lever = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(near.shape[1]):
        i = near[j, k]
        if state[i] < 0:
            continue
        dx, dy = query[j, 0] - query[i, 0], query[j, 1] - query[i, 1]
        squared = dx * dx + dy * dy
        w = 1.0 / (1.0 + squared / (HELPFUL_M * HELPFUL_M))
        x += w * (points[state[i], 0] + turn[i, 0] * dx - turn[i, 1] * dy)
        y += w * (points[state[i], 1] + turn[i, 1] * dx + turn[i, 0] * dy)
        a, b = a + w * turn[i, 0], b + w * turn[i, 1]
        weight, squares, lever = weight + w, squares + w * w, lever + w * squared
    if weight == 0.0:
        return 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    # The neighbours' own errors average out; their turns share one, which grows with the distance.
    variance = sigma * sigma * (1.0 + squares / (weight * weight) + lever / weight / STIFFNESS_M2)
    return x / weight, y / weight, a / weight, b / weight, variance, weight


@njit(nogil=True, cache=True)
def _turn(j, query, near, state, points, turn, a, b):  # type: ignore[no-untyped-def]
    """Turn and scale (a, b) at building j from its matched neighbours, held to the given one."""
    real, imag, spread = a * STIFFNESS_M2, b * STIFFNESS_M2, STIFFNESS_M2
    for k in range(near.shape[1]):
        i = near[j, k]
        if state[i] < 0:
            continue
        x, y = query[j, 0] - query[i, 0], query[j, 1] - query[i, 1]
        u, v = points[state[j], 0] - points[state[i], 0], points[state[j], 1] - points[state[i], 1]
        real, imag, spread = real + x * u + y * v, imag + x * v - y * u, spread + x * x + y * y
    turn[j, 0], turn[j, 1] = real / spread, imag / spread


@njit(nogil=True, cache=True)
def _most_supported(support, most):  # type: ignore[no-untyped-def]
    """The first building with the largest support, -1 where none has any; ``most`` is that of each block."""
    block = 0
    for b in range(1, len(most)):
        if most[b] > most[block]:
            block = b
    if most[block] <= 0:
        return -1
    j = block * BLOCK
    while support[j] != most[block]:
        j += 1
    return j


@njit(nogil=True, cache=True)
def _support(j, near, state, support, most):  # type: ignore[no-untyped-def]
    """Count building j for the buildings near it that have not been tried."""
    for m in range(near.shape[1]):
        i = near[j, m]
        if state[i] == UNKNOWN:
            support[i] += 1
            most[i // BLOCK] = max(most[i // BLOCK], support[i])


@njit(nogil=True, cache=True)
def _set_aside(j, support, most):  # type: ignore[no-untyped-def]
    """Building j is not to be tried (again)."""
    support[j] = 0
    first = j // BLOCK * BLOCK
    most[j // BLOCK] = support[first : first + BLOCK].max()


@njit(nogil=True, cache=True)
def _settle(j, place, state, taken):  # type: ignore[no-untyped-def]
    """Match building j with a place that no other has, else with none; ``taken`` counts who has a place."""
    if state[j] >= 0:
        taken[state[j]] -= 1
    state[j] = place if place >= 0 and taken[place] == 0 else NO_MATCH
    if state[j] >= 0:
        taken[place] += 1


@njit(nogil=True, cache=True)
def _grow(about, corners, places, a, b, around, taken, state, predicted):  # type: ignore[no-untyped-def]
    """Fill ``state`` (N,) and ``predicted`` (N, 2) from corners that lie on ``places``; the evidence of the
    places and of the areas.

    ``taken`` counts the buildings of the map on every place; zero before and after.
    """
    total = _grown_evidence(about, corners, places, a, b, around, taken, state, predicted)
    for place in state:
        if place >= 0:
            taken[place] = 0
    return total


@njit(nogil=True, cache=True)
def _grown_evidence(about, corners, places, a, b, around, taken, state, predicted):  # type: ignore[no-untyped-def]
    query, shares, sizes, near = about
    points, starts, frame, density, theirs, usual, sigma, log_area, area_share = around
    count = len(query)
    turn = np.empty((count, 2))
    support = np.zeros(count, np.int64)
    most = np.zeros((count + BLOCK - 1) // BLOCK, np.int64)
    for j in range(count):
        state[j] = UNKNOWN
        predicted[j, 0] = predicted[j, 1] = math.nan
    for k in range(3):
        state[corners[k]] = places[k]
        if places[k] >= 0:
            taken[places[k]] += 1
    for k in range(3):
        _turn(corners[k], query, near, state, points, turn, a, b)
        _support(corners[k], near, state, support, most)
    sure, doubtful, alike = 0.0, 0.0, 0.0
    while True:
        # Next comes the building with the most matched neighbours: the surest prediction.
        j = _most_supported(support, most)
        if j < 0:
            break
        _set_aside(j, support, most)
        x, y, a, b, variance, weight = _predict(j, query, near, state, points, turn, sigma)
        if weight == 0.0:
            continue
        gate = min(MAX_GATE_M, GATE_SIGMAS * math.sqrt(variance))
        place, squared = nearest(points, starts, frame, x, y, gate)
        _settle(j, place, state, taken)
        matched = state[j] >= 0
        here = _density(density, frame, x, y)
        gains = _gains(squared if matched else -1.0, variance, gate, here, shares[j])
        sure, doubtful = sure + gains[0], doubtful + gains[1]
        if matched:
            alike += _alike(sizes[j], theirs[place], usual[place], log_area, area_share)
            _turn(j, query, near, state, points, turn, a, b)
            _support(j, near, state, support, most)
        if max(sure, doubtful) + alike < GIVE_UP:
            return max(sure, doubtful), alike
    # Once more with all neighbours known: early guesses are put right, and the evidence is the final one.
    for _ in range(PASSES):
        sure, doubtful, alike = 0.0, 0.0, 0.0
        for j in range(count):
            x, y, a, b, variance, weight = _predict(j, query, near, state, points, turn, sigma)
            if weight == 0.0:
                if state[j] >= 0:
                    _settle(j, -1, state, taken)
                continue
            predicted[j, 0], predicted[j, 1] = x, y
            gate = min(MAX_GATE_M, GATE_SIGMAS * math.sqrt(variance))
            place, squared = nearest(points, starts, frame, x, y, gate)
            _settle(j, place, state, taken)
            matched = state[j] >= 0
            here = _density(density, frame, x, y)
            gains = _gains(squared if matched else -1.0, variance, gate, here, shares[j])
            sure, doubtful = sure + gains[0], doubtful + gains[1]
            if matched:
                alike += _alike(sizes[j], theirs[place], usual[place], log_area, area_share)
                _turn(j, query, near, state, points, turn, a, b)
    return _either(sure, doubtful), alike


@njit(nogil=True, cache=True)
def _grown_nats(about, corners, places, around, out):  # type: ignore[no-untyped-def]
    query, (points, starts, frame) = about[0], around[:3]
    taken = np.zeros(len(points), np.int32)
    state, predicted, seats = np.empty(len(query), np.int64), np.empty((len(query), 2)), np.empty(3, np.int64)
    for h in range(len(corners)):
        a, b, squares = 0.0, 0.0, 1e-9
        for k in range(3):
            seats[k], _ = nearest(points, starts, frame, places[h, k, 0], places[h, k, 1], TOUCHING_M)
            i, j, m = corners[h, k], corners[h, (k + 1) % 3], (k + 1) % 3
            x, y = query[j, 0] - query[i, 0], query[j, 1] - query[i, 1]
            u, v = places[h, m, 0] - places[h, k, 0], places[h, m, 1] - places[h, k, 1]
            a, b, squares = a + x * u + y * v, b + x * v - y * u, squares + x * x + y * y
        nats, alike = _grow(
            about, corners[h], seats, a / squares, b / squares, around, taken, state, predicted
        )
        out[h] = nats + alike


def _about(query: QueryMap) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.int64]]:
    """What the compiled loops take of a map."""
    return query.points_m, query.shares, query.sizes, query.neighbours


def grown_nats(
    query: QueryMap,
    corners: NDArray[np.int64],
    places_m: FloatArray,
    reference: Ground,
    config: MatcherConfig,
) -> FloatArray:
    """(C,) nats, of places and areas, of the match that grows from each seed, corners (C, 3) on places
    (C, 3, 2)."""
    out = np.empty(len(corners))
    about, around = _about(query), surroundings(reference, config)

    def work(part: NDArray[np.int64]) -> None:
        nats = np.empty(len(part))
        _grown_nats(about, corners[part], places_m[part], around, nats)
        out[part] = nats

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(work, np.array_split(np.arange(len(corners)), THREADS)))
    return out


def grow(
    query: QueryMap,
    corners: NDArray[np.int64],
    places_m: FloatArray,
    reference: Ground,
    config: MatcherConfig,
) -> list[tuple[int, Grown]]:
    """Grow a match from each seed, in order: its number and the match.

    A seed lays the map's triangle ``corners`` (C, 3) on the places (C, 3, 2) of reference buildings. One
    that agrees with an earlier match is not grown again, and one that speaks against itself is left out.
    """
    xy = query.points_m[corners]
    source, target = xy[..., 0] + 1j * xy[..., 1], places_m[..., 0] + 1j * places_m[..., 1]
    edges, moved = np.roll(source, -1, 1) - source, np.roll(target, -1, 1) - target
    turns = (np.conj(edges) * moved).sum(axis=1) / np.maximum((np.abs(edges) ** 2).sum(axis=1), 1e-9)
    about, around = _about(query), surroundings(reference, config)
    where = around[:3]
    states = np.empty((len(corners), len(query.points_m)), dtype=np.int64)
    taken = np.zeros(len(reference.buildings_m), dtype=np.int32)
    grown: list[tuple[int, Grown]] = []
    for c, triangle in enumerate(corners):
        seats = np.array([nearest(*where, x, y, TOUCHING_M)[0] for x, y in places_m[c]], dtype=np.int64)
        if (states[: len(grown), triangle] == seats).all(axis=1).any():
            continue
        state, predicted = states[len(grown)], np.empty((len(query.points_m), 2))
        start = (triangle, seats, turns[c].real, turns[c].imag)
        nats, alike = _grow(about, *start, around, taken, state, predicted)
        if nats > 0.0:
            matched = np.where(state >= 0, reference.grid.order[np.maximum(state, 0)], NO_MATCH)
            grown.append((c, Grown(matched, predicted, nats, alike)))
    return grown
