"""Made-up and real towns, their databases in one piece and in tiles, and maps of them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from buildloc_eval.observation import ObservedMap, observe_map, sensing
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.descriptors import describe
from buildloc_matcher.evidence import Ground, QueryMap, ground, query_map
from buildloc_matcher.matching import QueryStars, query_stars
from buildloc_matcher.reference.buildings import Buildings
from buildloc_matcher.reference.database import ReferenceDatabase, assemble, descriptor_hash
from buildloc_matcher.reference.ingest import read_buildings
from buildloc_matcher.reference.region import Box
from buildloc_matcher.reference.tile import MARGIN_M, Tile, make_tile
from buildloc_msgs_py.types import FloatArray, LocalMap
from scipy.spatial import cKDTree

UTM = 32619
ORIGIN_M = (320_000.0, 4_700_000.0)
DEFAULT = MatcherConfig()
LEXINGTON_DEG = (42.447, -71.225)
M_PER_DEG = 111_320.0


def buildings_at(points_m: FloatArray, seed: int, areas_m2: tuple[float, float] = (25.0, 400.0)) -> Buildings:
    """Buildings with these centroids (N, 2), areas log-uniform in a range and any shape."""
    rng = np.random.default_rng(seed)
    areas = np.exp(rng.uniform(*np.log(areas_m2), len(points_m)))
    shapes = rng.uniform(0.3, 1.0, (len(points_m), 4))
    return Buildings(points_m, areas.astype(np.float32), shapes.astype(np.float32))


def alike(points_m: FloatArray) -> Ground:
    """A reference of buildings at (N, 2) that all have the same area."""
    return ground(points_m, np.full(len(points_m), 150.0))


def mapped(points_m: FloatArray) -> QueryMap:
    """A map of buildings at (N, 2) that all have the same area."""
    return query_map(points_m, np.full(len(points_m), 150.0), DEFAULT)


def town(
    seed: int, count: int, side_m: float, areas_m2: tuple[float, float] = (25.0, 400.0),
    origin_m: tuple[float, float] = ORIGIN_M,
) -> Buildings:  # fmt: skip
    """Buildings anywhere in a square."""
    points = np.random.default_rng(seed).uniform(0.0, side_m, (count, 2))
    return buildings_at(points + origin_m, seed, areas_m2)


def lattice(columns: int, rows: int, spacing_m: float = 40.0) -> Buildings:
    """The same house on every crossing of a regular grid: all that can tie does."""
    x, y = np.meshgrid(np.arange(columns) * spacing_m, np.arange(rows) * spacing_m, indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel()]) + ORIGIN_M
    ones = np.ones(len(points), dtype=np.float32)
    return Buildings(points, 100.0 * ones, np.tile(np.float32([0.7, 0.6, 0.9, 1.0]), (len(points), 1)))


@cache
def lexington(half_m: float) -> Buildings:
    """The real buildings of a square around Lexington; skips where there is no data."""
    folder = Path(os.environ.get("BUILDLOC_DATA", Path(__file__).parents[3] / "shared" / "data"))
    path = folder / "footprints" / "boston_osm.parquet"
    if not path.is_file():
        pytest.skip(f"{path} is absent; set BUILDLOC_DATA")
    latitude, longitude = LEXINGTON_DEG
    high, wide = half_m / M_PER_DEG, half_m / M_PER_DEG / np.cos(np.radians(latitude))
    box = Box(longitude - wide, latitude - high, longitude + wide, latitude + high)
    return read_buildings([path], DEFAULT.min_area_m2, box).buildings


def local_map(buildings: Buildings, stamp_ns: int = 0) -> LocalMap:
    """A map without any error, in the frame of the reference."""
    ids = np.arange(len(buildings), dtype=np.int64)
    areas, shapes = buildings.areas_m2.astype(np.float64), buildings.shapes.astype(np.float64)
    return LocalMap.whole(stamp_ns, ids, buildings.centroids_m, areas, shapes, np.ones_like(ids))


def observed(buildings: Buildings, count: int, level: float, seed: int) -> ObservedMap:
    """A map of ``count`` of the buildings as a flight would make it."""
    tree, rng = cKDTree(buildings.centroids_m), np.random.default_rng(seed)
    return observe_map(buildings, tree, count, sensing(level), rng)


def first_rows(whole: LocalMap, count: int) -> LocalMap:
    """The map when only its first buildings had been seen."""
    return whole.select(np.arange(count))


def stars_of(buildings: Buildings | LocalMap) -> QueryStars:
    """The stars of all buildings, as a map's."""
    areas = buildings.areas_m2
    return query_stars(describe(buildings.centroids_m, areas, buildings.shapes), areas)


def reference_stars(database: ReferenceDatabase) -> QueryStars:
    """The stars of all tiles, numbered through, as the oracle takes them."""
    parts = [query_stars(tile.triangles, tile.buildings.areas_m2) for tile in database.tiles]
    return QueryStars(
        np.concatenate([part.features for part in parts]), np.concatenate([part.areas_m2 for part in parts])
    )


def cut(buildings: Buildings, size_m: float, config: MatcherConfig = DEFAULT) -> dict[str, Tile]:
    """Tiles of squares, each made from the buildings within the margin alone."""
    low, high = (np.floor(end / size_m).astype(int) for end in extent(buildings))
    tiles = {}
    for i in range(low[0], high[0] + 1):
        for j in range(low[1], high[1] + 1):
            corner = np.array([i, j]) * size_m
            grown = buildings.centroids_m - (corner - MARGIN_M)
            near = ((grown >= 0.0) & (grown < size_m + 2.0 * MARGIN_M)).all(axis=1)
            box_m = (i * size_m, j * size_m, (i + 1) * size_m, (j + 1) * size_m)
            tile = make_tile(buildings.select(near), box_m, config)
            if tile.owned or tile.triangles.stars:
                tiles[f"{i}_{j}"] = tile
    return tiles


def extent(buildings: Buildings) -> tuple[FloatArray, FloatArray]:
    """South-western and north-eastern corner (2,) of the centroids."""
    return buildings.centroids_m.min(axis=0), buildings.centroids_m.max(axis=0)


def tiled(buildings: Buildings, size_m: float, config: MatcherConfig = DEFAULT) -> ReferenceDatabase:
    """A database in squares."""
    return ReferenceDatabase(UTM, tuple(cut(buildings, size_m, config).values()), descriptor_hash(config))


def whole(buildings: Buildings, config: MatcherConfig = DEFAULT) -> ReferenceDatabase:
    """A database in one piece."""
    return assemble(UTM, buildings, config)


Town = Callable[[], Buildings]


def strip(buildings: Buildings, length_m: float, half_width_m: float) -> Buildings:
    """The buildings along a straight line eastwards through the middle, sorted from its western end."""
    low, high = extent(buildings)
    along, across = (buildings.centroids_m - (low + high) / 2.0).T
    inside = (np.abs(along) < length_m / 2.0) & (np.abs(across) < half_width_m)
    rows = np.flatnonzero(inside)
    return buildings.select(rows[np.argsort(along[rows])])


def bent(points_m: FloatArray, bend_deg: float, jitter_m: float = 0.0, seed: int = 1) -> FloatArray:
    """Points (N, 2) along an eastward line as a map has them whose heading drifts evenly by so much from its
    western to its eastern end: the line has become an arc."""
    along, across = (points_m - points_m.mean(axis=0)).T
    radius = np.ptp(along) / math.radians(bend_deg)
    turn = along / radius
    arc = np.column_stack([(radius - across) * np.sin(turn), radius - (radius - across) * np.cos(turn)])
    return arc + np.random.default_rng(seed).normal(0.0, jitter_m, arc.shape)
