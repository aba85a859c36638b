"""Compatibility filter (Eq. 1) and star score (Eq. 2) of query stars against all reference stars: exact."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from buildloc_matcher import star_index
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.descriptors import AREA, PERIMETER, SHAPE, Triangles
from buildloc_matcher.star_index import (
    AREA_ROW,
    AREAS_M2,
    CORNER_ROW,
    MIDDLE_ANGLE_RAD,
    MIDDLE_CELL_STEPS,
    MIDDLE_CELLS,
    PERIMETERS_M,
    SHAPE_ROW,
    SMALL_ANGLE_RAD,
    SMALL_CELL_STEPS,
    SMALL_CELLS,
    STEPS,
)

SMALL_STEP = np.float32(SMALL_ANGLE_RAD / STEPS)
MIDDLE_STEP = np.float32(MIDDLE_ANGLE_RAD / STEPS)
SHAPE_STEP = np.float32(1.0 / STEPS)
PERIMETER_MIN, PERIMETER_MAX = (np.float32(math.log(end)) for end in PERIMETERS_M)
PERIMETER_STEP = np.float32(math.log(PERIMETERS_M[1] / PERIMETERS_M[0]) / STEPS)
AREA_MIN, AREA_MAX = (np.float32(math.log(end)) for end in AREAS_M2)
AREA_STEP = np.float32(math.log(AREAS_M2[1] / AREAS_M2[0]) / STEPS)
PI = np.float32(math.pi)
SLACK = np.float32(1e-4)  # bounds are loosened by more than float32 rounds
ZERO, QUARTER, THIRD, HALF = np.float32(0.0), np.float32(0.25), np.float32(1.0 / 3.0), np.float32(0.5)
ONE, TWO, THREE, FOUR = np.float32(1.0), np.float32(2.0), np.float32(3.0), np.float32(4.0)
TINY, HUGE, IMPOSSIBLE = np.float32(1e-6), np.float32(1e6), np.float32(-1e3)
NOTHING = -1
RUN = 512
LEVELS = 256
THREADS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class QueryStars:
    """Stars of a map: ``features`` (S, 4, 8) and the sorted areas (S, 3) of their central vertices, m2."""

    features: NDArray[np.float32]
    areas_m2: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.features)

    def select(self, rows: NDArray[np.integer]) -> QueryStars:
        """The stars of these rows."""
        return QueryStars(self.features[rows], self.areas_m2[rows])


def query_stars(triangles: Triangles, areas_m2: NDArray[np.floating]) -> QueryStars:
    """The stars of triangles of buildings with areas (N,)."""
    return QueryStars(triangles.star_features(), star_index.corner_areas(triangles, areas_m2))


@dataclass(frozen=True)
class Matches:
    """The best reference stars of every query star, K at most.

    ``reference`` (S, K) numbers of reference stars, best first, NOTHING where there are fewer; ``score``
    (S, K) float32 in [0, 1]. ``tested`` counts the pairs whose sketches were compared, ``passed`` those
    that passed the filter and could have been among the best.
    """

    reference: NDArray[np.int64]
    score: NDArray[np.float32]
    tested: int
    passed: int

    def __len__(self) -> int:
        return int((self.reference != NOTHING).sum())


@dataclass(frozen=True)
class StarTable:
    """Reference stars in the order of the index: ``sketches`` (22, S), ``starts`` of the cells, features,
    neighbours and vertices of their triangles, areas of the buildings; ``first`` is the number of the first
    star among those of all tables."""

    sketches: NDArray[np.uint8]
    starts: NDArray[np.int64]
    features: NDArray[np.float32]
    neighbours: NDArray[np.int32]
    vertices: NDArray[np.int32]
    areas_m2: NDArray[np.float32]
    first: int

    def __len__(self) -> int:
        return int(self.sketches.shape[1])


def star_table(
    triangles: Triangles, areas_m2: NDArray[np.float32], sketches: NDArray[np.uint8], first: int = 0
) -> StarTable:
    """The table of triangles that :func:`star_index.index_triangles` has put in order."""
    starts = star_index.cell_starts(sketches)
    return StarTable(
        sketches, starts, triangles.features, triangles.neighbours, triangles.vertices, areas_m2, first
    )


def scoring(config: MatcherConfig) -> tuple[np.float32, ...]:
    """What the score and the filter need, as compiled loops take it."""
    values = (
        math.radians(config.tau_angle_deg), config.tau_perimeter, config.tau_shape,
        math.radians(config.score_angle_deg), config.score_perimeter, config.score_area,
        config.area_weight, config.centre_weight,
    )  # fmt: skip
    return tuple(np.float32(value) for value in values)


@njit(nogil=True, cache=True, inline="always")
def _log_within(value, low, high):  # type: ignore[no-untyped-def]
    """The logarithm of a value, or the end of the range that it lies beyond."""
    return min(high, max(low, np.float32(math.log(max(value, TINY)))))


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _bounds(star, areas, settings, sketches, begin, end, bounds):  # type: ignore[no-untyped-def]
    """The largest score that a run of sketches allows, times the sum of all weights; IMPOSSIBLE where Eq. 1
    fails.

    A step stands for its middle, give or take half a step; what lies beyond the first or the last counts as
    their end on both sides, which brings the two no further apart. One loop a triangle, without branches:
    the compiler turns it into vector instructions, which is what makes the search fast.
    """
    tau_angle, _, tau_shape, angle, perimeter, area, area_weight, centre_weight = settings
    per_angle, per_perimeter, per_area = ONE / angle, ONE / perimeter, ONE / area
    half1, half2, half_p = HALF * SMALL_STEP, HALF * MIDDLE_STEP, HALF * PERIMETER_STEP
    half_a, half_s = HALF * AREA_STEP, HALF * SHAPE_STEP
    give1, give2, give3 = half1 + SLACK, half2 + SLACK, half1 + half2 + SLACK
    give_p, give_a, give_s = half_p + SLACK, half_a + SLACK, half_s + SLACK
    count = end - begin
    bounds = bounds[:count]
    for j in range(4):
        steps1, steps2 = sketches[3 * j, begin:end], sketches[3 * j + 1, begin:end]
        steps_p = sketches[3 * j + 2, begin:end]
        steps_a = sketches[AREA_ROW + max(0, j - 1), begin:end]
        off1, off2 = half1 - star[j, 0], half2 - star[j, 1]
        off3 = (PI - half1 - half2) - (PI - star[j, 0] - star[j, 1])
        off_p = PERIMETER_MIN + half_p - _log_within(star[j, PERIMETER], PERIMETER_MIN, PERIMETER_MAX)
        off_a = AREA_MIN + half_a - _log_within(star[j, AREA], AREA_MIN, AREA_MAX)
        limit = tau_angle if j == 0 else HUGE
        weight = centre_weight if j == 0 else ONE
        weight_a = ZERO if j == 0 else area_weight
        for i in range(count):
            angle1, angle2 = np.float32(steps1[i]) * SMALL_STEP, np.float32(steps2[i]) * MIDDLE_STEP
            d_angle = (
                max(ZERO, abs(angle1 + off1) - give1)
                + max(ZERO, abs(angle2 + off2) - give2)
                + max(ZERO, abs(off3 - angle1 - angle2) - give3)
            )
            apart = min(ONE, max(ZERO, abs(np.float32(steps_p[i]) * PERIMETER_STEP + off_p) - give_p))
            apart_a = min(ONE, max(ZERO, abs(np.float32(steps_a[i]) * AREA_STEP + off_a) - give_a))
            # 1 - exp(-x) >= x - x^2 / 2 turns a difference of logarithms into one of ratios.
            s_perimeter = max(ZERO, ONE - (apart - HALF * apart * apart) * per_perimeter)
            s_area = max(ZERO, ONE - (apart_a - HALF * apart_a * apart_a) * per_area)
            bound = TWO * max(ZERO, ONE - d_angle * per_angle) + s_perimeter + ONE + weight_a * s_area
            bounds[i] += IMPOSSIBLE if d_angle >= limit else weight * bound
    for i in range(count):
        d_shape, d_area = ZERO, ZERO
        for m in range(4):
            step = np.float32(sketches[SHAPE_ROW + m, begin + i]) * SHAPE_STEP
            d_shape += max(ZERO, abs(step + half_s - star[0, SHAPE + m]) - give_s)
        for m in range(3):
            step = np.float32(sketches[CORNER_ROW + m, begin + i]) * AREA_STEP
            apart = min(ONE, max(ZERO, abs(step + AREA_MIN + half_a - areas[m]) - give_a))
            d_area += apart - HALF * apart * apart
        d_shape *= QUARTER
        s_area = max(ZERO, ONE - d_area * THIRD * per_area)
        bounds[i] += IMPOSSIBLE if d_shape > tau_shape else centre_weight * (area_weight * s_area - d_shape)


@njit(nogil=True, cache=True, inline="always")
def _differences(q, r):  # type: ignore[no-untyped-def]
    """d_alpha, d_P, d_S (Eq. 1) of two triangles; float32 in the order of the oracle."""
    third = abs((PI - r[0] - r[1]) - (PI - q[0] - q[1]))
    d_angle = abs(r[0] - q[0]) + abs(r[1] - q[1]) + third
    d_perimeter = abs(r[PERIMETER] - q[PERIMETER]) / max(r[PERIMETER], q[PERIMETER])
    d_shape = QUARTER * (abs(r[4] - q[4]) + abs(r[5] - q[5]) + abs(r[6] - q[6]) + abs(r[7] - q[7]))
    return d_angle, d_perimeter, d_shape


@njit(nogil=True, cache=True, inline="always")
def _agreement(q, r, d_area, settings):  # type: ignore[no-untyped-def]
    """Eq. 2 of one triangle, with the agreement of areas as a fourth term."""
    _, _, _, angle, perimeter, area, area_weight, _ = settings
    d_angle, d_perimeter, d_shape = _differences(q, r)
    s_angle = max(ZERO, ONE - d_angle / angle)
    s_perimeter = max(ZERO, ONE - d_perimeter / perimeter)
    s_area = max(ZERO, ONE - d_area / area)
    return (TWO * s_angle + s_perimeter + (ONE - d_shape) + area_weight * s_area) / (FOUR + area_weight)


@njit(nogil=True, cache=True, inline="always")
def _apart(one, other):  # type: ignore[no-untyped-def]
    return abs(one - other) / max(one, other)


@njit(nogil=True, cache=True, inline="always")
def _score(star, areas, row, features, neighbours, vertices, building_areas, settings):  # type: ignore[no-untyped-def]
    """The score of a query star and a reference star."""
    one, two = building_areas[vertices[row, 0]], building_areas[vertices[row, 1]]
    three = building_areas[vertices[row, 2]]
    low, high = min(one, two), max(one, two)
    low, three = min(low, three), max(low, three)
    high, three = min(high, three), max(high, three)
    d_area = THIRD * (_apart(areas[0], low) + _apart(areas[1], high) + _apart(areas[2], three))
    centre_weight = settings[7]
    total = centre_weight * _agreement(star[0], features[row], d_area, settings)
    for j in range(3):
        q, r = star[j + 1], features[neighbours[row, j]]
        total += _agreement(q, r, _apart(q[AREA], r[AREA]), settings)
    return total / (centre_weight + THREE)


@njit(nogil=True, cache=True)
def _window(star, tau_angle, tau_perimeter):  # type: ignore[no-untyped-def]
    """Cells of the small and the middle angle, and steps of the perimeter, that the filter can pass."""
    # A difference of one angle is at most half the sum of all three: they add up to zero.
    reach = HALF * tau_angle + SLACK
    low1 = max(0, int((star[0, 0] - reach) / SMALL_STEP) // SMALL_CELL_STEPS)
    high1 = min(SMALL_CELLS - 1, int((star[0, 0] + reach) / SMALL_STEP) // SMALL_CELL_STEPS)
    low2 = max(0, int((star[0, 1] - reach) / MIDDLE_STEP) // MIDDLE_CELL_STEPS)
    high2 = min(MIDDLE_CELLS - 1, int((star[0, 1] + reach) / MIDDLE_STEP) // MIDDLE_CELL_STEPS)
    log_p = np.float32(math.log(max(star[0, PERIMETER], TINY))) - PERIMETER_MIN
    reach_p = SLACK - np.float32(math.log(max(ONE - tau_perimeter, TINY)))
    low_p = min(STEPS - 1, max(0, math.floor((log_p - reach_p) / PERIMETER_STEP)))
    high_p = min(STEPS - 1, max(0, math.floor((log_p + reach_p) / PERIMETER_STEP)))
    return low1, high1, low2, high2, low_p, high_p


@njit(nogil=True, cache=True)
def _cell_distance(star, c1, c2):  # type: ignore[no-untyped-def]
    """The least d_alpha (Eq. 1) of a star to those of a cell."""
    wide1, wide2 = SMALL_STEP * SMALL_CELL_STEPS, MIDDLE_STEP * MIDDLE_CELL_STEPS
    low1, low2 = c1 * wide1, c2 * wide2
    gap1 = max(ZERO, max(low1 - star[0, 0], star[0, 0] - low1 - wide1))
    gap2 = max(ZERO, max(low2 - star[0, 1], star[0, 1] - low2 - wide2))
    sum_low = low1 + low2 - star[0, 0] - star[0, 1]  # the largest angle differs by as much as the sum
    return gap1 + gap2 + max(ZERO, max(sum_low, -sum_low - wide1 - wide2)) - SLACK


@njit(nogil=True, cache=True)
def _first_not_below(steps, begin, end, value):  # type: ignore[no-untyped-def]
    """First index in [begin, end) of sorted steps that is at least ``value``, else ``end``."""
    while begin < end:
        middle = (begin + end) // 2
        if steps[middle] < value:
            begin = middle + 1
        else:
            end = middle
    return begin


@njit(nogil=True, cache=True)
def _insert(best, scores, count, number, score):  # type: ignore[no-untyped-def]
    """Insert into rows sorted by falling score, then rising number; the new count."""
    kept = len(best)
    if count == kept and (
        score < scores[kept - 1] or (score == scores[kept - 1] and number > best[kept - 1])
    ):
        return count
    at = min(count, kept - 1)
    while at > 0 and (scores[at - 1] < score or (scores[at - 1] == score and best[at - 1] > number)):
        scores[at], best[at] = scores[at - 1], best[at - 1]
        at -= 1
    scores[at], best[at] = score, number
    return min(count + 1, kept)


@njit(nogil=True, cache=True)
def _candidates(star, areas, settings, sketches, starts, enough):  # type: ignore[no-untyped-def]
    """Rows whose sketch allows a score of ``enough`` or more, what it allows, and the pairs tested."""
    low1, high1, low2, high2, low_p, high_p = _window(star, settings[0], settings[1])
    logs = np.empty(3, np.float32)
    for m in range(3):
        logs[m] = _log_within(areas[m], AREA_MIN, AREA_MAX)
    size = 0
    for c1 in range(low1, high1 + 1):
        size += starts[c1 * MIDDLE_CELLS + high2 + 1] - starts[c1 * MIDDLE_CELLS + low2]
    rows, ceilings = np.empty(size, np.int32), np.empty(size, np.float32)
    bounds = np.empty(RUN, np.float32)
    found, tested = 0, 0
    for c1 in range(low1, high1 + 1):
        for c2 in range(low2, high2 + 1):
            at = c1 * MIDDLE_CELLS + c2
            if _cell_distance(star, c1, c2) >= settings[0]:
                continue
            begin = _first_not_below(sketches[2], starts[at], starts[at + 1], low_p)
            last = _first_not_below(sketches[2], begin, starts[at + 1], high_p + 1)
            tested += last - begin
            while begin < last:
                end = min(begin + RUN, last)
                bounds[: end - begin] = ZERO
                _bounds(star, logs, settings, sketches, begin, end, bounds)
                for i in range(end - begin):
                    if bounds[i] >= enough:
                        rows[found], ceilings[found] = begin + i, bounds[i]
                        found += 1
                begin = end
    return rows[:found], ceilings[:found], tested


@njit(nogil=True, cache=True)
def _promising(ceilings, wanted, most):  # type: ignore[no-untyped-def]
    """A ceiling that about ``wanted`` rows reach; ``most`` is the largest possible."""
    counts = np.zeros(LEVELS, np.int64)
    for ceiling in ceilings:
        counts[min(LEVELS - 1, int(ceiling / most * LEVELS))] += 1
    level, above = LEVELS, 0
    while level > 0 and above < wanted:
        level -= 1
        above += counts[level]
    return np.float32(level) / np.float32(LEVELS) * most


@njit(nogil=True, cache=True)
def _match(  # type: ignore[no-untyped-def]
    stars,
    areas,
    settings,
    sketches,
    starts,
    features,
    neighbours,
    vertices,
    building_areas,
    first,
    best,
    scores,
    counts,
):
    """Improve ``best`` and ``scores`` (S, K) of query stars (S, 4, 8) with the stars of one table.

    A pair is skipped only when its sketch proves that it fails the filter or scores below the K-th best.
    The most promising pairs go first, so that the K-th best is soon high enough to skip most others.
    """
    tau_angle, tau_perimeter, tau_shape = settings[0], settings[1], settings[2]
    weights = (FOUR + settings[6]) * (settings[7] + THREE)
    kept = best.shape[1]
    for s in range(len(stars)):
        star = stars[s]
        count = 0
        while count < kept and best[s, count] != NOTHING:
            count += 1
        enough = weights * (scores[s, kept - 1] - SLACK) if count == kept else ZERO
        rows, ceilings, tested = _candidates(star, areas[s], settings, sketches, starts, enough)
        counts[0] += tested
        cut = _promising(ceilings, 2 * kept, weights)
        for promising in (True, False):
            for i in range(len(rows)):
                if (ceilings[i] >= cut) != promising or ceilings[i] < enough:
                    continue
                row = rows[i]
                d_angle, d_perimeter, d_shape = _differences(star[0], features[row])
                if d_angle >= tau_angle or d_perimeter > tau_perimeter or d_shape > tau_shape:
                    continue
                counts[1] += 1
                score = _score(star, areas[s], row, features, neighbours, vertices, building_areas, settings)
                count = _insert(best[s], scores[s], count, first + row, score)
                if count == kept:
                    enough = weights * (scores[s, kept - 1] - SLACK)


def match_stars(stars: QueryStars, tables: Sequence[StarTable], config: MatcherConfig) -> Matches:
    """The best ``matches_per_star`` compatible reference stars of every query star.

    Equal to :func:`buildloc_matcher.oracle.match_stars`. Ties go to the lower reference number, so the
    answer does not depend on the order of the work.
    """
    kept = config.matches_per_star
    best = np.full((len(stars), kept), NOTHING, dtype=np.int64)
    scores = np.zeros((len(stars), kept), dtype=np.float32)
    settings = scoring(config)
    parts = np.array_split(np.arange(len(stars)), max(1, min(len(stars), 4 * THREADS)))
    counts = np.zeros((len(parts), 2), dtype=np.int64)

    def work(part: int) -> None:
        rows = slice(parts[part][0], parts[part][-1] + 1)
        for table in tables:
            _match(
                stars.features[rows], stars.areas_m2[rows], settings, table.sketches, table.starts,
                table.features, table.neighbours, table.vertices, table.areas_m2, table.first,
                best[rows], scores[rows], counts[part],
            )  # fmt: skip

    if len(stars):
        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(work, range(len(parts))))
    return Matches(best, scores, int(counts[:, 0].sum()), int(counts[:, 1].sum()))
