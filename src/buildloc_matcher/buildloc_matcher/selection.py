"""Candidates scored: where each puts the map's buildings, MNN-Jaccard (Eq. 4), evidence against chance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import (
    Ground,
    QueryMap,
    absence_evidence,
    area_evidence,
    placed_evidence,
    scale_evidence,
)
from buildloc_matcher.geometry import Similarity, fit_similarity, wrap
from buildloc_matcher.growth import Grown, grow
from buildloc_matcher.hypotheses import Hypotheses
from buildloc_matcher.point_grid import near, nearest
from buildloc_matcher.voting import Ballot, Cluster

GROWN_SCORED = 30  # distinct grown matches that get the full score
NEGLIGIBLE_NATS = 60.0  # a match that much less likely than the best is not listed
LOCAL_M = 100.0  # pairs around a place that tell how the map lies there, and how many it takes
LOCAL_PAIRS = 6
# How far the pieces of a match lie apart, how near they meet, and the share of a piece that lies at the seam.
TORN_M, NEIGHBOUR_M, CONTRADICTED = 100.0, 40.0, 0.5
SHIFT_M = 100.0  # how far a match is moved to see whether it fits as well there


@dataclass(frozen=True)
class Score:
    """A scored candidate.

    ``transform`` map -> world as a whole; ``moved_m`` (N, 2) where the match puts each building of the map,
    which for a grown match follows the map's bend; ``pairs`` (P, 2) mutual neighbours, rows of the map and
    of the reference, and their RMS distance; MNN-Jaccard; evidence in nats.
    """

    transform: Similarity
    moved_m: FloatArray
    pairs: NDArray[np.int64]
    rms_m: float
    jaccard: float
    evidence: float


def local_transform(
    score: Score, at_m: FloatArray, query: QueryMap, reference: Ground, config: MatcherConfig
) -> Similarity:
    """The similarity map -> world as it is around a point (2,) of the map: the map may bend elsewhere."""
    if config.selection == "rigid" or len(score.pairs) < 3:
        return score.transform
    source, target = query.points_m[score.pairs[:, 0]], reference.buildings_m[score.pairs[:, 1]]
    away = np.hypot(*(source - at_m).T)
    # Wide enough for some pairs, so that a lonely end of the map goes on as it came.
    reach = max(LOCAL_M, beyond_m(score, at_m, query))
    return fit_similarity(source, target, config.scale_gate, np.exp(-0.5 * (away / reach) ** 2))


def beyond_m(score: Score, at_m: FloatArray, query: QueryMap) -> float:
    """How far from a point (2,) of the map the LOCAL_PAIRS nearest matched buildings reach; 0 without any."""
    away = np.sort(np.hypot(*(query.points_m[score.pairs[:, 0]] - at_m).T))
    return float(away[min(LOCAL_PAIRS, len(away)) - 1]) if len(away) else 0.0


def mutual_pairs(query_m: FloatArray, reference_m: FloatArray, max_distance_m: float) -> NDArray[np.int64]:
    """(P, 2) indices (query, reference) of mutual nearest neighbours closer than the distance."""
    if len(query_m) == 0 or len(reference_m) == 0:
        return np.empty((0, 2), dtype=np.int64)
    distance, to_reference = cKDTree(reference_m).query(query_m)
    _, to_query = cKDTree(query_m).query(reference_m)
    queries = np.arange(len(query_m))
    mutual = (to_query[to_reference] == queries) & (distance < max_distance_m)
    return np.column_stack([queries[mutual], to_reference[mutual]]).astype(np.int64)


def observable(query_m: FloatArray, reference: Ground, config: MatcherConfig) -> NDArray[np.int64]:
    """Rows of the reference buildings the map should have seen: inside the hull of the map's buildings
    grown by the margin, and within the radius of one of them (a flight along an L does not see the inside
    of its hull)."""
    if len(query_m) == 0:
        return np.empty(0, dtype=np.int64)
    rows = near(reference.grid, query_m, config.observable_radius_m)
    hull = shapely.MultiPoint(query_m).convex_hull.buffer(config.observable_margin_m)
    shapely.prepare(hull)
    x, y = reference.buildings_m[rows].T
    return np.asarray(rows[shapely.contains_xy(hull, x, y)], dtype=np.int64)


def mnn_jaccard(
    query_m: FloatArray, reference: Ground, config: MatcherConfig
) -> tuple[float, NDArray[np.int64]]:
    """J = |M| / (|Q| + |R| - |M|) of buildings (N, 2) in the world, and the pairs M (P, 2): rows of the map
    and of the reference. R are the reference's observable buildings."""
    return _overlap(query_m, observable(query_m, reference, config), reference, config)


def _overlap(
    query_m: FloatArray, seen: NDArray[np.int64], reference: Ground, config: MatcherConfig
) -> tuple[float, NDArray[np.int64]]:
    pairs = mutual_pairs(query_m, reference.buildings_m[seen], config.mnn_distance_m)
    union = len(query_m) + len(seen) - len(pairs)
    return (len(pairs) / union if union else 0.0), np.column_stack([pairs[:, 0], seen[pairs[:, 1]]])


def select(
    ballot: Ballot,
    voters: Hypotheses,
    corners: NDArray[np.int64],
    query: QueryMap,
    reference: Ground,
    config: MatcherConfig,
) -> list[tuple[Cluster, Score]]:
    """Clusters with their scores, best first: by MNN-Jaccard, or by evidence where matches grow.

    ``corners`` (S, 3) are the map's buildings at the corners of its stars.
    """
    if config.selection == "rigid":
        rigid = [(c, score_rigid(_start(c, query), query, reference, config)) for c in ballot.clusters]
        return sorted(rigid, key=lambda pair: (-pair[1].jaccard, -pair[0].votes))
    if not ballot.clusters:
        return []
    clusters = [cluster for cluster in ballot.clusters for _ in cluster.seeds]
    best = [row for cluster in ballot.clusters for row in cluster.seeds]
    seeds, places = corners[voters.stars[best]], voters.places_m[best]
    grown = grow(query, seeds, places, reference, config)
    listed: list[_Listed] = []
    tested: set[int] = set()
    while True:
        _list(grown, listed, clusters, query, reference, config)
        first = listed[0].seed if listed else -1
        if first < 0 or first in tested:
            return [(clusters[one.seed], one.score) for one in listed]
        tested.add(first)
        moved = shifted(places[first], reference, config)
        corner = np.repeat(seeds[first : first + 1], len(moved), axis=0)
        grown = [(first, match) for _, match in grow(query, corner, moved, reference, config)]


@dataclass(frozen=True)
class _Listed:
    """A grown match with its full score and the number of its seed."""

    seed: int
    matches: NDArray[np.int64]
    score: Score


def _list(
    grown: Sequence[tuple[int, Grown]],
    listed: list[_Listed],
    clusters: Sequence[Cluster],
    query: QueryMap,
    reference: Ground,
    config: MatcherConfig,
) -> None:
    """Add the best of the matches (by the number of their seed) that are unlike those in the list, scored,
    best first; ``clusters`` are those of the seeds."""
    ranked = sorted(
        ((match.evidence + match.alike, seed, match) for seed, match in grown), key=lambda one: -one[0]
    )
    added = 0
    for nats, seed, match in ranked:
        if added == GROWN_SCORED or nats < ranked[0][0] - NEGLIGIBLE_NATS:
            break
        if any(_same(match.matches, other.matches) for other in listed):
            continue
        score = score_grown(_start(clusters[seed], query), match, query, reference, config)
        if all(_apart(score, other.score) > config.mnn_distance_m for other in listed):
            listed.append(_Listed(seed, match.matches, score))
            added += 1
    listed.sort(key=lambda one: -one.score.evidence)


def _same(one: NDArray[np.int64], other: NDArray[np.int64]) -> bool:
    """Whether half of one's matched buildings have the same places in the other."""
    matched = one >= 0
    return 2 * int(np.count_nonzero(one[matched] == other[matched])) >= int(np.count_nonzero(matched))


def _apart(one: Score, other: Score) -> float:
    """Median distance between the places of the map's buildings, m: small where two seeds gave one match."""
    return float(np.median(np.linalg.norm(one.moved_m - other.moved_m, axis=1)))


def shifted(places_m: FloatArray, reference: Ground, config: MatcherConfig) -> FloatArray:
    """(K, 3, 2) other triangles of reference buildings, as a seed (3, 2) moved from house to house meets
    them, as it is and turned by half a circle.

    Streets repeat themselves: in a regular row a match fits as well one house further on, or the other way
    round. Votes do not show that, since the voting bins are larger than a house.
    """
    grid = reference.grid
    where = (grid.points_m, grid.starts, grid.frame)
    around = reference.buildings_m[near(grid, places_m[:1], SHIFT_M)]
    found = []
    for turn in (1.0, -1.0):
        turned = places_m.mean(axis=0) + turn * (places_m - places_m.mean(axis=0))
        for moved in (turned + (around - turned[0])[:, None]).tolist():
            hits = [nearest(*where, x, y, config.mnn_distance_m)[0] for x, y in moved]
            if min(hits) >= 0 and len(set(hits)) == len(hits):
                found.append(grid.points_m[hits])
    return np.array(found).reshape(-1, 3, 2)


def pieces_of_one(one: Score, other: Score, query: QueryMap, config: MatcherConfig) -> bool:
    """Whether two matches are pieces of one that the map's bend has torn: they lie near each other, turned
    alike, and match different parts of the map. Where both match some buildings of the same neighbourhood,
    and put it in two places, they contradict each other."""
    turn = abs(float(wrap(one.transform.yaw_rad - other.transform.yaw_rad)))
    if _apart(one, other) > TORN_M or turn > math.radians(2.0 * config.rotation_tolerance_deg):
        return False
    if not len(one.pairs) or not len(other.pairs):
        return False
    matched = other.pairs[:, 0]
    away_m, _ = cKDTree(query.points_m[one.pairs[:, 0]]).query(query.points_m[matched])
    moved_m = np.linalg.norm(one.moved_m[matched] - other.moved_m[matched], axis=1)
    contradicted = (away_m < NEIGHBOUR_M) & (moved_m > config.mnn_distance_m)
    return bool(np.mean(contradicted) < CONTRADICTED)


def _start(cluster: Cluster, query: QueryMap) -> Similarity:
    """The cluster's mean transform."""
    centre = query.points_m.mean(axis=0)
    anchor, world = (float(centre[0]), float(centre[1])), (cluster.x_m, cluster.y_m)
    return Similarity(anchor, world, cluster.yaw_rad, cluster.scale)


def score_rigid(transform: Similarity, query: QueryMap, reference: Ground, config: MatcherConfig) -> Score:
    """A candidate as the paper scores it: one transform for the whole map."""
    moved = transform.apply(query.points_m)
    evidence = placed_evidence(moved, query.shares, reference, config)
    return _scored(transform, moved, evidence, query, reference, config)


def score_grown(
    start: Similarity, grown: Grown, query: QueryMap, reference: Ground, config: MatcherConfig
) -> Score:
    """A grown candidate; buildings it never reached lie where its transform puts them.

    ``start`` serves where fewer than three buildings matched.
    """
    matched = np.flatnonzero(grown.matches >= 0)
    if len(matched) < 3:
        return score_rigid(start, query, reference, config)
    places = reference.buildings_m[grown.matches[matched]]
    transform = fit_similarity(query.points_m[matched], places, config.scale_gate)
    reached = ~np.isnan(grown.predicted_m[:, 0])
    moved = np.where(reached[:, None], grown.predicted_m, transform.apply(query.points_m))
    return _scored(transform, moved, grown.evidence, query, reference, config)


def _scored(
    transform: Similarity,
    moved_m: FloatArray,
    evidence: float,
    query: QueryMap,
    reference: Ground,
    config: MatcherConfig,
) -> Score:
    """``evidence`` is that of the places; those of areas, scale and what is not seen are added."""
    seen = observable(moved_m, reference, config)
    jaccard, pairs = _overlap(moved_m, seen, reference, config)
    squared = np.sum((moved_m[pairs[:, 0]] - reference.buildings_m[pairs[:, 1]]) ** 2, axis=1)
    rms = math.sqrt(squared.mean()) if len(pairs) else math.inf
    around = reference.areas_m2[near(reference.grid, moved_m, config.observable_radius_m)]
    ours, theirs = query.areas_m2[pairs[:, 0]], reference.areas_m2[pairs[:, 1]]
    total = evidence + area_evidence(ours, theirs, around, config) + scale_evidence(transform.scale, config)
    total += absence_evidence(len(pairs), reference.buildings_m[seen], len(moved_m), reference, config)
    return Score(transform, moved_m, pairs, rms, jaccard, total)
