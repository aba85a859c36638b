"""The stars of a map: those of its triangulation, and on a second look those of thinned ones."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray

from buildloc_matcher.descriptors import describe
from buildloc_matcher.matching import QueryStars, query_stars

KEPT_SHARE = 0.75


@dataclass(frozen=True)
class Mesh:
    """Stars (S) of a map and the buildings (S, 3) at the corners of their central triangles."""

    corners: NDArray[np.int64]
    stars: QueryStars


def mesh(
    points_m: FloatArray, areas_m2: FloatArray, shapes: FloatArray, thinnings: int = 0, max_stars: int = 0
) -> Mesh:
    """Stars of buildings with centroids (N, 2) metres, areas (N,) and shape metrics (N, 4); ``max_stars`` of
    them at most (0: all), a sample that depends on the stars alone, so that it lasts while the map grows.

    A building that the reference does not have breaks every triangle around it. So each thinning leaves a
    random quarter out (the same one every time) and adds the stars whose triangle is new.
    """
    kept = [np.arange(len(points_m))]
    kept += [
        np.flatnonzero(np.random.default_rng(seed).random(len(points_m)) < KEPT_SHARE)
        for seed in range(thinnings)
    ]
    corners, parts = [], []
    for rows in kept:
        triangles = describe(points_m[rows], areas_m2[rows], shapes[rows])
        corners.append(rows[triangles.vertices[: triangles.stars]].reshape(-1, 3))
        parts.append(query_stars(triangles, areas_m2[rows]))
    everything = np.concatenate(corners)
    _, first = np.unique(np.sort(everything, axis=1), axis=0, return_index=True)
    new = np.sort(first)
    features = np.concatenate([part.features for part in parts])
    if 0 < max_stars < len(new):
        lots = [zlib.crc32(features[row].tobytes()) for row in new]
        new = np.sort(new[np.argsort(lots, kind="stable")[:max_stars]])
    areas = np.concatenate([part.areas_m2 for part in parts])
    return Mesh(everything[new], QueryStars(features[new], areas[new]))
