"""Delaunay triangles and the stars they form: one encoder for reference and query.

A star is a triangle with its three neighbours (Sec. "Descriptor Extraction"). Its 32 numbers are four
times eight features of a triangle, so triangles are kept once, with the rows of their neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

DESCRIPTOR_VERSION = 2
TRIANGLE_FEATURES = 8
SMALL_ANGLE, MIDDLE_ANGLE, AREA, PERIMETER, SHAPE = 0, 1, 2, 3, 4  # columns of the features
NO_TRIANGLE = -1
# A triangle whose circumscribed circle is larger spans empty land that no map shows whole. The limit makes
# a star depend on its surroundings alone, so that a reference can be built tile by tile.
MAX_CIRCUMRADIUS_M = 300.0
TIE_BREAK_M = 1e-3


@dataclass(frozen=True)
class Triangles:
    """T Delaunay triangles, of which the first ``stars`` have three neighbours and so form a star.

    ``vertices`` (T, 3) rows of the buildings, in the order of the sorted angles; ``neighbours`` (T, 3) rows
    of the neighbouring triangles by distance of their centroids, NO_TRIANGLE where there is none;
    ``features`` (T, 8) float32: the two smaller interior angles in radians (the largest is pi minus both),
    the geometric mean of the vertices' areas in m2, the perimeter in metres, and the four shape metrics
    averaged over the vertices. All but the area are the paper's (Table "Star descriptor features").
    """

    vertices: NDArray[np.int32]
    neighbours: NDArray[np.int32]
    features: NDArray[np.float32]
    stars: int

    def __len__(self) -> int:
        return len(self.features)

    def star_features(self) -> NDArray[np.float32]:
        """(S, 4, 8) features of every star: the central triangle, then its neighbours, nearest first."""
        rows = np.concatenate(
            [np.arange(self.stars, dtype=np.int32)[:, None], self.neighbours[: self.stars]], axis=1
        )
        return np.asarray(self.features[rows], dtype=np.float32)


def no_triangles() -> Triangles:
    """What fewer than three buildings, or buildings on one line, make."""
    corners = np.empty((0, 3), dtype=np.int32)
    return Triangles(corners, corners, np.empty((0, TRIANGLE_FEATURES), dtype=np.float32), 0)


def describe(points_m: FloatArray, areas_m2: NDArray[np.floating], shapes: NDArray[np.floating]) -> Triangles:
    """Triangles of buildings with centroids (N, 2) metres, areas (N,) and shape metrics (N, 4).

    Buildings on one line, or fewer than three different ones, have none. The result does not depend on
    which other buildings lie further away than a few times MAX_CIRCUMRADIUS_M.
    """
    if len(points_m) < 3:
        return no_triangles()
    local = points_m - points_m.mean(axis=0)
    try:
        mesh = Delaunay(local + _tie_break(points_m))
    except QhullError:
        return no_triangles()
    small = _circumradius(local[mesh.simplices]) <= MAX_CIRCUMRADIUS_M
    renumbered = np.full(len(small) + 1, NO_TRIANGLE, dtype=np.int32)
    renumbered[:-1][small] = np.arange(small.sum(), dtype=np.int32)
    # Neighbour i lies opposite vertex i, so both take the same order.
    order = np.argsort(mesh.simplices[small], axis=1)
    vertices = np.take_along_axis(mesh.simplices[small], order, axis=1).astype(np.int32)
    neighbours = renumbered[np.take_along_axis(mesh.neighbors[small], order, axis=1)]
    features, vertices, neighbours = _measure(points_m, areas_m2, shapes, vertices, neighbours)
    neighbours = _nearest_first(points_m[vertices].mean(axis=1), neighbours)
    return _stars_first(Triangles(vertices, neighbours, features, 0))


def _tie_break(points_m: FloatArray) -> FloatArray:
    """(N, 2) shifts below a millimetre that depend on the point alone.

    Four buildings on one circle, as in a regular row, have two triangulations; which one Qhull takes
    depends on all the other points. The shift decides it the same way in every tile.
    """
    bits = np.ascontiguousarray(points_m, dtype=np.float64).view(np.uint64)
    mixed = bits * np.uint64(0x9E3779B97F4A7C15) ^ (
        bits[:, ::-1] * np.uint64(0xC2B2AE3D27D4EB4F) >> np.uint64(29)
    )
    mixed = (mixed ^ (mixed >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93)
    return np.asarray((mixed >> np.uint64(40)) / float(1 << 24) - 0.5, dtype=np.float64) * TIE_BREAK_M


def _circumradius(corners_m: FloatArray) -> FloatArray:
    """(T,) radius of the circumscribed circles of triangles (T, 3, 2); infinite for flat ones."""
    edges = np.linalg.norm(corners_m - np.roll(corners_m, 1, axis=1), axis=2)
    one, two = corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]
    doubled_area = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = edges.prod(axis=1) / (2.0 * doubled_area)
    return np.where(doubled_area > 0.0, radius, math.inf)


def _measure(
    points_m: FloatArray,
    areas_m2: NDArray[np.floating],
    shapes: NDArray[np.floating],
    vertices: NDArray[np.int32],
    neighbours: NDArray[np.int32],
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
    """Features (T, 8); vertices and the neighbours opposite to them in the order of the sorted angles."""
    corners = points_m[vertices]
    to_next = np.roll(corners, -1, axis=1) - corners
    to_previous = np.roll(corners, 1, axis=1) - corners
    cross = to_next[..., 0] * to_previous[..., 1] - to_next[..., 1] * to_previous[..., 0]
    dot = to_next[..., 0] * to_previous[..., 0] + to_next[..., 1] * to_previous[..., 1]
    angles = np.arctan2(np.abs(cross), dot)
    order = np.argsort(angles, axis=1, kind="stable")
    vertices = np.take_along_axis(vertices, order, axis=1)
    corners = points_m[vertices]
    edges = np.hypot(*(np.roll(corners, -1, axis=1) - corners).transpose(2, 0, 1))
    logs = np.log(np.maximum(np.asarray(areas_m2, dtype=np.float64), 1e-6))[vertices]
    averaged = np.asarray(shapes, dtype=np.float64)[vertices].sum(axis=1) / 3.0
    features = np.column_stack(
        [
            np.take_along_axis(angles, order[:, :2], axis=1),
            np.exp((logs[:, 0] + logs[:, 1] + logs[:, 2]) / 3.0),
            edges[:, 0] + edges[:, 1] + edges[:, 2],
            averaged,
        ]
    )
    return features.astype(np.float32), vertices, np.take_along_axis(neighbours, order, axis=1)


def _nearest_first(centres_m: FloatArray, neighbours: NDArray[np.int32]) -> NDArray[np.int32]:
    """Neighbours by the distance of their centroids from the triangle's own; missing ones last."""
    apart = centres_m[neighbours] - centres_m[:, None]
    distance = np.where(neighbours == NO_TRIANGLE, math.inf, np.hypot(apart[..., 0], apart[..., 1]))
    order = np.argsort(distance, axis=1, kind="stable")
    return np.take_along_axis(neighbours, order, axis=1)


def _stars_first(triangles: Triangles) -> Triangles:
    whole = (triangles.neighbours != NO_TRIANGLE).all(axis=1)
    return reorder(triangles, np.argsort(~whole, kind="stable"), int(whole.sum()))


def reorder(triangles: Triangles, order: NDArray[np.integer], stars: int) -> Triangles:
    """The triangles of these rows in this order; a neighbour that is left out becomes NO_TRIANGLE."""
    renumbered = np.full(len(triangles) + 1, NO_TRIANGLE, dtype=np.int32)
    renumbered[order] = np.arange(len(order), dtype=np.int32)
    neighbours = renumbered[triangles.neighbours[order]]
    return Triangles(triangles.vertices[order], neighbours, triangles.features[order], stars)
