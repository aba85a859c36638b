"""The database file: every bad database, one clear line each."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import geopandas as gpd
import numpy as np
import pyarrow as pa
import pytest
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.database import DatabaseError, DatabaseMissingError, build, open_database, save
from buildloc_matcher.matcher import Matcher
from buildloc_msgs_py.errors import BuildlocError
from shapely.geometry import Polygon, box

CONFIG = MatcherConfig()
UTM = 32619
ORIGIN = (330_000.0, 4_700_000.0)


def houses(rows: int = 5) -> list[Polygon]:
    """A crooked grid of rectangles in UTM metres."""
    x0, y0 = ORIGIN
    return [
        box(x0 + 40 * i + 3 * j, y0 + 45 * j + i * i, x0 + 40 * i + 3 * j + 10 + j, y0 + 45 * j + i * i + 12)
        for i in range(rows)
        for j in range(rows)
    ]


def write(path: Path, geometry: list[object], crs: int | None = 4326) -> Path:
    frame = gpd.GeoDataFrame(geometry=geometry, crs=UTM if crs is not None else None)
    if crs is not None:
        frame = frame.to_crs(crs)
    if path.suffix == ".parquet":
        frame.to_parquet(path)
    else:
        frame.to_file(path, driver="GeoJSON")
    return path


def one_line(error: BaseException) -> str:
    assert isinstance(error, BuildlocError) and "\n" not in str(error) and str(error)
    return str(error)


def test_a_database_survives_the_file(tmp_path: Path) -> None:
    path = tmp_path / "reference.arrow"
    made = build([write(tmp_path / "a.geojson", houses())], CONFIG)
    save(made, path)
    read = open_database(path, CONFIG)
    assert (read.epsg, len(read), len(read.stars)) == (UTM, 25, len(made.stars)) and len(made.stars) > 5
    assert read.bounds_m == made.bounds_m
    np.testing.assert_array_equal(read.centroids_m, made.centroids_m)
    np.testing.assert_array_equal(read.stars.features, made.stars.features)
    np.testing.assert_array_equal(read.stars.triangles, made.stars.triangles)
    latitude, longitude = read.to_wgs84(*ORIGIN)
    assert (latitude, longitude) == pytest.approx((42.433, -71.066), abs=0.01)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.geojson", "reference.arrow"]
    with pytest.raises(DatabaseError) as error:
        save(made, tmp_path / "nowhere" / "reference.arrow")
    assert "does not exist" in one_line(error.value)


def test_bad_databases_are_refused_with_one_line(tmp_path: Path) -> None:
    good = tmp_path / "good.arrow"
    made = build([write(tmp_path / "a.geojson", houses())], CONFIG)
    save(made, good)
    with pytest.raises(DatabaseMissingError) as missing:
        open_database(tmp_path / "absent.arrow", CONFIG)
    assert "no such reference database" in one_line(missing.value)

    def refused(content: bytes) -> str:
        bad = tmp_path / "bad.arrow"
        bad.write_bytes(content)
        with pytest.raises(DatabaseError) as error:
            open_database(bad, CONFIG)
        assert "refdb build" in str(error.value) and str(bad) in str(error.value)
        return one_line(error.value)

    whole = good.read_bytes()
    for kept in (6, 10, 200, len(whole) // 2, len(whole) - 8, len(whole) - 1):
        assert "truncated" in refused(whole[:kept])
    assert "not a buildloc reference database" in refused(b"")
    assert "not a buildloc reference database" in refused(b"PK\x03\x04 something else")
    foreign = pa.BufferOutputStream()
    with pa.ipc.new_file(foreign, pa.schema([("a", pa.int64())])):
        pass
    assert "not a buildloc reference database" in refused(foreign.getvalue().to_pybytes())

    table = pa.ipc.open_file(whole).read_all()
    meta = json.loads(table.schema.metadata[b"buildloc-reference"])

    def changed(**values: object) -> bytes:
        sink = pa.BufferOutputStream()
        other = table.replace_schema_metadata({"buildloc-reference": json.dumps(meta | values)})
        with pa.ipc.new_file(sink, other.schema) as writer:
            writer.write_table(other)
        return bytes(sink.getvalue().to_pybytes())

    assert "has version 99" in refused(changed(version=99))
    assert "another descriptor configuration" in refused(changed(descriptor_hash="0" * 16))
    assert "damaged" in refused(changed(stars=3))
    assert "damaged" in refused(changed(buildings="many"))


def test_another_descriptor_configuration_is_refused(tmp_path: Path) -> None:
    path, other = tmp_path / "reference.arrow", MatcherConfig(min_area_m2=40.0)
    save(build([write(tmp_path / "a.geojson", houses())], CONFIG), path)
    with pytest.raises(DatabaseError) as error:
        open_database(path, other)
    assert "another descriptor configuration" in one_line(error.value)
    with pytest.raises(DatabaseError):
        Matcher(open_database(path, CONFIG), other)
    open_database(path, dataclasses.replace(CONFIG, min_votes=5))
