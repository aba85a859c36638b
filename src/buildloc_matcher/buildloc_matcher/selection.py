"""Mutual nearest neighbours and the MNN-Jaccard score (Eq. 4) of a candidate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.geometry import Similarity, fit_similarity


@dataclass(frozen=True)
class Score:
    """A candidate's transform, its MNN-Jaccard, its mutual pairs (count) and their RMS distance in m, the
    number of map buildings and the density of the reference around them."""

    transform: Similarity
    jaccard: float
    pairs: int
    rms_m: float
    queries: int
    density_per_m2: float


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


def nearby(
    tree: cKDTree, reference_m: FloatArray, transform: Similarity, query_m: FloatArray, margin_m: float
) -> tuple[FloatArray, float]:
    """Reference buildings (N, 2) within reach of the map under the transform, and how many per m2."""
    moved = transform.apply(query_m)
    centre = moved.mean(axis=0)
    reach = float(np.linalg.norm(moved - centre, axis=1).max()) + margin_m
    local = reference_m[np.sort(np.asarray(tree.query_ball_point(centre, reach), dtype=np.int64))]
    return local, len(local) / (math.pi * reach**2)


def score_candidate(
    start: Similarity, query_m: FloatArray, reference_m: FloatArray, tree: cKDTree, config: MatcherConfig
) -> Score:
    """Align the candidate on its mutual pairs with a shrinking distance, then score it.

    The aligned transform is kept only where it scores at least as well as the voted one.
    """
    margin = 4.0 * config.mnn_distance_m + config.observable_margin_m
    local, density = nearby(tree, reference_m, start, query_m, margin)

    def scored(transform: Similarity) -> Score:
        moved = transform.apply(query_m)
        jaccard, pairs = mnn_jaccard(moved, local, config)
        squared = np.sum((moved[pairs[:, 0]] - local[pairs[:, 1]]) ** 2, axis=1)
        rms = math.sqrt(squared.mean()) if len(pairs) else math.inf
        return Score(transform, jaccard, len(pairs), rms, len(query_m), density)

    best, transform = scored(start), start
    for distance in np.linspace(2.0, 1.0, config.polish_iterations) * config.mnn_distance_m:
        pairs = mutual_pairs(transform.apply(query_m), local, float(distance))
        if len(pairs) < 3:
            break
        transform = fit_similarity(query_m[pairs[:, 0]], local[pairs[:, 1]], config.scale_gate)
        step = scored(transform)
        if (step.jaccard, -step.rms_m) >= (best.jaccard, -best.rms_m):
            best = step
    return best
