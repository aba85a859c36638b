"""Footprint files into buildings: every format alike, regions, repair, every bad file in one clear line."""

from __future__ import annotations

import gzip
import json
import shutil
from pathlib import Path

import geopandas as gpd
import numpy as np
import pyarrow.parquet as pq
import pytest
from buildloc_matcher.reference import readers
from buildloc_matcher.reference.ingest import (
    COUNTS,
    NOT_STATED,
    Reference,
    ingest,
    open_sources,
    read_buildings,
    zone_of,
)
from buildloc_matcher.reference.readers import IngestError, open_file
from buildloc_matcher.reference.region import Box, Circle, Region
from buildloc_matcher.reference.spool import Rows, Spool
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import footprints
from shapely.geometry import LineString, MultiPolygon, Point, Polygon, box

UTM = 32619
ORIGIN = (330_000.0, 4_700_000.0)
RFC7946 = ("a.geojsonl", "a.ndjson.gz", "a.csv.gz")  # always WGS84
READ_WHOLE = ("a.parquet", *RFC7946)  # without statistics or an index, and not filtered by GDAL
FORMATS = [
    "covering.parquet", "native.parquet", "a.gpkg", "a.fgb", "a.shp", "a.geojson", "a.geojson.gz", *READ_WHOLE
]  # fmt: skip


def houses(rows: int = 5) -> list[Polygon]:
    """A crooked grid of rectangles in UTM metres."""
    x0, y0 = ORIGIN
    return [
        box(x0 + 40 * i + 3 * j, y0 + 45 * j + i * i, x0 + 40 * i + 3 * j + 10 + j, y0 + 45 * j + i * i + 12)
        for i in range(rows)
        for j in range(rows)
    ]


def write(path: Path, geometry: list[object], crs: int | None = 4326) -> Path:
    """A footprint file, its format by suffix and, for Parquet, by name."""
    frame = gpd.GeoDataFrame(geometry=geometry, crs=UTM if crs is not None else None)
    if crs is not None:
        frame = frame.to_crs(crs)
    if path.suffix == ".parquet":
        native, covering = path.stem == "native", path.stem == "covering"
        frame.to_parquet(
            path, geometry_encoding="geoarrow" if native else "WKB", write_covering_bbox=covering,
            row_group_size=1,
        )  # fmt: skip
    elif path.suffix == ".gz":
        plain = write(
            path.with_name("unzipped.geojson" if ".geojson." in path.name else "unzipped.geojsonl"),
            geometry,
            crs,
        )
        path.write_bytes(gzip.compress(plain.read_bytes()))
        plain.unlink()
    else:
        frame.to_file(path)
    return path


def one_line(error: BaseException) -> str:
    assert isinstance(error, BuildlocError) and "\n" not in str(error) and str(error)
    return str(error)


def refused(sources: list[Path], min_area_m2: float = 20.0, region: Region | None = None) -> str:
    with pytest.raises(BuildlocError) as error:
        read_buildings(sources, min_area_m2, region)
    return one_line(error.value)


def around(x: float, y: float, radius_km: float) -> Circle:
    place = gpd.GeoSeries([Point(x, y)], crs=UTM).to_crs(4326)[0]
    return Circle(place.y, place.x, radius_km)


def same(one: Reference, other: Reference) -> bool:
    return all(
        np.array_equal(getattr(one.buildings, name), getattr(other.buildings, name))
        for name in ("centroids_m", "areas_m2", "shapes", "outlines")
    )


def adds_up(found: Reference) -> bool:
    kept = sum(found.counts[name] for name in COUNTS if name not in ("read", "split", "repaired"))
    return found.counts["read"] + found.counts["split"] == kept


@pytest.mark.parametrize(
    ("name", "crs"),
    [(n, crs) for n in FORMATS for crs in (4326, 3857, UTM) if n not in RFC7946 or crs == 4326],
)
def test_any_format_and_crs_gives_the_same_buildings(tmp_path: Path, name: str, crs: int) -> None:
    found = read_buildings([write(tmp_path / name, houses(), crs)], 20.0)
    assert found.epsg == UTM and found.counts["used"] == 25 and adds_up(found)
    expected = footprints(np.array(sorted(houses(), key=lambda house: house.centroid.x), dtype=object))
    # GeoJSON has seven decimals of a degree: a centimetre.
    np.testing.assert_allclose(found.buildings.centroids_m, expected.centroids_m, atol=0.02)
    np.testing.assert_allclose(found.buildings.areas_m2, expected.areas_m2, rtol=2e-3)
    np.testing.assert_allclose(found.buildings.shapes, expected.shapes, atol=2e-3)


@pytest.mark.parametrize("name", FORMATS)
def test_a_region_cuts_the_city(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name, houses())
    middle = (ORIGIN[0] + 60.0, ORIGIN[1] + 60.0)
    circle = around(*middle, 0.08)
    found = read_buildings([path], 20.0, circle)
    near = [house for house in houses() if np.hypot(*(np.array(house.centroid.coords[0]) - middle)) <= 80.0]
    assert found.counts["used"] == len(near) > 1 and adds_up(found)
    assert (found.counts["read"] == 25) == (name in READ_WHOLE)
    west, south, east, north = circle.bounds_deg
    half = read_buildings([path], 20.0, Box(west, south, (west + east) / 2, north))
    other = read_buildings([path], 20.0, Box((west + east) / 2, south, east, north))
    both = read_buildings([path], 20.0, Box(west, south, east, north))
    assert half.counts["used"] + other.counts["used"] == both.counts["used"] > half.counts["used"]


def test_a_region_without_buildings_is_an_error(tmp_path: Path) -> None:
    path = write(tmp_path / "a.parquet", houses(), UTM)
    assert "no building within 1 km of 10.00000, 10.00000" in refused([path], region=Circle(10.0, 10.0, 1.0))
    assert "no building in the box 1, 2, 3, 4" in refused([path], region=Box(1, 2, 3, 4))
    for radius in (-1.0, 0.0, np.inf, np.nan):
        with pytest.raises(BuildlocError, match="not positive"):
            Circle(10.0, 10.0, radius)
    for edges in ((3, 2, 1, 4), (1, 4, 3, 2), (1, 2, 300, 4), (np.nan, 2, 3, 4)):
        with pytest.raises(BuildlocError, match="WEST,SOUTH,EAST,NORTH"):
            Box(*edges)


def test_the_zone_is_that_of_the_region_or_of_the_middle(tmp_path: Path) -> None:
    west = write(tmp_path / "west.geojsonl", houses())
    assert zone_of(open_sources([west]), None) == 32619
    assert zone_of(open_sources([west]), Circle(-33.9, 151.2, 5.0)) == 32756
    degree = {"type": "Polygon", "coordinates": [[[0, 0], [0.001, 0], [0.001, 0.001], [0, 0]]]}
    far = tmp_path / "far.geojsonl"
    far.write_text(json.dumps({"type": "Feature", "properties": {}, "geometry": degree}))
    assert "span 71 degrees" in refused([west, far])
    assert read_buildings([west, far], 20.0, around(*ORIGIN, 1.0)).counts["used"] == 25


def test_invalid_geometry_is_repaired_and_the_rest_counted(tmp_path: Path) -> None:
    x, y = ORIGIN
    bow_tie = Polygon([(x, y - 90), (x + 20, y - 70), (x + 20, y - 90), (x, y - 70)])
    pair = MultiPolygon([box(x, y - 200, x + 10, y - 190), box(x + 50, y - 200, x + 60, y - 190)])
    shed = box(x, y - 300, x + 2, y - 298)
    nowhere = Polygon([(x, y), (x + 10, np.nan), (x + 10, y + 10)])
    lake = box(x, y - 30_000, x + 20_000, y - 29_000)
    line = LineString([(x, y), (x + 5, y)])
    geometry = [*houses(), bow_tie, pair, shed, Point(x, y), line, Polygon(), None, nowhere, lake]
    found = read_buildings([write(tmp_path / "a.parquet", geometry, UTM)], 20.0)
    assert found.counts == {
        "read": 34, "repaired": 1, "split": 2, "empty": 2, "unusable": 2, "not_polygon": 2, "outside": 0,
        "small": 1, "duplicate": 0, "overlapping": 0, "used": 25 + 2 + 2,
    }  # fmt: skip
    assert adds_up(found)


def test_heights_and_courtyards(tmp_path: Path) -> None:
    x, y = ORIGIN
    ring = Polygon(box(x, y, x + 30, y + 30).exterior, [box(x + 10, y + 10, x + 20, y + 20).exterior])
    tall = Polygon([(x + 50, y, 7.0), (x + 70, y, 7.0), (x + 70, y + 20, 7.0), (x + 50, y + 20, 7.0)])
    found = read_buildings([write(tmp_path / "a.parquet", [ring, tall], UTM)], 20.0)
    np.testing.assert_allclose(found.buildings.areas_m2, [800.0, 400.0])


@pytest.mark.parametrize(
    ("geometry", "found"),
    [
        ([Point(*ORIGIN)], "point"),
        ([LineString([ORIGIN, (0.0, 0.0)])], "linestring"),
        ([Polygon()], "only empty|no geometry"),
        ([None], "only empty|no geometry"),
    ],
)
def test_no_polygon_at_all_is_an_error(tmp_path: Path, geometry: list[object], found: str) -> None:
    with pytest.raises(IngestError, match=found) as error:
        read_buildings([write(tmp_path / "a.parquet", geometry, UTM)], 20.0)
    one_line(error.value)


def test_bad_footprint_files_say_what_is_wrong(tmp_path: Path) -> None:
    unreadable = "not a readable footprint file"
    cases: list[tuple[Path, str]] = [(tmp_path / "absent.geojson", "no such footprint file")]
    for suffix in ("geojson", "parquet", "gpkg", "shp", "fgb", "csv.gz", "geojson.gz", "txt"):
        path = tmp_path / f"garbage.{suffix}"
        path.write_text("not a map")
        cases.append((path, unreadable))
    for name in ("a.parquet", "native.parquet", "a.csv.gz", "a.geojson"):
        path = write(tmp_path / f"half-{name}", houses())
        path.write_bytes(path.read_bytes()[:-100])
        cases.append((path, unreadable))
    (tmp_path / "cut.geojsonl").write_text(write(tmp_path / "whole.geojsonl", houses()).read_text()[:-50])
    cases.append((tmp_path / "cut.geojsonl", "line 25 is no GeoJSON feature"))
    (tmp_path / "none.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    (tmp_path / "none.geojsonl").write_text("\n\n")
    cases += [(tmp_path / f"none.{suffix}", "no geometry") for suffix in ("geojson", "geojsonl")]
    metres = {"type": "Feature", "properties": {}, "geometry": houses()[0].__geo_interface__}
    (tmp_path / "metres.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [metres]}))
    (tmp_path / "metres.geojsonl").write_text(json.dumps(metres))
    cases += [(tmp_path / f"metres.{suffix}", "do not fit its CRS") for suffix in ("geojson", "geojsonl")]
    cases += [(write(tmp_path / "plain.parquet", houses(), None), "no coordinate reference system")]
    pq.write_table(
        pq.read_table(tmp_path / "plain.parquet").replace_schema_metadata(None), tmp_path / "no.pq"
    )
    cases += [(tmp_path / "no.pq", "without GeoParquet metadata")]
    layers = write(tmp_path / "layers.gpkg", houses())
    gpd.GeoDataFrame(geometry=houses(), crs=UTM).to_file(layers, layer="land use")
    cases += [(layers, "several polygon layers (layers, land use)")]
    (tmp_path / "empty").mkdir()
    cases += [(tmp_path / "empty", "holds no footprint file")]
    for path, text in cases:
        message = refused([path])
        assert text in message and str(path) in message
    assert "no footprint file given" in refused([])
    assert "lower min_area_m2" in refused([write(tmp_path / "small.geojson", houses())], 5000.0)
    assert "do not fit its CRS" in refused([tmp_path / "metres.geojsonl"], region=around(*ORIGIN, 1.0))


def test_a_line_without_geometry_is_no_damage(tmp_path: Path) -> None:
    path = write(tmp_path / "a.geojsonl", houses())
    broken = {"type": "Polygon", "coordinates": [[[0, 0], [1, 1]]]}
    extra = [{"type": "Feature", "properties": {}, "geometry": geometry} for geometry in (None, broken)]
    path.write_text("\x1e" + path.read_text() + "\n" + "\n".join(json.dumps(line) for line in extra))
    counts = read_buildings([path], 20.0).counts
    assert (counts["read"], counts["empty"], counts["used"]) == (27, 2, 25)


def test_a_parquet_that_names_no_crs_is_in_degrees(tmp_path: Path) -> None:
    path = write(tmp_path / "a.parquet", houses())
    table = pq.read_table(path)
    geo = json.loads(table.schema.metadata[b"geo"])
    del geo["columns"]["geometry"]["crs"], geo["columns"]["geometry"]["bbox"]
    pq.write_table(table.replace_schema_metadata({"geo": json.dumps(geo)}), path)
    assert read_buildings([path], 20.0).counts["used"] == 25


def test_a_layer_beside_others_is_found(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    gpd.GeoDataFrame(geometry=[LineString([ORIGIN, (0, 0)])], crs=UTM).to_file(path, layer="a road")
    gpd.GeoDataFrame(geometry=houses(), crs=UTM).to_file(path, layer="houses")
    assert read_buildings([path], 20.0).counts["used"] == 25


def test_files_and_folders_together(tmp_path: Path) -> None:
    folder = tmp_path / "tiles" / "deeper"
    folder.mkdir(parents=True)
    write(folder / "a.csv.gz", houses()[:10])
    write(folder.parent / "b.shp", houses()[10:20])
    (folder / "README.txt").write_text("no map")
    (folder / "manifest.json").write_text("{}")
    single = write(tmp_path / "c.gpkg", houses()[20:])
    opened = open_sources([single, folder.parent])
    assert [(source.rank, source.file.path.name) for source in opened] == [
        (0, "c.gpkg"), (1, "b.shp"), (1, "a.csv.gz")
    ]  # fmt: skip
    found = read_buildings([single, folder.parent], 20.0)
    assert found.counts["used"] == found.counts["read"] == 25


def collected(sources: list[Path], folder: Path) -> tuple[list[Rows], Spool]:
    """All rows that ingest puts into a spool, batch by batch."""
    batches = []

    class Watched(Spool):
        def add(self, rows: Rows, outlines: readers.Geometries) -> None:
            batches.append(rows)
            super().add(rows, outlines)

    folder.mkdir()
    spool = Watched(folder, 100.0, False)
    opened = open_sources(sources)
    ingest(opened, spool, zone_of(opened, None), None, 20.0, None, lambda _: None)
    return batches, spool


@pytest.mark.parametrize("name", FORMATS)
def test_memory_holds_a_batch_not_a_file(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / name, houses())
    whole = read_buildings([path], 20.0)
    monkeypatch.setattr(readers, "BATCH", 4)
    sizes = [len(batch) for batch in open_file(path).batches()]
    assert sum(sizes) == 25 and max(sizes) <= 4
    batches, spool = collected([path], tmp_path / "spool")
    assert max(len(batch) for batch in batches) <= 4
    on_disk = [np.fromfile(file, batches[0].dtype) for file in (tmp_path / "spool" / "tiles").iterdir()]
    assert len(on_disk) == len(spool.tiles()) > 1 and sum(len(rows) for rows in on_disk) == 25
    assert same(read_buildings([path], 20.0), whole)


def test_the_order_of_the_input_does_not_matter(tmp_path: Path) -> None:
    shuffled = list(np.random.default_rng(5).permutation(np.array(houses(), dtype=object)))
    one = read_buildings([write(tmp_path / "a.parquet", houses(), UTM)], 20.0)
    assert same(one, read_buildings([write(tmp_path / "b.parquet", shuffled, UTM)], 20.0))


def test_licences_are_found(tmp_path: Path) -> None:
    plain = write(tmp_path / "a.geojson", houses())
    stated = write(tmp_path / "b.parquet", houses())
    table = pq.read_table(stated)
    metadata = {**table.schema.metadata, b"License": b"CC BY 4.0"}
    pq.write_table(table.replace_schema_metadata(metadata), stated)
    fetched = tmp_path / "fetched"
    fetched.mkdir()
    shutil.copy(plain, fetched / "c.geojson")
    record = {"url": "http://here/c.geojson", "licence": "ODbL 1.0", "date": "2026-01-01", "sha256": "0"}
    (fetched / readers.FETCH_MANIFEST).write_text(json.dumps({"files": {"c.geojson": record}}))
    files = [plain, stated, fetched / "c.geojson"]
    assert [open_file(path).licence for path in files] == [None, "CC BY 4.0", "ODbL 1.0"]

    def records(licence: str | None) -> list[tuple[str, str, int]]:
        (tmp_path / str(licence)).mkdir()
        spool = Spool(tmp_path / str(licence), 100.0, False)
        found = ingest(open_sources(files), spool, UTM, None, 20.0, licence, lambda _: None).records
        assert len({record.sha256 for record in found}) == 2 and len(found[0].sha256) == 64
        return [(Path(record.path).name, record.licence, record.read) for record in found]

    assert records(None) == [
        ("a.geojson", NOT_STATED, 25), ("b.parquet", "CC BY 4.0", 25), ("c.geojson", "ODbL 1.0", 25)
    ]  # fmt: skip
    assert {licence for _, licence, _ in records("mine")} == {"mine"}


def test_an_unfinished_fetch_is_not_built_from(tmp_path: Path) -> None:
    write(tmp_path / "a.geojson", houses())
    record = {"url": "http://here/b.csv.gz", "licence": "ODbL 1.0", "date": "2026-01-01", "sha256": None}
    (tmp_path / readers.FETCH_MANIFEST).write_text(json.dumps({"files": {"b.csv.gz": record}}))
    assert "b.csv.gz is incomplete" in refused([tmp_path])


def test_a_circle_may_cross_the_date_line(tmp_path: Path) -> None:
    houses = gpd.GeoSeries([box(x, -17.0, x + 2e-4, -16.9998) for x in (179.999, -179.999)], crs=4326)
    path = tmp_path / "a.fgb"
    houses.to_frame("geometry").to_file(path)
    assert read_buildings([path], 20.0, Circle(-17.0, 179.9995, 1.0)).counts["used"] == 2
