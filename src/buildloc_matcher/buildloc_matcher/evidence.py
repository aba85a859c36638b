"""How much the buildings around a hypothesis speak for it: log-likelihood ratios against chance.

A building of the map is in the reference with a probability, its share, and then lies where the
hypothesis puts it, up to a Gaussian error; else, or if the hypothesis is wrong, the nearest reference
building is as near as the local density of buildings has it. Nats throughout.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, uniform_filter
from scipy.spatial import cKDTree
from scipy.special import ndtr

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.geometry import area_around_m2
from buildloc_matcher.matching import THREADS
from buildloc_matcher.point_grid import Frame, PointGrid, grid_points, nearest

DENSITY_CELL_M = 100.0
DENSITY_CELLS = 3
MIN_DENSITY_PER_M2 = 2e-5
NEIGHBOURS = 12
WITNESSES = 16
LOOKED_AT = 64  # nearest buildings among which witnesses and neighbours are chosen
GATE_SIGMAS = 3.0
MAX_GATE_M = 16.0
HOPELESS = -10.0  # a hypothesis that has sunk below this is given up
NO_MATCH = -1
TOUCHING_M = 0.01
# Nobody knows how much a segmenter invents on this ground, as in snow: shares so much lower are as likely.
DOUBT = 0.4
# Of the logarithm of areas: spread of invented buildings; how wide a size of the map is; step of a histogram.
FALSE_SIZE_SPREAD, SIZE_BLUR, SIZE_STEP = 0.5, 0.3, 0.02
LEAST_REAL = 0.1
LEAST_AREA_M2 = 1e-3  # of a building that has a size at all
FEWEST_AREAS = 4
AREA_BIAS_SPREAD = 0.2  # how far all areas of a map may be off by the same factor, as a logarithm
MAX_AREA_BIAS = 0.5
MIN_AREA_SPREAD = 0.3
MOST_CHANCE = 0.9


@dataclass(frozen=True)
class Ground:
    """The buildings of the reference (N, 2) and their areas (N,), the same places in a grid, how dense they
    lie: (rows, columns) in cells of DENSITY_CELL_M; in the order of the grid the logarithms of the areas
    (N,) and how usual each is around it (N,), as a density; and their outlines as ``Buildings`` has them, or
    None."""

    buildings_m: FloatArray
    areas_m2: NDArray[np.floating]
    grid: PointGrid
    density_per_m2: FloatArray
    sizes: FloatArray
    usual: FloatArray
    outlines: NDArray[np.int16] | None = None


def ground(
    buildings_m: FloatArray, areas_m2: NDArray[np.floating], outlines: NDArray[np.int16] | None = None
) -> Ground:
    """Buildings (N, 2) with areas (N,) in a grid; the density is averaged over three by three cells, and so
    are the areas."""
    grid = grid_points(buildings_m)
    column, row = ((grid.points_m - (grid.west_m, grid.south_m)) // DENSITY_CELL_M).astype(np.int64).T
    sizes = np.log(np.maximum(areas_m2[grid.order].astype(np.float64), LEAST_AREA_M2))

    def around(values: FloatArray) -> FloatArray:
        summed = np.zeros((row.max() + 1, column.max() + 1))
        np.add.at(summed, (row, column), values)
        return np.asarray(uniform_filter(summed, DENSITY_CELLS, mode="constant"))

    count = around(np.ones(len(sizes)))
    mean, squared = (around(values)[row, column] / count[row, column] for values in (sizes, sizes**2))
    spread = np.sqrt(np.maximum(squared - mean**2, MIN_AREA_SPREAD**2))
    density = np.maximum(count / DENSITY_CELL_M**2, MIN_DENSITY_PER_M2)
    return Ground(buildings_m, areas_m2, grid, density, sizes, _normal(sizes - mean, spread), outlines)


def density_at(points_m: FloatArray, reference: Ground) -> FloatArray:
    """(N,) buildings per m2 around points (N, 2)."""
    cells = (points_m - (reference.grid.west_m, reference.grid.south_m)) // DENSITY_CELL_M
    last = np.array(reference.density_per_m2.shape)[::-1] - 1
    column, row = np.clip(cells.astype(np.int64), 0, last).T
    return np.asarray(reference.density_per_m2[row, column])


@dataclass(frozen=True)
class QueryMap:
    """Buildings of the map (N, 2) metres, their areas (N,) and the logarithms of these, with what probability
    the reference has each of them (N,), and of each its neighbours (N, NEIGHBOURS): near ones that the
    reference likely has first."""

    points_m: FloatArray
    areas_m2: FloatArray
    sizes: FloatArray
    shares: FloatArray
    neighbours: NDArray[np.int64]


def shares_of(points_m: FloatArray, areas_m2: FloatArray, config: MatcherConfig) -> FloatArray:
    """(N,) with what probability the reference has each building of a map: ``match_share`` of those that are
    none of the segmenter's inventions.

    So many are invented on the ground that was seen, about ``false_area_m2`` large. Where the map has hardly
    more buildings of a size than that, most of them are invented; in a town of small houses few are.
    """
    seen_m2, sizes = area_around_m2(points_m, config.observable_radius_m), np.log(areas_m2)
    low = float(sizes.min()) - 0.5 * SIZE_STEP
    counts = np.bincount(((sizes - low) / SIZE_STEP).astype(np.int64))
    blurred = gaussian_filter1d(counts.astype(float), SIZE_BLUR / SIZE_STEP, mode="constant") / SIZE_STEP
    found = np.interp(sizes, low + (0.5 + np.arange(len(counts))) * SIZE_STEP, blurred)
    spread = math.hypot(FALSE_SIZE_SPREAD, SIZE_BLUR)
    off = sizes - math.log(config.false_area_m2)
    # The blur is of buildings that are large enough for the map: of smaller ones none comes from there.
    least = math.log(max(config.min_area_m2, 1e-9) / config.false_area_m2)
    large = ndtr((off * (FALSE_SIZE_SPREAD / spread) ** 2 - least) * spread / (FALSE_SIZE_SPREAD * SIZE_BLUR))
    invented = config.false_per_km2 * 1e-6 * seen_m2 * _normal(off, spread) * large
    return np.asarray(config.match_share * np.clip(1.0 - invented / found, LEAST_REAL, 1.0))


def query_map(points_m: FloatArray, areas_m2: FloatArray, config: MatcherConfig) -> QueryMap:
    """The map's buildings with their neighbourhoods; N >= 2."""
    shares = shares_of(points_m, areas_m2, config)
    count = min(NEIGHBOURS, len(points_m) - 1)
    near = _nearest(points_m, points_m, shares, np.arange(len(points_m))[:, None])[:, :count]
    return QueryMap(np.ascontiguousarray(points_m), areas_m2, np.log(areas_m2), shares, near)


def _nearest(
    places_m: FloatArray, points_m: FloatArray, shares: FloatArray, own: NDArray[np.int64]
) -> NDArray[np.int64]:
    """(S, WITNESSES) rows of the buildings (N, 2) about places (S, 2), at most, without ``own`` (S, C);
    NO_MATCH pads. One counts as the farther away the less likely the reference has it."""
    count = min(len(points_m), LOOKED_AT)
    away, rows = cKDTree(points_m).query(places_m, k=np.arange(1, count + 1))
    ours = (rows[:, :, None] == own[:, None, :]).any(axis=2)
    order = np.argsort(np.where(ours, math.inf, away / shares[rows]), axis=1, kind="stable")[:, :WITNESSES]
    near = np.take_along_axis(np.where(ours, NO_MATCH, rows), order, axis=1)
    return np.ascontiguousarray(near.astype(np.int64))


def witnesses(query: QueryMap, triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """(S, W) buildings of the map, WITNESSES at most, about each triangle or pair (S, K), its corners left
    out: near ones that the reference likely has first; NO_MATCH pads."""
    if not len(triangles):
        return np.empty((0, WITNESSES), dtype=np.int64)
    return _nearest(query.points_m[triangles].mean(axis=1), query.points_m, query.shares, triangles)


@njit(nogil=True, cache=True, inline="always")
def _density(density, frame, x, y):  # type: ignore[no-untyped-def]
    row = min(density.shape[0] - 1, max(0, int((y - frame[1]) / DENSITY_CELL_M)))
    column = min(density.shape[1] - 1, max(0, int((x - frame[0]) / DENSITY_CELL_M)))
    return density[row, column]


@njit(nogil=True, cache=True, inline="always")
def _is_at(point, place):  # type: ignore[no-untyped-def]
    """Whether a reference building is the one at a place that was read from the reference."""
    return abs(point[0] - place[0]) <= TOUCHING_M and abs(point[1] - place[1]) <= TOUCHING_M


@njit(nogil=True, cache=True, inline="always")
def _gains(squared, variance, gate, density, share):  # type: ignore[no-untyped-def]
    """Log-likelihood ratios of one building, with its share and with DOUBT of it: its nearest reference
    building at this squared distance, or (negative) none within the gate."""
    doubtful = DOUBT * share
    if squared < 0.0:  # what chance puts there is as likely either way
        within = 1.0 - math.exp(-0.5 * gate * gate / variance)
        return math.log(1.0 - share * within), math.log(1.0 - doubtful * within)
    ratio = math.exp(squared * (math.pi * density - 0.5 / variance)) / (2.0 * math.pi * variance * density)
    return math.log(share * ratio + 1.0 - share), math.log(doubtful * ratio + 1.0 - doubtful)


@njit(nogil=True, cache=True, inline="always")
def _alike(ours, theirs, usual, sigma, share):  # type: ignore[no-untyped-def]
    """Log-likelihood ratio of the logarithm of a building's area, where one of the reference is matched whose
    size is so usual there."""
    off = (theirs - ours) / sigma
    likely = share * math.exp(-0.5 * off * off) / (sigma * math.sqrt(2.0 * math.pi))
    return math.log(likely / usual + 1.0 - share)


@njit(nogil=True, cache=True, inline="always")
def _either(sure, doubtful):  # type: ignore[no-untyped-def]
    """Evidence where the shares are as likely DOUBT of what they seem as right."""
    high = max(sure, doubtful)
    return high + math.log(0.5 * math.exp(sure - high) + 0.5 * math.exp(doubtful - high))


@njit(nogil=True, cache=True)
def _seed_evidence(query, shares, sizes, stars, corners, others, places, around, hopeless, out):  # type: ignore[no-untyped-def]
    """Evidence of hypotheses: query triangle or pair ``corners[stars[h]]`` lies on ``places[h]`` (K, 2).

    The similarity of the corners is carried outwards over the witnesses and refitted with each that
    is found (running sums of a least-squares fit).
    """
    points, starts, frame, density, theirs, usual, sigma, log_area, area_share = around
    held = np.empty(corners.shape[1] + others.shape[1], np.int64)
    for h in range(len(stars)):
        s, holds = stars[h], 0
        n, qx, qy, rx, ry, qq, real, imag = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        ox, oy = query[corners[s, 0], 0], query[corners[s, 0], 1]
        wx, wy = places[h, 0, 0], places[h, 0, 1]
        for k in range(corners.shape[1]):
            x, y = query[corners[s, k], 0] - ox, query[corners[s, k], 1] - oy
            u, v = places[h, k, 0] - wx, places[h, k, 1] - wy
            n += 1.0
            qx, qy, rx, ry, qq = qx + x, qy + y, rx + u, ry + v, qq + x * x + y * y
            real, imag = real + x * u + y * v, imag + x * v - y * u
        sure, doubtful = 0.0, 0.0
        for w in range(others.shape[1]):
            j = others[s, w]
            if j == NO_MATCH:
                break
            spread = qq - (qx * qx + qy * qy) / n
            a = (real - (qx * rx + qy * ry) / n) / spread
            b = (imag - (qx * ry - qy * rx) / n) / spread
            x, y = query[j, 0] - ox, query[j, 1] - oy
            dx, dy = x - qx / n, y - qy / n
            u, v = rx / n + a * dx - b * dy, ry / n + b * dx + a * dy
            variance = sigma * sigma * (1.0 + 1.0 / n + (dx * dx + dy * dy) / spread)
            gate = min(MAX_GATE_M, GATE_SIGMAS * math.sqrt(variance))
            place, squared = nearest(points, starts, frame, wx + u, wy + v, gate)
            here = _density(density, frame, wx + u, wy + v)
            for k in range(holds):
                if held[k] == place:
                    place = NO_MATCH
            for k in range(corners.shape[1]):
                if place >= 0 and _is_at(points[place], places[h, k]):
                    place = NO_MATCH
            gains = _gains(squared if place >= 0 else -1.0, variance, gate, here, shares[j])
            sure, doubtful = sure + gains[0], doubtful + gains[1]
            if place >= 0:
                alike = _alike(sizes[j], theirs[place], usual[place], log_area, area_share)
                sure, doubtful = sure + alike, doubtful + alike
                held[holds] = place
                holds += 1
                u, v = points[place, 0] - wx, points[place, 1] - wy
                n += 1.0
                qx, qy, rx, ry, qq = qx + x, qy + y, rx + u, ry + v, qq + x * x + y * y
                real, imag = real + x * u + y * v, imag + x * v - y * u
            if max(sure, doubtful) < hopeless:
                break
        out[h] = _either(sure, doubtful)


Surroundings = tuple[
    FloatArray, NDArray[np.int64], Frame, FloatArray, FloatArray, FloatArray, float, float, float,
]  # fmt: skip


def surroundings(reference: Ground, config: MatcherConfig) -> Surroundings:
    """What the compiled loops go by: the grid's points, starts and frame, densities, sizes and how usual
    these are; the errors of a place, m, and of the logarithm of an area, and the share of areas that are
    right up to that."""
    grid = reference.grid
    return (
        grid.points_m, grid.starts, grid.frame, reference.density_per_m2, reference.sizes, reference.usual,
        config.sigma_m, math.hypot(config.sigma_log_area, AREA_BIAS_SPREAD), config.area_share,
    )  # fmt: skip


def seed_evidence(
    query: QueryMap,
    triangles: NDArray[np.int64],
    stars: NDArray[np.int64],
    places_m: FloatArray,
    reference: Ground,
    config: MatcherConfig,
    hopeless: float = HOPELESS,
) -> FloatArray:
    """(H,) nats for hypotheses: the map's triangle (or pair) ``stars[h]``, a row of ``triangles`` (S, K),
    lies on places (H, K, 2). One that has sunk below ``hopeless`` is given up."""
    out = np.empty(len(stars))
    others = witnesses(query, triangles)
    parts = np.array_split(np.arange(len(stars)), THREADS)

    def work(part: NDArray[np.int64]) -> None:
        if len(part):
            rows = slice(part[0], part[-1] + 1)
            _seed_evidence(
                query.points_m, query.shares, query.sizes, stars[rows], triangles, others, places_m[rows],
                surroundings(reference, config), hopeless, out[rows],
            )  # fmt: skip

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(work, parts))
    return out


@njit(nogil=True, cache=True)
def _placed_evidence(moved, shares, points, starts, frame, density, sigma):  # type: ignore[no-untyped-def]
    total = 0.0
    gate = min(MAX_GATE_M, GATE_SIGMAS * sigma)
    for j in range(len(moved)):
        place, squared = nearest(points, starts, frame, moved[j, 0], moved[j, 1], gate)
        here = _density(density, frame, moved[j, 0], moved[j, 1])
        total += _gains(squared if place >= 0 else -1.0, sigma * sigma, gate, here, shares[j])[0]
    return total


def placed_evidence(
    moved_m: FloatArray, shares: FloatArray, reference: Ground, config: MatcherConfig
) -> float:
    """Nats for a map whose buildings lie at (N, 2) in the world, each of which the reference has with a
    probability (N,)."""
    where = (reference.grid.points_m, reference.grid.starts, reference.grid.frame)
    return float(_placed_evidence(moved_m, shares, *where, reference.density_per_m2, config.sigma_m))


def area_evidence(
    ours_m2: FloatArray,
    theirs_m2: NDArray[np.floating],
    around_m2: NDArray[np.floating],
    config: MatcherConfig,
) -> float:
    """Nats from the areas of matched buildings, of the map (P,) and of the reference (P,).

    By chance a match has the area of any building around (R,); a true one has ours, up to a common factor
    (roofs, shadows, scale), a log-normal error, and now and then something else altogether. Regular streets
    agree with each other in place, seldom in area.
    """
    if len(ours_m2) < FEWEST_AREAS:
        return 0.0
    ours, theirs, around = np.log(ours_m2), np.log(theirs_m2), np.log(around_m2)
    apart = theirs - ours
    apart = apart - np.clip(np.median(apart), -MAX_AREA_BIAS, MAX_AREA_BIAS)
    chance = _normal(theirs - np.median(around), max(MIN_AREA_SPREAD, float(np.std(around))))
    likely = config.area_share * _normal(apart, config.sigma_log_area)
    return float(np.sum(np.log(likely / chance + 1.0 - config.area_share)))


def absence_evidence(
    matched: int, observable_m: FloatArray, buildings: int, reference: Ground, config: MatcherConfig
) -> float:
    """Nats, at most 0, from reference buildings (R, 2) that a map of so many buildings should show: of a true
    place ``seen_share`` of them are ``matched``, of a wrong one as many as chance lays a building of the map
    beside.

    Where more are found than expected it says nothing: their places have been counted already.
    """
    expected = len(observable_m)
    if expected == 0:
        return 0.0
    ours_per_m2 = float(density_at(observable_m, reference).mean()) * buildings / expected
    chance = 1.0 - math.exp(-math.pi * config.mnn_distance_m**2 * ours_per_m2)
    seen = config.seen_share
    chance = min(chance, MOST_CHANCE * seen)  # a match always speaks for the place
    found = matched * math.log(seen / chance)
    return min(0.0, found + (expected - matched) * math.log((1.0 - seen) / (1.0 - chance)))


def scale_evidence(scale: float, config: MatcherConfig) -> float:
    """Nats from the scale between map and world: at most 0, where the altitude was right."""
    return -0.5 * ((scale - 1.0) / config.sigma_scale) ** 2


def _normal(values: FloatArray, sigma: float | FloatArray) -> FloatArray:
    return np.asarray(np.exp(-0.5 * (values / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi)))
