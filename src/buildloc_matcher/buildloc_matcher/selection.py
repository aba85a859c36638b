"""Candidates scored: where each puts the map's buildings, MNN-Jaccard (Eq. 4), evidence against chance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import Ground, QueryMap, placed_evidence
from buildloc_matcher.geometry import Similarity, fit_similarity
from buildloc_matcher.growth import Grown, grow
from buildloc_matcher.hypotheses import Hypotheses
from buildloc_matcher.point_grid import within
from buildloc_matcher.voting import Ballot, Cluster


GROWN_SCORED = 10  # distinct grown matches that get the full score
LOCAL_M = 100.0
FAR_WEIGHT = 1e-3


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
    squared = np.sum((source - at_m) ** 2, axis=1)
    # Far pairs keep a little weight, so that a lonely end of the map is still turned by the rest.
    weights = np.exp(-0.5 * squared / LOCAL_M**2) + FAR_WEIGHT
    return fit_similarity(source, target, config.scale_gate, weights)


def mutual_pairs(query_m: FloatArray, reference_m: FloatArray, max_distance_m: float) -> NDArray[np.int64]:
    """(P, 2) indices (query, reference) of mutual nearest neighbours closer than the distance."""
    if len(query_m) == 0 or len(reference_m) == 0:
        return np.empty((0, 2), dtype=np.int64)
    distance, to_reference = cKDTree(reference_m).query(query_m)
    _, to_query = cKDTree(query_m).query(reference_m)
    queries = np.arange(len(query_m))
    mutual = (to_query[to_reference] == queries) & (distance < max_distance_m)
    return np.column_stack([queries[mutual], to_reference[mutual]]).astype(np.int64)


def observable(
    query_m: FloatArray, reference_m: FloatArray, margin_m: float, radius_m: float
) -> NDArray[np.int64]:
    """Indices of the reference buildings the map should have seen: inside the hull of the map
    buildings grown by the margin, and within the radius of one of them (a flight along an L does not
    see the inside of its hull)."""
    if len(query_m) == 0 or len(reference_m) == 0:
        return np.empty(0, dtype=np.int64)
    near = np.isfinite(cKDTree(query_m).query(reference_m, distance_upper_bound=radius_m)[0])
    hull = shapely.MultiPoint(query_m).convex_hull.buffer(margin_m)
    shapely.prepare(hull)
    inside = shapely.contains_xy(hull, reference_m[:, 0], reference_m[:, 1])
    return np.asarray(np.flatnonzero(near & inside), dtype=np.int64)


def mnn_jaccard(
    query_m: FloatArray, reference_m: FloatArray, config: MatcherConfig
) -> tuple[float, NDArray[np.int64]]:
    """J = |M| / (|Q| + |R| - |M|) and the pairs M; reference (N, 2) is cut to the observable region."""
    seen = observable(query_m, reference_m, config.observable_margin_m, config.observable_radius_m)
    pairs = mutual_pairs(query_m, reference_m[seen], config.mnn_distance_m)
    union = len(query_m) + len(seen) - len(pairs)
    if len(pairs):
        pairs = np.column_stack([pairs[:, 0], seen[pairs[:, 1]]])
    return (len(pairs) / union if union else 0.0), pairs


def select(
    ballot: Ballot, voters: Hypotheses, corners: NDArray[np.int64], query: QueryMap, reference: Ground,
    config: MatcherConfig,
) -> list[tuple[Cluster, Score]]:
    """Clusters with their scores, best first: by MNN-Jaccard, or by evidence where matches grow.

    ``corners`` (S, 3) are the map's buildings at the corners of its stars.
    """
    if config.selection == "rigid":
        rigid = [(c, score_rigid(_start(c, query), query, reference, config)) for c in ballot.clusters]
        return sorted(rigid, key=lambda pair: (-pair[1].jaccard, -pair[0].votes))
    best = [cluster.best for cluster in ballot.clusters]
    grown = grow(query, corners[voters.stars[best]], voters.places_m[best], reference, config)
    order = sorted(range(len(grown)), key=lambda c: -grown[c].evidence)
    scored: list[tuple[Cluster, Score]] = []
    places: list[FloatArray] = []
    for c in order:
        if grown[c].evidence <= 0.0 or len(scored) == GROWN_SCORED:
            break
        place = np.nanmean(grown[c].predicted_m, axis=0)
        if any(np.hypot(*(place - other)) < config.mnn_distance_m for other in places):
            continue  # grown from another seed into the same match
        places.append(place)
        start = _start(ballot.clusters[c], query)
        scored.append((ballot.clusters[c], score_grown(start, grown[c], query, reference, config)))
    return scored


def _start(cluster: Cluster, query: QueryMap) -> Similarity:
    """The cluster's mean transform."""
    centre = query.points_m.mean(axis=0)
    anchor, world = (float(centre[0]), float(centre[1])), (cluster.x_m, cluster.y_m)
    return Similarity(anchor, world, cluster.yaw_rad, cluster.scale)


def score_rigid(transform: Similarity, query: QueryMap, reference: Ground, config: MatcherConfig) -> Score:
    """A candidate as the paper scores it: one transform for the whole map."""
    moved = transform.apply(query.points_m)
    return _scored(transform, moved, placed_evidence(moved, reference, config), reference, config)


def score_grown(start: Similarity, grown: Grown, query: QueryMap, reference: Ground, config: MatcherConfig) -> Score:
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
    return _scored(transform, moved, grown.evidence, reference, config)


def _scored(
    transform: Similarity, moved_m: FloatArray, evidence: float, reference: Ground, config: MatcherConfig
) -> Score:
    margin = config.observable_margin_m + config.mnn_distance_m
    rows = within(reference.grid, *(moved_m.min(axis=0) - margin), *(moved_m.max(axis=0) + margin))
    local = reference.buildings_m[rows]
    jaccard, pairs = mnn_jaccard(moved_m, local, config)
    squared = np.sum((moved_m[pairs[:, 0]] - local[pairs[:, 1]]) ** 2, axis=1)
    rms = math.sqrt(squared.mean()) if len(pairs) else math.inf
    pairs = np.column_stack([pairs[:, 0], rows[pairs[:, 1]]])
    return Score(transform, moved_m, pairs, rms, jaccard, evidence)
