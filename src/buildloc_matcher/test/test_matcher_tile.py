"""A reference made tile by tile is the same as one made in one piece."""

from __future__ import annotations

from collections import Counter
from contextlib import nullcontext
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
from buildloc_matcher.matching import NOTHING, match_stars
from buildloc_matcher.reference import build as build_module
from buildloc_matcher.reference.build import build
from buildloc_matcher.reference.buildings import Buildings, concatenate
from buildloc_matcher.reference.database import ReferenceDatabase, open_database
from buildloc_matcher.reference.tile import MARGIN_M, Tile, make_tile
from shapely import box
from towns import (
    DEFAULT,
    ORIGIN_M,
    UTM,
    Town,
    buildings_at,
    cut,
    lattice,
    lexington,
    local_map,
    observed,
    reference_stars,
    stars_of,
    tiled,
    town,
    whole,
)


def crowded() -> Buildings:
    return town(11, 4000, 3000.0)


def sparse() -> Buildings:
    """Farms 200 m apart on average: many triangles are near the largest that are kept."""
    return town(12, 500, 4500.0)


def gappy() -> Buildings:
    """Two villages further apart than any triangle spans, and a lone house."""
    far = (ORIGIN_M[0] + 2600.0, ORIGIN_M[1] + 300.0)
    lone = buildings_at(np.add([ORIGIN_M], (1500.0, -1500.0)), 1)
    return concatenate([town(13, 300, 700.0), town(14, 300, 700.0, origin_m=far), lone])


def regular() -> Buildings:
    return lattice(50, 50)


TOWNS: dict[str, Town] = {"crowded": crowded, "sparse": sparse, "gappy": gappy, "regular": regular}


def stars(database: ReferenceDatabase) -> Counter[bytes]:
    """All stars: the coordinates of the corners, 32 features, areas of the corners; bit for bit."""
    found = reference_stars(database)
    corners = database.star_corners(np.arange(database.stars))
    table = np.concatenate(
        [part.reshape(len(found), -1).view(np.uint8) for part in (corners, found.features, found.areas_m2)],
        axis=1,
    )
    return Counter(row.tobytes() for row in table)


def rows(buildings: Buildings) -> list[tuple[float, ...]]:
    table = np.column_stack([buildings.centroids_m, buildings.areas_m2, buildings.shapes])
    return sorted(map(tuple, table.tolist()))


@pytest.mark.parametrize("size_m", [700.0, 1500.0, 20_000.0])
@pytest.mark.parametrize("make", TOWNS.values(), ids=TOWNS.keys())
def test_tiles_hold_the_stars_of_one_piece(make: Town, size_m: float) -> None:
    buildings = make()
    one, many = whole(buildings), tiled(buildings, size_m)
    assert stars(one) == stars(many) and max(stars(one).values()) == 1
    assert rows(many.buildings) == rows(one.buildings) == rows(buildings)


def test_a_border_through_buildings_and_a_tile_that_owns_none() -> None:
    # Tiles of 40 m: borders run along the rows of the lattice, and most hold one building, some none.
    block = lattice(6, 6)
    assert stars(tiled(block, 40.0)) == stars(whole(block))
    pond = np.hypot(*(block.centroids_m - block.centroids_m.mean(axis=0)).T) > 70.0
    around = tiled(block.select(pond), 40.0)
    assert stars(around) == stars(whole(block.select(pond)))
    assert any(tile.owned == 0 and tile.triangles.stars for tile in around.tiles)


@pytest.mark.data
@pytest.mark.parametrize("size_m", [900.0, 2500.0])
def test_lexington_in_tiles(size_m: float) -> None:
    city = lexington(3000.0)
    one, many = whole(city), tiled(city, size_m)
    assert stars(one) == stars(many) and len(stars(one)) > 20_000
    assert rows(many.buildings) == rows(one.buildings)


def test_the_order_of_the_buildings_does_not_matter() -> None:
    block, order = regular(), np.random.default_rng(1).permutation(2500)
    one, other = (cut(b, 900.0) for b in (block, block.select(order)))
    assert one.keys() == other.keys()
    for name, tile in one.items():
        np.testing.assert_array_equal(tile.sketches, other[name].sketches)
        np.testing.assert_array_equal(tile.triangles.vertices, other[name].triangles.vertices)
        np.testing.assert_array_equal(tile.triangles.neighbours, other[name].triangles.neighbours)
        np.testing.assert_array_equal(tile.triangles.features, other[name].triangles.features)


def test_buildings_beyond_the_margin_do_not_matter() -> None:
    city = crowded()
    square = (ORIGIN_M[0] + 1400.0, ORIGIN_M[1] + 1400.0, ORIGIN_M[0] + 1600.0, ORIGIN_M[1] + 1600.0)
    west, south, east, north = np.add(square, (-MARGIN_M, -MARGIN_M, MARGIN_M, MARGIN_M))
    x, y = city.centroids_m.T
    near = city.select((x >= west) & (x < east) & (y >= south) & (y < north))
    assert 0 < len(near) < len(city)

    def alone(tile: Tile) -> ReferenceDatabase:
        return ReferenceDatabase(UTM, (tile,), "")

    one, other = (alone(make_tile(b, square, DEFAULT)) for b in (near, city))
    assert stars(one) == stars(other) and rows(one.buildings) == rows(other.buildings)


def test_small_buildings_are_left_out_everywhere() -> None:
    mixed = town(15, 800, 900.0, (5.0, 80.0))
    large = mixed.select(mixed.areas_m2 >= 20.0)
    assert 100 < len(large) < 700
    for database in (whole(mixed), tiled(mixed, 400.0)):
        assert rows(database.buildings) == rows(large) and stars(database) == stars(whole(large))


def places(database: ReferenceDatabase, query: Buildings) -> list[list[tuple[float, ...]]]:
    """Per query star the score and the corners of every match, sorted."""
    found = match_stars(stars_of(query), database.tables, DEFAULT)
    result = []
    for numbers, scores in zip(found.reference, found.score, strict=True):
        kept = numbers != NOTHING
        corners = database.star_corners(numbers[kept]).reshape(-1, 6)
        result.append(sorted(map(tuple, np.column_stack([scores[kept], corners]).tolist())))
    return result


@pytest.mark.parametrize("size_m", [700.0, 1500.0])
def test_matches_in_tiles_are_those_in_one_piece(size_m: float) -> None:
    city, query = crowded(), town(16, 80, 400.0)
    one = places(whole(city), query)
    assert sum(map(len, one)) > 5000 and places(tiled(city, size_m), query) == one


def test_a_built_database_in_tiles_is_that_in_one_piece(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build_module, "_processes", lambda _: nullcontext())
    corners = sparse().centroids_m
    outlines = box(*(corners - 5.0).T, *np.add(corners, (5.0, 9.0)).T)
    gpd.GeoDataFrame(geometry=outlines, crs=UTM).to_parquet(tmp_path / "town.parquet")
    databases = []
    for name, tile_km in (("one", 20.0), ("many", 0.8)):
        build([tmp_path / "town.parquet"], tmp_path / name, DEFAULT, tile_km=tile_km)
        databases.append(open_database(tmp_path / name, DEFAULT))
    one, many = databases
    assert len(one.tiles) == 1 and len(many.tiles) > 20
    assert stars(one) == stars(many) and rows(one.buildings) == rows(many.buildings)
    # Built from a file or from measured buildings in memory, it is the same.
    assert stars(one) == stars(whole(one.buildings)) and len(stars(one)) > 500


@pytest.mark.data
def test_a_flight_matches_alike_in_tiles_and_in_one_piece() -> None:
    city = lexington(3000.0)
    seen = observed(city, 40, 1, 3).local_map
    query = Buildings(seen.centroids_m, seen.areas_m2.astype(np.float32), seen.shapes.astype(np.float32))
    assert len(local_map(query)) == 40 and places(tiled(city, 1700.0), query) == places(whole(city), query)
