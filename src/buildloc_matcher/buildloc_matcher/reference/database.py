"""The reference database: a folder of Arrow tables, opened by memory map, and the manifest that names them.

    city.bldb/database.json                     what it is; replaced at once when a build has succeeded
    city.bldb/TILE.ID.buildings.arrow           geometry (points of the UTM zone), area, shape, outline
    city.bldb/TILE.ID.triangles.arrow           vertices, neighbours, features and sketches of triangles

The tables are Arrow IPC files with the metadata of GeoParquet: GeoPandas (read_feather), QGIS and DuckDB
(through pyarrow) read them. Names carry an ID of their own build, so that a build beside a reader, or one
that is killed, never changes a table in use.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import uuid
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import SHAPE_METRICS
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.descriptors import DESCRIPTOR_VERSION, MAX_CIRCUMRADIUS_M, TRIANGLE_FEATURES, Triangles
from buildloc_matcher.evidence import Ground, ground
from buildloc_matcher.matching import StarTable, star_table
from buildloc_matcher.reference.buildings import OUTLINE_VERTICES, Buildings, SourceRecord, concatenate
from buildloc_matcher.reference.tile import Box, Tile, make_tile
from buildloc_matcher.star_index import SKETCH_BYTES

FORMAT = "buildloc-reference"
FORMAT_VERSION = 3
MANIFEST = "database.json"
WGS84 = 4326
TABLES = ("buildings", "triangles")
REBUILD = "build it again with `buildloc refdb build`"
OUTLINE = "outline_dm"
SKETCH_COLUMNS = tuple(f"sketch_{i:02d}" for i in range(SKETCH_BYTES))


class DatabaseError(BuildlocError):
    """A reference database cannot be used."""


class DatabaseMissingError(DatabaseError):
    """There is no such database."""


@dataclass(frozen=True)
class ReferenceDatabase:
    """Tiles of one UTM zone ``epsg`` (metres, x east, y north), as one reference."""

    epsg: int
    tiles: tuple[Tile, ...]
    descriptor_hash: str

    def __len__(self) -> int:
        return sum(tile.owned for tile in self.tiles)

    @cached_property
    def buildings(self) -> Buildings:
        """The buildings of all tiles, each once."""
        return concatenate([tile.buildings.select(np.arange(tile.owned)) for tile in self.tiles])

    @property
    def centroids_m(self) -> FloatArray:
        """(N, 2) centroids of all buildings."""
        return self.buildings.centroids_m

    @cached_property
    def ground(self) -> Ground:
        """Finds the buildings near a place."""
        return ground(self.centroids_m, self.buildings.areas_m2, self.buildings.outlines)

    @cached_property
    def tables(self) -> tuple[StarTable, ...]:
        """The stars of each tile for matching, numbered through."""
        tables, first = [], 0
        for tile in self.tiles:
            tables.append(star_table(tile.triangles, tile.buildings.areas_m2, tile.sketches, first))
            first += tile.triangles.stars
        return tuple(tables)

    @property
    def stars(self) -> int:
        """Number of stars."""
        return sum(tile.triangles.stars for tile in self.tiles)

    def star_corners(self, stars: NDArray[np.int64]) -> FloatArray:
        """(M, 3, 2) centroids at the corners of the stars' central triangles, by their sorted angles."""
        if len(self.tiles) == 1:  # half the time
            tile = self.tiles[0]
            return np.asarray(tile.buildings.centroids_m[tile.triangles.vertices[stars]])
        corners = np.empty((len(stars), 3, 2))
        of_tile = np.searchsorted([table.first for table in self.tables], stars, side="right") - 1
        for number, (tile, table) in enumerate(zip(self.tiles, self.tables, strict=True)):
            own = np.flatnonzero(of_tile == number)
            vertices = tile.triangles.vertices[stars[own] - table.first]
            corners[own] = tile.buildings.centroids_m[vertices]
        return corners

    @cached_property
    def bounds_m(self) -> Box:
        """West, south, east, north of the centroids."""
        low, high = self.centroids_m.min(axis=0), self.centroids_m.max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    @property
    def area_m2(self) -> float:
        """Area of the bounds."""
        west, south, east, north = self.bounds_m
        return (east - west) * (north - south)

    @cached_property
    def _to_wgs84(self) -> Transformer:
        return Transformer.from_crs(CRS(self.epsg), CRS(WGS84), always_xy=True)

    def to_wgs84(self, easting_m: float, northing_m: float) -> tuple[float, float]:
        """(latitude, longitude) in degrees."""
        longitude, latitude = self._to_wgs84.transform(easting_m, northing_m)
        return float(latitude), float(longitude)


def descriptor_hash(config: MatcherConfig) -> str:
    """What a database and its query must agree on: the encoder and which buildings it is given."""
    settings = {
        "descriptor": DESCRIPTOR_VERSION,
        "shapes": SHAPE_METRICS,
        "max_circumradius_m": MAX_CIRCUMRADIUS_M,
        "min_area_m2": config.min_area_m2,
    }
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def assemble(epsg: int, buildings: Buildings, config: MatcherConfig) -> ReferenceDatabase:
    """A database of one tile from measured buildings, in memory."""
    everywhere = (-np.inf, -np.inf, np.inf, np.inf)
    return ReferenceDatabase(epsg, (make_tile(buildings, everywhere, config),), descriptor_hash(config))


class DatabaseWriter:
    """Writes tiles one by one; nothing is visible before :meth:`commit`, and leaving without it removes all.

    A database that stands at ``path`` is replaced by the commit. Raises DatabaseError where ``path`` is
    something else, or its folder does not exist.
    """

    def __init__(self, path: Path, epsg: int, config: MatcherConfig) -> None:
        self._path, self._epsg, self._config = Path(path), epsg, config
        self._id = uuid.uuid4().hex[:8]
        self._tiles: list[dict[str, Any]] = []
        self._committed = False

    def __enter__(self) -> DatabaseWriter:
        path = self._path
        if not path.parent.is_dir():
            raise DatabaseError(f"{path}: the folder {path.parent} does not exist; make it first")
        others = [p.name for p in path.iterdir() if not _is_ours(p)] if path.is_dir() else []
        if (path.exists() and not path.is_dir()) or others:
            raise DatabaseError(f"{path}: exists and is not a reference database; choose another --out")
        self._made = not path.exists()
        path.mkdir(exist_ok=True)
        return self

    def add(self, name: str, tile: Tile) -> None:
        """Write the tables of a tile; a tile without buildings is left out."""
        if not tile.owned and not tile.triangles.stars:
            return
        files = {}
        for kind, table in (
            ("buildings", _buildings_table(tile, self._epsg)),
            ("triangles", _triangles_table(tile)),
        ):
            file = self._path / f"{name}.{self._id}.{kind}.arrow"
            with pa.OSFile(str(file), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
                writer.write_table(table)
            data = file.read_bytes()
            files[kind] = {"name": file.name, "bytes": len(data), "crc32": zlib.crc32(data)}
        counts = {"owned": tile.owned, "stars": tile.triangles.stars}
        self._tiles.append({"name": name, "box_m": list(tile.box_m), **counts, "files": files})

    def commit(self, sources: Sequence[SourceRecord], counts: Mapping[str, int]) -> None:
        """Make the tiles added so far the database, in one step. Raises DatabaseError without buildings."""
        buildings = sum(tile["owned"] for tile in self._tiles)
        names = {file["name"] for tile in self._tiles for file in tile["files"].values()}
        if not names <= {file.name for file in self._path.iterdir()}:
            raise DatabaseError(f"{self._path}: another build has replaced it meanwhile; run this one again")
        if not buildings:
            raise DatabaseError(f"{self._path}: no building to store; check region and min_area_m2")
        manifest = {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "crs": f"EPSG:{self._epsg}",
            "descriptor_hash": descriptor_hash(self._config),
            "min_area_m2": self._config.min_area_m2,
            "buildings": buildings,
            "stars": sum(tile["stars"] for tile in self._tiles),
            "sources": [asdict(source) for source in sources],
            "counts": dict(counts),
            "tiles": sorted(self._tiles, key=lambda tile: str(tile["name"])),
        }
        staged = self._path / f"{self._id}.{MANIFEST}"
        with staged.open("w") as file:
            json.dump(manifest, file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        os.replace(staged, self._path / MANIFEST)
        self._committed = True

    def __exit__(self, *_: object) -> None:
        """Remove what the manifest does not name: tables of this build if it failed, else of earlier ones."""
        for file in self._path.iterdir():
            ours = self._id in file.name.split(".")
            if file.name != MANIFEST and (ours != self._committed):
                file.unlink(missing_ok=True)
        if self._made and not self._committed:
            with suppress(OSError):  # another build is writing into it
                self._path.rmdir()


def _is_ours(path: Path) -> bool:
    return path.name.endswith(MANIFEST) or path.name.endswith(tuple(f".{kind}.arrow" for kind in TABLES))


def _fixed(values: NDArray[Any]) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


def _buildings_table(tile: Tile, epsg: int) -> pa.Table:
    found = tile.buildings
    x, y = (np.ascontiguousarray(column) for column in found.centroids_m.T)
    point = pa.StructArray.from_arrays([pa.array(x), pa.array(y)], names=["x", "y"])
    columns = {
        "geometry": point,
        "area_m2": pa.array(found.areas_m2),
        **{n: pa.array(np.ascontiguousarray(c)) for n, c in zip(SHAPE_METRICS, found.shapes.T, strict=True)},
        "beyond_tile": pa.array(np.arange(len(found)) >= tile.owned),
    }
    if found.outlines is not None:
        columns[OUTLINE] = _fixed(found.outlines.reshape(len(found), -1))
    geometry = {"encoding": "point", "geometry_types": ["Point"], "crs": CRS(epsg).to_json_dict()}
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": geometry}}
    extension = {"ARROW:extension:name": "geoarrow.point"}
    fields = [
        pa.field(name, values.type, metadata=extension if name == "geometry" else None)
        for name, values in columns.items()
    ]
    schema = pa.schema(fields, metadata={"geo": json.dumps(geo)})
    return pa.Table.from_arrays(list(columns.values()), schema=schema)


def _triangles_table(tile: Tile) -> pa.Table:
    triangles = tile.triangles
    padded = np.zeros((SKETCH_BYTES, len(triangles)), dtype=np.uint8)
    padded[:, : triangles.stars] = tile.sketches
    return pa.table(
        {
            "vertices": _fixed(triangles.vertices),
            "neighbours": _fixed(triangles.neighbours),
            "features": _fixed(triangles.features),
            **{name: pa.array(row) for name, row in zip(SKETCH_COLUMNS, padded, strict=True)},
        }
    )


def read_manifest(path: Path) -> dict[str, Any]:
    """What a database says of itself. Raises DatabaseMissingError, or DatabaseError for what is none."""
    path = Path(path)
    if not path.exists():
        raise DatabaseMissingError(f"{path}: no such reference database; {REBUILD}")
    if not path.is_dir() or not (path / MANIFEST).is_file():
        raise DatabaseError(
            f"{path}: is not a buildloc reference database, or its build was cut off; {REBUILD}"
        )
    try:
        manifest = json.loads((path / MANIFEST).read_text())
        foreign = manifest["format"] != FORMAT
        version = manifest["version"]
    except (ValueError, KeyError, TypeError) as error:
        raise DatabaseError(f"{path}: {MANIFEST} is damaged or of another program; {REBUILD}") from error
    if foreign:
        raise DatabaseError(f"{path}: is not a buildloc reference database; {REBUILD}")
    if version != FORMAT_VERSION:
        raise DatabaseError(
            f"{path}: reference database has version {version}, not {FORMAT_VERSION}; {REBUILD}"
        )
    return dict(manifest)


def open_database(path: Path, config: MatcherConfig, box_m: Box | None = None) -> ReferenceDatabase:
    """Open a database made with the same descriptor configuration; with ``box_m``, only the tiles it touches.

    Raises DatabaseMissingError, or DatabaseError for one that is foreign, damaged, of another version or of
    another descriptor configuration.
    """
    path = Path(path)
    try:
        return _open(path, config, box_m)
    except FileNotFoundError:  # a build has replaced it since the manifest was read
        pass
    try:
        return _open(path, config, box_m)
    except FileNotFoundError as error:
        raise DatabaseError(f"{path}: {Path(error.filename).name} is missing; {REBUILD}") from error


def _open(path: Path, config: MatcherConfig, box_m: Box | None) -> ReferenceDatabase:
    manifest = read_manifest(path)
    if manifest.get("descriptor_hash") != descriptor_hash(config):
        raise DatabaseError(
            f"{path}: reference database was built with another descriptor configuration "
            f"({manifest.get('descriptor_hash')}, not {descriptor_hash(config)}); {REBUILD}"
        )
    try:
        epsg = int(str(manifest["crs"]).removeprefix("EPSG:"))
        wanted = [tile for tile in manifest["tiles"] if box_m is None or _touch(tile["box_m"], box_m)]
        tiles = tuple(_open_tile(path, tile) for tile in wanted)
    except (KeyError, IndexError, ValueError, TypeError, pa.ArrowException) as error:
        raise DatabaseError(f"{path}: reference database is damaged; {REBUILD}") from error
    if not any(tile.owned for tile in tiles):
        raise DatabaseError(f"{path}: has no building in the region asked for; see `buildloc refdb info`")
    return ReferenceDatabase(epsg, tiles, str(manifest["descriptor_hash"]))


def _touch(one: Sequence[float], other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _open_tile(path: Path, entry: Mapping[str, Any]) -> Tile:
    found, mesh = (_table(path / entry["files"][kind]["name"], entry["files"][kind]) for kind in TABLES)
    point = _column(found, "geometry")
    buildings = Buildings(
        np.column_stack([np.asarray(point.field("x")), np.asarray(point.field("y"))]),
        np.asarray(_column(found, "area_m2")),
        np.column_stack([np.asarray(_column(found, name)) for name in SHAPE_METRICS]),
        _rows(found, OUTLINE, 2 * OUTLINE_VERTICES).reshape(-1, OUTLINE_VERTICES, 2)
        if OUTLINE in found.column_names
        else None,
    )
    stars, owned = int(entry["stars"]), int(entry["owned"])
    triangles = Triangles(
        _rows(mesh, "vertices", 3),
        _rows(mesh, "neighbours", 3),
        _rows(mesh, "features", TRIANGLE_FEATURES),
        stars,
    )
    sketches = np.stack([np.asarray(_column(mesh, name))[:stars] for name in SKETCH_COLUMNS])
    if not (owned <= len(buildings) and stars <= len(triangles)):
        raise ValueError("counts do not fit the tables")
    box = tuple(float(v) for v in entry["box_m"])
    return Tile((box[0], box[1], box[2], box[3]), buildings, owned, triangles, sketches)


def _table(file: Path, entry: Mapping[str, Any]) -> pa.Table:
    try:
        with pa.memory_map(str(file)) as mapped:
            data = mapped.read_buffer()
    except FileNotFoundError as error:  # Arrow's own does not say which
        raise FileNotFoundError(errno.ENOENT, "no such table", str(file)) from error
    if data.size != entry["bytes"] or zlib.crc32(data) != entry["crc32"]:
        raise DatabaseError(f"{file}: is truncated or damaged; {REBUILD}")
    return pa.ipc.open_file(data).read_all()


def _column(table: pa.Table, name: str) -> pa.Array:
    """A column as the one piece that it is in the file; an empty table has no piece at all."""
    column = table.column(name)
    return column.chunk(0) if column.num_chunks else pa.array([], column.type)


def _rows(table: pa.Table, name: str, width: int) -> NDArray[Any]:
    return np.asarray(_column(table, name).values).reshape(-1, width)


def describe_database(path: Path, config: MatcherConfig) -> list[tuple[str, str]]:
    """All that a database says of itself, for people; opens it, so that a damaged one is refused."""
    database, manifest = open_database(path, config), read_manifest(path)
    west, south, east, north = database.bounds_m
    low, high = database.to_wgs84(west, south), database.to_wgs84(east, north)
    size = sum(file["bytes"] for tile in manifest["tiles"] for file in tile["files"].values())
    rows = [
        ("format", f"{manifest['format']} {manifest['version']}"),
        ("buildings", f"{len(database):,}"),
        ("stars", f"{database.stars:,}"),
        ("tiles", f"{len(database.tiles)}"),
        ("CRS", str(manifest["crs"])),
        ("bounds", f"{west:.0f} {south:.0f} {east:.0f} {north:.0f} m (west south east north)"),
        ("south-west", f"{low[0]:.5f}, {low[1]:.5f}"),
        ("north-east", f"{high[0]:.5f}, {high[1]:.5f}"),
        ("per km2 of bounds", f"{len(database) / max(database.area_m2 * 1e-6, 1e-6):.0f} buildings"),
        ("minimum area", f"{manifest['min_area_m2']:g} m2"),
        ("descriptor hash", str(manifest["descriptor_hash"])),
        ("size", f"{size / 1e6:.1f} MB, {size / len(database):.0f} bytes per building; checksums agree"),
    ]
    rows += [(name.replace("_", " "), f"{count:,}") for name, count in manifest["counts"].items()]
    for source in manifest["sources"]:
        rows.append(
            ("source", f"{source['path']}, {source['read']:,} geometries, licence: {source['licence']}")
        )
        rows.append(("sha256", str(source["sha256"])))
    return rows
