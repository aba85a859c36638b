"""New seeds where hypotheses have found something: a match that begins with a wrong corner goes astray.

A hypothesis lays the map on the reference. Of its buildings that come to lie beside one, triangles of
neighbours are seeds in their turn: around a true hypothesis, however rough, some of them are right.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import Ground, QueryMap
from buildloc_matcher.hypotheses import Hypotheses
from buildloc_matcher.point_grid import nearest

FOUND = 3  # neighbours of a building, two of which make a seed with it


@njit(nogil=True, cache=True)
def _lay(query, near, centre, positions, turns, points, starts, frame, gate, corners, seats):  # type: ignore[no-untyped-def]
    """Fill triangles of the map (M, 3) and the rows of the reference's grid beside their corners; how many
    there are."""
    count, found = 0, np.empty(len(query), np.int64)
    beside = np.empty(FOUND, np.int64)
    for h in range(len(positions)):
        for j in range(len(query)):
            x, y = query[j, 0] - centre[0], query[j, 1] - centre[1]
            u = positions[h, 0] + turns[h].real * x - turns[h].imag * y
            v = positions[h, 1] + turns[h].imag * x + turns[h].real * y
            found[j], _ = nearest(points, starts, frame, u, v, gate)
        for j in range(len(query)):
            if found[j] < 0:
                continue
            held = 0
            for k in near[j]:
                if held < FOUND and found[k] >= 0 and found[k] != found[j]:
                    beside[held] = k
                    held += 1
            for k in range(held):
                for m in range(k):
                    if found[beside[k]] != found[beside[m]]:
                        corners[count, 0], corners[count, 1], corners[count, 2] = j, beside[m], beside[k]
                        for c in range(3):
                            seats[count, c] = found[corners[count, c]]
                        count += 1
    return count


def reseeded(
    voters: Hypotheses, query: QueryMap, reference: Ground, most: int, config: MatcherConfig
) -> tuple[NDArray[np.int64], Hypotheses]:
    """Corners (H, 3) of the map and hypotheses with the same numbers, ``most`` at most, laid anew around the
    likeliest voters, one of each voting bin. They have no votes yet."""
    order = np.argsort(-voters.weights, kind="stable")
    bins = np.round(voters.positions_m[order] / config.bin_size_m).astype(np.int64)
    _, first = np.unique(bins, axis=0, return_index=True)
    each = FOUND * (FOUND - 1) // 2 * len(query.points_m)
    rows = order[np.sort(first)[: min(config.reseeded, most // each)]]
    centre, grid = query.points_m.mean(axis=0), reference.grid
    corners = np.empty((each * len(rows), 3), dtype=np.int64)
    seats = np.empty_like(corners)
    count = _lay(
        query.points_m, query.neighbours, centre, voters.positions_m[rows],
        voters.scales[rows] * np.exp(1j * voters.yaws_rad[rows]), grid.points_m, grid.starts, grid.frame,
        config.mnn_distance_m, corners, seats,
    )  # fmt: skip
    corners, places = corners[:count], grid.points_m[seats[:count]]
    ours, theirs = query.points_m[corners] @ (1.0, 1.0j), places @ (1.0, 1.0j)
    middle, their_middle = ours.mean(axis=1), theirs.mean(axis=1)
    ours, theirs = ours - middle[:, None], theirs - their_middle[:, None]
    turns = (np.conj(ours) * theirs).sum(axis=1) / np.maximum((np.abs(ours) ** 2).sum(axis=1), 1e-9)
    moved = their_middle + turns * (centre @ (1.0, 1.0j) - middle)
    kept = np.abs(np.abs(turns) - 1.0) <= config.scale_gate
    return corners[kept], Hypotheses(
        np.arange(kept.sum()), places[kept], np.column_stack([moved.real, moved.imag])[kept],
        np.angle(turns)[kept], np.abs(turns)[kept], np.zeros(kept.sum()), mirrored=0, off_scale=0,
    )  # fmt: skip
