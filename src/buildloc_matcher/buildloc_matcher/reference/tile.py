"""One tile of a reference: the stars whose centre lies in it, with all that they refer to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.descriptors import MAX_CIRCUMRADIUS_M, Triangles, describe, reorder
from buildloc_matcher.reference.buildings import Buildings
from buildloc_matcher.star_index import index_triangles

Box = tuple[float, float, float, float]

# The circle of a triangle reaches at most two radii from its centroid, and those of its neighbours, which
# share an edge with it, at most two more. Within that distance a star is what it is in one piece.
MARGIN_M = 4.0 * MAX_CIRCUMRADIUS_M


@dataclass(frozen=True)
class Tile:
    """``buildings``: the first ``owned`` lie in ``box_m`` (west, south, east, north), the rest are vertices
    beyond its border. ``triangles``: those of the stars whose centroid lies in the box, in the order of
    the index with ``sketches`` (22, S), then the neighbours that are no stars of this tile."""

    box_m: Box
    buildings: Buildings
    owned: int
    triangles: Triangles
    sketches: NDArray[np.uint8]


def within(points_m: NDArray[np.float64], box_m: Box) -> NDArray[np.bool_]:
    """Which points (N, 2) a box owns: its western and southern border, not the others."""
    west, south, east, north = box_m
    x, y = points_m.T
    return np.asarray((x >= west) & (x < east) & (y >= south) & (y < north))


def make_tile(buildings: Buildings, box_m: Box, config: MatcherConfig) -> Tile:
    """The tile of a box from all buildings of the box grown by MARGIN_M, in any order.

    Buildings smaller than ``config.min_area_m2`` are left out.
    """
    large = buildings.select(buildings.areas_m2 >= np.float32(config.min_area_m2))
    x, y = large.centroids_m.T
    large = large.select(np.lexsort((y, x)))  # the same order, hence the same stars, in every tile
    triangles = describe(large.centroids_m, large.areas_m2, large.shapes)
    centres = large.centroids_m[triangles.vertices[: triangles.stars]].mean(axis=1)
    stars = np.flatnonzero(within(centres, box_m))
    others = np.setdiff1d(triangles.neighbours[stars], stars)
    triangles = reorder(triangles, np.concatenate([stars, others]), len(stars))
    owned = within(large.centroids_m, box_m)
    used = np.zeros(len(large), dtype=bool)
    used[triangles.vertices] = True
    rows = np.concatenate([np.flatnonzero(owned), np.flatnonzero(used & ~owned)])
    renumbered = np.full(len(large), -1, dtype=np.int32)
    renumbered[rows] = np.arange(len(rows), dtype=np.int32)
    kept = Triangles(
        renumbered[triangles.vertices], triangles.neighbours, triangles.features, triangles.stars
    )
    stored = large.select(rows)
    indexed, sketches = index_triangles(kept, stored.areas_m2)
    return Tile(box_m, stored, int(owned.sum()), indexed, sketches)
