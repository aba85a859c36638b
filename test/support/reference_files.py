"""Reference databases and footprint files, good and bad: the one place that knows how to spoil them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from unittest import mock

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.reference import database
from buildloc_matcher.reference.build import build

ORIGIN_DEG = (8.15, 47.62)
BAD_DATABASES = {
    "missing": "no such reference database",
    "truncated": "truncated or damaged",
    "other version": "has version",
    "other configuration": "another descriptor configuration",
    "foreign": "not a buildloc reference database",
}
BAD_FOOTPRINTS: dict[str, tuple[list[dict[str, Any]], str]] = {
    "no": ([], "has no geometry at all"),
    "only empty": ([{"type": "Polygon", "coordinates": []}], "has no geometry at all"),
    # Polygons without any area: nothing that a repair could keep.
    "only invalid": (
        [{"type": "Polygon", "coordinates": [[[8.0, 47.0], [8.001, 47.0], [8.0, 47.0], [8.0, 47.0]]]}],
        "no building polygon",
    ),
    "only non-polygon": (
        [
            {"type": "Point", "coordinates": [8.0, 47.0]},
            {"type": "LineString", "coordinates": [[8.0, 47.0], [8.001, 47.0]]},
        ],
        "no building polygon",
    ),
}


def write_geojson(path: Path, geometries: list[dict[str, Any]]) -> Path:
    features = [{"type": "Feature", "properties": {}, "geometry": g} for g in geometries]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def houses(path: Path, rows: int = 5) -> Path:
    """Footprints of rows x rows houses of about 15 x 17 m on a crooked grid."""
    geometries = []
    for i in range(rows):
        for j in range(rows):
            west = ORIGIN_DEG[0] + 5e-4 * i + 4e-5 * j
            south = ORIGIN_DEG[1] + 4e-4 * j + 1e-5 * i * i
            east, north = west + 2e-4, south + 1.5e-4
            ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
            geometries.append({"type": "Polygon", "coordinates": [ring]})
    return write_geojson(path, geometries)


def build_database(path: Path, footprints: Path, config: MatcherConfig | None = None) -> Path:
    build([footprints], path, config or MatcherConfig())
    return path


def bad_database(kind: str, path: Path, footprints: Path) -> Path:
    """What the default configuration refuses, one of BAD_DATABASES."""
    if kind == "missing":
        return path
    if kind == "foreign":
        path.write_text("not a database\n")
        return path
    if kind == "other configuration":
        return build_database(path, footprints, MatcherConfig(min_area_m2=40.0))
    if kind == "other version":
        with mock.patch.object(database, "FORMAT_VERSION", database.FORMAT_VERSION + 1):
            return build_database(path, footprints)
    assert kind == "truncated"
    table = next(build_database(path, footprints).glob("*.triangles.arrow"))
    whole = table.read_bytes()
    table.write_bytes(whole[: len(whole) // 2])
    return path
