"""The database folder: what it holds, every way to damage it, and builds that fail beside readers."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pyarrow as pa
import pytest
import shapely
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.reference import database as module
from buildloc_matcher.reference.buildings import OUTLINE_UNIT_M, Buildings, SourceRecord, stored_outlines
from buildloc_matcher.reference.database import (
    MANIFEST,
    DatabaseError,
    DatabaseMissingError,
    DatabaseWriter,
    ReferenceDatabase,
    describe_database,
    open_database,
)
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import SHAPE_METRICS
from towns import DEFAULT, ORIGIN_M, UTM, buildings_at, cut, local_map, tiled, town, whole

CITY = town(21, 900, 1500.0)
OTHER = town(22, 500, 1200.0)
SOURCES = [
    SourceRecord("city.parquet", "ODbL 1.0", "ab" * 32, 1000),
    SourceRecord("more.shp", "CC BY", "", 5),
]


def write(path: Path, buildings: Buildings = CITY, size_m: float = 800.0) -> Path:
    with DatabaseWriter(path, UTM, DEFAULT) as writer:
        for name, tile in cut(buildings, size_m).items():
            writer.add(name, tile)
        writer.commit(SOURCES, {"read": 1005, "used": len(buildings)})
    return path


@pytest.fixture
def city(tmp_path: Path) -> Path:
    """A database of several tiles."""
    return write(tmp_path / "city.bldb")


def same(one: ReferenceDatabase, other: ReferenceDatabase) -> bool:
    """Whether two databases are equal, bit for bit."""
    if (one.epsg, one.descriptor_hash, len(one.tiles)) != (
        other.epsg,
        other.descriptor_hash,
        len(other.tiles),
    ):
        return False

    def arrays(database: ReferenceDatabase) -> list[Any]:
        return [
            array
            for t in database.tiles
            for array in (
                t.box_m, t.owned, t.buildings.centroids_m, t.buildings.areas_m2, t.buildings.shapes,
                t.buildings.outlines,
                t.triangles.vertices, t.triangles.neighbours, t.triangles.features, t.triangles.stars,
                t.sketches,
            )
        ]  # fmt: skip

    return all(np.array_equal(a, b) for a, b in zip(arrays(one), arrays(other), strict=True))


def refused(path: Path, config: object = DEFAULT) -> str:
    """The one line with which a database is refused: what is wrong with which file, and the remedy."""
    with pytest.raises(DatabaseError) as error:
        open_database(path, config)  # type: ignore[arg-type]
    text = str(error.value)
    assert isinstance(error.value, BuildlocError) and "\n" not in text
    assert text.startswith(str(path)) and "build it again with `buildloc refdb build`" in text
    return text


def in_order_of(opened: ReferenceDatabase, made: ReferenceDatabase) -> ReferenceDatabase:
    """A database in memory with its tiles in the order of the one on disk."""
    order = [tile.box_m for tile in opened.tiles]
    return replace(made, tiles=tuple(sorted(made.tiles, key=lambda tile: order.index(tile.box_m))))


def test_a_database_survives_the_file(city: Path) -> None:
    read = open_database(city, DEFAULT)
    made = in_order_of(read, tiled(CITY, 800.0))
    assert len(made.tiles) > 3 and same(read, made)
    assert len(read) == len(CITY) and read.bounds_m == made.bounds_m and read.area_m2 == made.area_m2
    assert read.to_wgs84(*ORIGIN_M) == pytest.approx((42.431, -71.187), abs=0.002)
    seen = local_map(CITY.select(np.hypot(*(CITY.centroids_m - CITY.centroids_m[0]).T) < 250.0))
    found, expected = (Matcher(database, DEFAULT).locate(seen) for database in (read, made))
    assert found.candidates == expected.candidates and found.candidates
    assert found.candidates[0].x_m == pytest.approx(seen.centroids_m[:, 0].mean(), abs=0.01)


def test_one_house_two_houses_and_houses_in_a_row(tmp_path: Path) -> None:
    row = buildings_at(np.column_stack([np.arange(5.0) * 30.0, np.zeros(5)]) + ORIGIN_M, 1)
    for count in (1, 2, 5):
        path = write(tmp_path / f"{count}.bldb", row.select(np.arange(count)))
        read = open_database(path, DEFAULT)
        assert (len(read), read.stars) == (count, 0)
        assert Matcher(read, DEFAULT).locate(local_map(CITY)).candidates == ()
        assert dict(describe_database(path, DEFAULT))["stars"] == "0"


def test_outlines_come_back_and_may_be_absent(tmp_path: Path) -> None:
    places = ORIGIN_M + np.column_stack([np.arange(6.0) * 40.0, np.arange(6.0) ** 2 * 10.0])
    boxes = np.array([shapely.box(x, y, x + 12.0, y + 9.0) for x, y in places], dtype=object)
    middles = shapely.get_coordinates(shapely.centroid(boxes))
    outlined = replace(buildings_at(middles, 1), outlines=stored_outlines(boxes, middles))
    read = open_database(write(tmp_path / "a.bldb", outlined), DEFAULT)
    assert read.ground.outlines is not None
    corners = read.centroids_m[:, None] + OUTLINE_UNIT_M * read.ground.outlines[:, :4]
    # Units of 0.1 m: half of one off at most.
    assert np.abs(corners.min(axis=1) - (read.centroids_m - (6.0, 4.5))).max() <= 0.051
    assert np.abs(corners.max(axis=1) - (read.centroids_m - (-6.0, -4.5))).max() <= 0.051
    bare = open_database(write(tmp_path / "b.bldb", buildings_at(middles, 1)), DEFAULT)
    assert bare.ground.outlines is None


def test_outlines_are_simplified_until_they_fit() -> None:
    polygons = np.array([shapely.Point(1e5, 2e5).buffer(30.0, 64), shapely.box(0, 0, 9000, 9)], dtype=object)
    disc, too_wide = stored_outlines(polygons, shapely.get_coordinates(shapely.centroid(polygons)))
    x, y = OUTLINE_UNIT_M * disc.T.astype(float)
    # A polygon of eight corners has 90 % of its circle's area.
    area = 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    assert 0.89 * math.pi * 30.0**2 < area < math.pi * 30.0**2  # counter-clockwise
    assert not too_wide.any()
    assert stored_outlines(np.empty(0, dtype=object), np.empty((0, 2))).shape == (0, 12, 2)


def test_the_features_are_mapped_and_not_read(city: Path) -> None:
    before = pa.total_allocated_bytes()
    opened = open_database(city, DEFAULT)
    assert pa.total_allocated_bytes() == before
    for tile in opened.tiles:
        for array in (tile.triangles.features, tile.triangles.vertices, tile.triangles.neighbours):
            assert len(array) and not array.flags.owndata and not array.flags.writeable
    maps = Path("/proc/self/maps")
    if maps.exists():
        assert maps.read_text().count(str(city)) >= len(opened.tiles)


def test_geopandas_reads_the_buildings(city: Path) -> None:
    frames = [gpd.read_feather(path) for path in city.glob("*.buildings.arrow")]
    assert len(frames) > 3 and all(frame.crs.to_epsg() == UTM for frame in frames)
    found = []
    for frame in frames:
        owned = frame[~frame["beyond_tile"]]
        found += np.column_stack(
            [owned.geometry.x, owned.geometry.y, owned["area_m2"], owned[list(SHAPE_METRICS)]]
        ).tolist()
    expected = np.column_stack([CITY.centroids_m, CITY.areas_m2, CITY.shapes])
    assert sorted(map(tuple, found)) == sorted(map(tuple, expected.tolist()))
    assert any(frame["beyond_tile"].any() for frame in frames)


def test_pyarrow_reads_the_triangles(city: Path) -> None:
    opened = open_database(city, DEFAULT)
    for tile, entry in zip(opened.tiles, json.loads((city / MANIFEST).read_text())["tiles"], strict=True):
        with pa.OSFile(str(city / entry["files"]["triangles"]["name"])) as file:
            table = pa.ipc.open_file(file).read_all()
        assert table.num_rows == len(tile.triangles)
        corners = np.array(table.column("vertices").to_pylist())
        np.testing.assert_array_equal(corners, tile.triangles.vertices)
        features = np.array(table.column("features").to_pylist(), dtype=np.float32)
        np.testing.assert_array_equal(features, tile.triangles.features)
        assert table.column("sketch_00").type == pa.uint8()


def test_only_the_tiles_that_a_box_touches_are_opened(city: Path) -> None:
    everything = open_database(city, DEFAULT)
    first = everything.tiles[0]
    west, south, east, north = first.box_m
    inside = (west + 1.0, south + 1.0, east - 1.0, north - 1.0)
    one = open_database(city, DEFAULT, inside)
    assert [tile.box_m for tile in one.tiles] == [first.box_m]
    both = open_database(city, DEFAULT, (west + 1.0, north - 1.0, west + 2.0, north + 1.0))
    assert [tile.box_m[:2] for tile in both.tiles] == [(west, south), (west, north)]
    with pytest.raises(DatabaseError, match="has no building in the region asked for"):
        open_database(city, DEFAULT, (west - 9e5, south, west - 8e5, north))
    entries = json.loads((city / MANIFEST).read_text())["tiles"]
    for entry in entries[1:]:  # what is not asked for is not touched
        for file in entry["files"].values():
            (city / file["name"]).unlink()
    assert same(open_database(city, DEFAULT, inside), one)
    assert "is missing" in refused(city)


def test_a_tile_of_stars_without_buildings_is_no_region(tmp_path: Path) -> None:
    far = np.abs(OTHER.centroids_m - (320_600.0, 4_700_600.0)).max(axis=1) > 210.0
    path = write(tmp_path / "pond.bldb", OTHER.select(far), 200.0)
    empty = [tile.box_m for tile in open_database(path, DEFAULT).tiles if not tile.owned]
    assert empty
    with pytest.raises(DatabaseError, match="has no building in the region") as error:
        open_database(path, DEFAULT, np.add(empty[0], (1.0, 1.0, -1.0, -1.0)))
    assert "\n" not in str(error.value)


# Damage


@pytest.mark.parametrize("kind", ["buildings", "triangles"])
def test_a_table_that_is_cut_off_changed_or_gone(city: Path, kind: str) -> None:
    table = sorted(city.glob(f"*.{kind}.arrow"))[-1]
    data = table.read_bytes()
    for kept in (0, 1, 7, len(data) // 2, len(data) - 1):
        table.write_bytes(data[:kept])
        assert table.name in refused(city) and "truncated or damaged" in refused(city)
    table.write_bytes(data + b"\0")
    assert "truncated or damaged" in refused(city)
    for at in np.random.default_rng(1).integers(0, len(data), 20):
        flipped = bytearray(data)
        flipped[at] ^= 1 << int(at) % 8
        table.write_bytes(flipped)
        assert table.name in refused(city) and "truncated or damaged" in refused(city)
    table.unlink()
    assert f"{table.name} is missing" in refused(city)
    table.write_bytes(data)
    assert len(open_database(city, DEFAULT)) == len(CITY)


def test_what_is_no_database(tmp_path: Path, city: Path) -> None:
    with pytest.raises(DatabaseMissingError):
        open_database(tmp_path / "absent", DEFAULT)
    assert "no such reference database" in refused(tmp_path / "absent")
    file, folder, empty = (tmp_path / name for name in ("file", "folder", "empty"))
    file.write_bytes((city / MANIFEST).read_bytes())
    empty.mkdir()
    folder.mkdir()
    (folder / "holiday.jpg").write_text("a photograph")
    for path in (file, folder, empty, next(city.glob("*.arrow"))):
        assert "is not a buildloc reference database" in refused(path)


Damage = Callable[[dict[str, Any]], object]
MANIFESTS: dict[str, tuple[Damage, str]] = {
    "list": (lambda m: [m], "is damaged or of another program"),
    "no object": (lambda m: "buildloc-reference", "is damaged or of another program"),
    "without version": (lambda m: m.pop("version") and m, "is damaged or of another program"),
    "other format": (lambda m: m | {"format": "mbtiles"}, "is not a buildloc reference database"),
    "older": (lambda m: m | {"version": 1}, "has version 1, not 3"),
    "newer": (lambda m: m | {"version": 4}, "has version 4, not 3"),
    "other descriptor": (lambda m: m | {"descriptor_hash": "0" * 16}, "another descriptor configuration"),
    "without descriptor": (lambda m: m.pop("descriptor_hash") and m, "another descriptor configuration"),
    "without tiles": (lambda m: m.pop("tiles") and m, "is damaged"),
    "null for tiles": (lambda m: m | {"tiles": None}, "is damaged"),
    "names for tiles": (lambda m: m | {"tiles": ["0_0"]}, "is damaged"),
    "no tile": (lambda m: m | {"tiles": []}, "has no building"),
    "CRS by name": (lambda m: m | {"crs": "WGS 84"}, "is damaged"),
    "more owned than there are": (lambda m: changed(m, owned=10**6), "is damaged"),
    "more stars than triangles": (lambda m: changed(m, stars=10**6), "is damaged"),
    "a word for a count": (lambda m: changed(m, owned="many"), "is damaged"),
    "half a box": (lambda m: changed(m, box_m=[1.0, 2.0]), "is damaged"),
    "tables exchanged": (lambda m: exchanged(m), "is damaged"),
    "other file": (lambda m: elsewhere(m), "is missing"),
}


def changed(manifest: dict[str, Any], **values: object) -> dict[str, Any]:
    manifest["tiles"][0].update(values)
    return manifest


def exchanged(manifest: dict[str, Any]) -> dict[str, Any]:
    files = manifest["tiles"][0]["files"]
    files["buildings"], files["triangles"] = files["triangles"], files["buildings"]
    return manifest


def elsewhere(manifest: dict[str, Any]) -> dict[str, Any]:
    manifest["tiles"][0]["files"]["buildings"]["name"] = "absent.arrow"
    return manifest


@pytest.mark.parametrize("kind", MANIFESTS)
def test_a_damaged_manifest(city: Path, kind: str) -> None:
    damage, text = MANIFESTS[kind]
    (city / MANIFEST).write_text(json.dumps(damage(json.loads((city / MANIFEST).read_text()))))
    if kind == "no tile":  # what is no region of this database is another matter than damage
        with pytest.raises(DatabaseError, match=text):
            open_database(city, DEFAULT)
    else:
        assert text in refused(city)


def test_a_manifest_that_is_cut_off_or_no_text(city: Path) -> None:
    data = (city / MANIFEST).read_bytes()
    for content in (b"", data[:1], data[: len(data) // 2], data[:-1], b"\xff\xfe\x00"):
        (city / MANIFEST).write_bytes(content)
        assert "is damaged or of another program" in refused(city)


def test_another_descriptor_configuration(city: Path) -> None:
    other = replace(DEFAULT, min_area_m2=40.0)
    assert "another descriptor configuration" in refused(city, other)
    with pytest.raises(DatabaseError, match="another descriptor configuration"):
        Matcher(open_database(city, DEFAULT), other)
    # What matching makes of the descriptors is no part of them.
    assert len(open_database(city, replace(DEFAULT, tau_shape=0.1, matches_per_star=5))) == len(CITY)


# Builds


def test_a_failed_build_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "city.bldb"
    tiles = cut(CITY, 800.0)
    with pytest.raises(KeyError), DatabaseWriter(path, UTM, DEFAULT) as writer:
        for name, tile in tiles.items():
            writer.add(name, tile)
        raise KeyError("half-way")
    assert not path.exists()
    with DatabaseWriter(path, UTM, DEFAULT) as writer:  # left without a commit
        writer.add("0_0", tiles[next(iter(tiles))])
        assert "was cut off" in refused(path)
    assert not path.exists()
    with (
        pytest.raises(DatabaseError, match="no building to store"),
        DatabaseWriter(path, UTM, DEFAULT) as writer,
    ):
        writer.commit(SOURCES, {})
    assert not path.exists()


def test_a_failed_build_keeps_the_database_that_stands_there(city: Path) -> None:
    files = {file.name: file.read_bytes() for file in city.iterdir()}
    with pytest.raises(KeyError), DatabaseWriter(city, UTM, DEFAULT) as writer:
        writer.add("0_0", next(iter(cut(OTHER, 5000.0).values())))
        assert len(open_database(city, DEFAULT)) == len(CITY)  # nor does one that is under way change it
        raise KeyError("half-way")
    assert {file.name: file.read_bytes() for file in city.iterdir()} == files


KILLED_WRITER = """
import os, signal, sys
from pathlib import Path
from buildloc_matcher.reference.database import DatabaseWriter
from towns import DEFAULT, UTM, cut, town

with DatabaseWriter(Path(sys.argv[1]), UTM, DEFAULT) as writer:
    for name, tile in cut(town(22, 500, 1200.0), 500.0).items():
        writer.add(name, tile)
    os.kill(os.getpid(), signal.SIGKILL)
"""
KILLED_BUILD = """
import os, signal, sys
from contextlib import nullcontext
from pathlib import Path
import geopandas as gpd
from buildloc_matcher.reference import build
from shapely import box
from towns import DEFAULT, UTM, town

def progress(text):
    if text.startswith("3 tiles described"):
        os.kill(os.getpid(), signal.SIGKILL)

out = Path(sys.argv[1])
source = out.with_name("town.parquet")
points = town(22, 500, 1200.0).centroids_m
gpd.GeoDataFrame(geometry=box(*(points - 6.0).T, *(points + 6.0).T), crs=UTM).to_parquet(source)
build._processes = lambda _: nullcontext()
build.build([source], out, DEFAULT, tile_km=0.5, progress=progress)
"""


@pytest.mark.parametrize(
    ("script", "before"),
    [(KILLED_WRITER, False), (KILLED_BUILD, True)],
    ids=["writing a new one", "building over one"],
)
def test_a_killed_build_is_never_opened_and_the_next_one_clears_up(
    tmp_path: Path, script: str, before: bool
) -> None:
    path = tmp_path / "city.bldb"
    if before:
        write(path)
    named = {file.name for file in path.glob("*.arrow")}
    ended = subprocess.run(
        [sys.executable, "-c", script, str(path)], env={"PYTHONPATH": ":".join(sys.path)}, check=False
    )
    assert ended.returncode == -signal.SIGKILL
    left = {file.name for file in path.glob("*.arrow")} - named
    assert len(left) >= 6  # two tables of three tiles or more
    if before:
        assert len(open_database(path, DEFAULT)) == len(CITY)
    else:
        assert "its build was cut off" in refused(path)
    write(path, OTHER)
    assert len(open_database(path, DEFAULT)) == len(OTHER)
    assert not left & {file.name for file in path.iterdir()}


def test_a_database_never_takes_the_place_of_something_else(tmp_path: Path) -> None:
    file, folder = tmp_path / "notes.txt", tmp_path / "photographs"
    file.write_text("keep me")
    folder.mkdir()
    (folder / "holiday.jpg").write_text("keep me")
    for path, text in (
        (file, "is not a reference database"),
        (folder, "is not a reference database"),
        (tmp_path / "nowhere" / "city.bldb", "does not exist"),
    ):
        with pytest.raises(DatabaseError, match=text) as error, DatabaseWriter(path, UTM, DEFAULT):
            pass
        assert "\n" not in str(error.value)
    assert file.read_text() == (folder / "holiday.jpg").read_text() == "keep me"


# Readers and writers at once


def test_an_open_database_outlives_its_replacement(city: Path) -> None:
    opened = open_database(city, DEFAULT)
    write(city, OTHER)
    assert same(opened, in_order_of(opened, tiled(CITY, 800.0)))
    assert len(open_database(city, DEFAULT)) == len(OTHER)
    manifest = json.loads((city / MANIFEST).read_text())
    named = {file["name"] for tile in manifest["tiles"] for file in tile["files"].values()}
    assert {file.name for file in city.iterdir()} == named | {MANIFEST}  # nothing of the old one is left


def test_a_database_replaced_while_it_is_being_opened(city: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read, writes = module.read_manifest, [OTHER]

    def and_then_replaced(path: Path) -> dict[str, Any]:
        manifest = read(path)
        if writes:
            write(path, writes.pop())
        return manifest

    monkeypatch.setattr(module, "read_manifest", and_then_replaced)
    assert len(open_database(city, DEFAULT)) == len(OTHER)


def test_many_readers_at_once(city: Path) -> None:
    seen = local_map(CITY.select(np.hypot(*(CITY.centroids_m - CITY.centroids_m[5]).T) < 200.0))

    def locate(_: int) -> object:
        return Matcher(open_database(city, DEFAULT), DEFAULT).locate(seen).candidates

    expected = locate(0)
    assert expected
    with ThreadPoolExecutor(4) as pool:
        assert all(found == expected for found in pool.map(locate, range(12)))
    shared = Matcher(open_database(city, DEFAULT), DEFAULT).database
    with ThreadPoolExecutor(4) as pool:  # one opened database serves several matchers
        found = pool.map(lambda _: Matcher(shared, DEFAULT).locate(seen).candidates, range(8))
        assert all(candidates == expected for candidates in found)


def test_of_two_builds_at_once_one_wins_whole(tmp_path: Path) -> None:
    path = tmp_path / "city.bldb"
    with (
        pytest.raises(DatabaseError, match="another build has replaced it") as error,
        DatabaseWriter(path, UTM, DEFAULT) as slow,
    ):
        slow.add("0_0", next(iter(cut(OTHER, 5000.0).values())))
        write(path, CITY)
        slow.commit(SOURCES, {})
    assert "\n" not in str(error.value) and len(open_database(path, DEFAULT)) == len(CITY)


def test_a_build_that_fails_beside_another_leaves_that_one_alone(tmp_path: Path) -> None:
    path = tmp_path / "city.bldb"
    with pytest.raises(KeyError, match="half-way"), DatabaseWriter(path, UTM, DEFAULT):
        other = DatabaseWriter(path, UTM, DEFAULT)
        other.__enter__()
        for name, tile in cut(OTHER, 800.0).items():
            other.add(name, tile)
        raise KeyError("half-way")
    other.commit(SOURCES, {})
    other.__exit__()
    assert len(open_database(path, DEFAULT)) == len(OTHER)


def test_it_describes_itself(city: Path) -> None:
    rows = describe_database(city, DEFAULT)
    told = dict(rows)
    west, south, east, north = whole(CITY).bounds_m
    assert told["format"] == "buildloc-reference 3" and told["CRS"] == f"EPSG:{UTM}"
    assert told["bounds"].startswith(f"{west:.0f} {south:.0f} {east:.0f} {north:.0f} m")
    assert (told["buildings"], told["tiles"]) == ("900", str(len(tiled(CITY, 800.0).tiles)))
    assert told["stars"] == f"{whole(CITY).stars:,}" and "checksums agree" in told["size"]
    assert (told["read"], told["used"], told["minimum area"]) == ("1,005", "900", "20 m2")
    assert [value for name, value in rows if name == "source"] == [
        "city.parquet, 1,000 geometries, licence: ODbL 1.0",
        "more.shp, 5 geometries, licence: CC BY",
    ]
    assert ("sha256", "ab" * 32) in rows
