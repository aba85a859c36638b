"""Delaunay triangulation and star descriptors: one encoder for reference and query."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

DESCRIPTOR_VERSION = 1
TRIANGLE_FEATURES = 8
STAR_FEATURES = 4 * TRIANGLE_FEATURES


@dataclass(frozen=True)
class Stars:
    """S star descriptors.

    ``features`` (S, 32): central triangle, then its three neighbours by distance of their centroids
    from the central one; per triangle the sorted interior angles in radians (3), the perimeter in
    metres, and the four shape metrics averaged over the vertices. ``triangles`` (S, 3): vertices of
    the central triangle in the order of its sorted angles.
    """

    features: FloatArray
    triangles: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.features)


def no_stars() -> Stars:
    """Zero stars: what fewer than four buildings, or buildings on one line, make."""
    return Stars(np.empty((0, STAR_FEATURES)), np.empty((0, 3), dtype=np.int64))


def triangle_features(
    points_m: FloatArray, shapes: FloatArray, triangles: NDArray[np.int64]
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Features (T, 8) of triangles (T, 3), and their vertices in the order of the sorted angles."""
    corners = points_m[triangles]
    opposite = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1), axis=2)
    to_next = np.roll(corners, -1, axis=1) - corners
    to_previous = np.roll(corners, 1, axis=1) - corners
    cross = to_next[..., 0] * to_previous[..., 1] - to_next[..., 1] * to_previous[..., 0]
    angles = np.arctan2(np.abs(cross), np.sum(to_next * to_previous, axis=2))
    order = np.argsort(angles, axis=1, kind="stable")
    features = np.concatenate(
        [
            np.take_along_axis(angles, order, axis=1),
            opposite.sum(axis=1, keepdims=True),
            shapes[triangles].mean(axis=1),
        ],
        axis=1,
    )
    return features, np.take_along_axis(triangles, order, axis=1)


def stars(centroids_m: FloatArray, shapes: FloatArray) -> Stars:
    """Star descriptors of buildings with centroids (N, 2) metres and shape metrics (N, 4)."""
    if len(centroids_m) < 4:
        return no_stars()
    points = centroids_m - centroids_m.mean(axis=0)
    try:
        mesh = Delaunay(points)
    except QhullError:
        return no_stars()
    triangles = mesh.simplices.astype(np.int64)
    features, ordered = triangle_features(points, shapes, triangles)
    centres = points[triangles].mean(axis=1)
    inner = np.flatnonzero((mesh.neighbors >= 0).all(axis=1))
    neighbours = mesh.neighbors[inner]
    distance = np.linalg.norm(centres[neighbours] - centres[inner][:, None], axis=2)
    neighbours = np.take_along_axis(neighbours, np.argsort(distance, axis=1, kind="stable"), axis=1)
    described = np.concatenate([features[inner][:, None], features[neighbours]], axis=1)
    return Stars(described.reshape(-1, STAR_FEATURES), ordered[inner])
