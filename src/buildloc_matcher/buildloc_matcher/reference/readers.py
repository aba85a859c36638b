"""Footprint files as batches of geometries, whatever the format.

Nothing here holds a whole file. GeoParquet is read by record batch, and of row groups that lie outside the
window only the statistics. GeoPackage, FlatGeobuf and Shapefile are read through GDAL by their spatial index
where there is one. Newline-delimited GeoJSON is read line by line. Plain GeoJSON is streamed by GDAL, which
holds up to about 200 MB of it; it passes over the file twice, once for its schema.
"""

from __future__ import annotations

import gzip
import itertools
import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import geopandas as gpd
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyogrio
import pyogrio.raw
import shapely
from buildloc_msgs_py.errors import BuildlocError
from numpy.typing import NDArray
from pyproj import CRS

from buildloc_matcher.reference.region import WGS84, Bounds

BATCH = 50_000
PARQUET_SUFFIXES = (".parquet", ".geoparquet", ".pq")
# Microsoft's files are named .csv.gz and hold one GeoJSON feature per line.
_LINES = (".geojsonl", ".geojsons", ".ndjson", ".jsonl")
LINES_SUFFIXES = (*_LINES, *(f"{suffix}.gz" for suffix in _LINES), ".csv.gz")
GDAL_SUFFIXES = (".geojson", ".geojson.gz", ".gpkg", ".shp", ".shp.zip", ".fgb")
FETCH_MANIFEST = "fetch.json"
EDGES = ("xmin", "ymin", "xmax", "ymax")
UNKNOWN = (np.nan, np.nan, np.nan, np.nan)

Geometries = NDArray[np.object_]


class IngestError(BuildlocError):
    """A footprint file cannot be used."""


class FootprintFile(Protocol):
    """An open footprint file. ``crs`` is None when the file states none; ``licence`` likewise."""

    path: Path
    crs: CRS | None
    licence: str | None

    def bounds(self) -> Bounds | None:
        """West, south, east, north in the file's CRS, None when there is nothing; may read the file."""

    def batches(self, window: Bounds | None = None) -> Iterator[Geometries]:
        """Up to BATCH geometries at a time, None for what cannot be decoded.

        Geometries that do not touch the window (file's CRS) may be left out.
        """


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn whatever a library raises about the file into one line."""
    try:
        yield
    except BuildlocError:
        raise
    except Exception as error:
        line = str(error).strip().splitlines()
        raise IngestError(
            f"{path}: not a readable footprint file "
            f"({type(error).__name__}: {line[0] if line else 'no detail'}); export it again"
        ) from error


def _stated_licence(*metadata: Mapping[str, Any] | None) -> str | None:
    for mapping in metadata:
        for key, value in (mapping or {}).items():
            if key.lower() in ("licence", "license") and value:
                return " ".join(str(value).split())
    return None


def _union(boxes: Iterable[Bounds]) -> Bounds | None:
    corners = np.array([box for box in boxes if np.isfinite(box).all()]).reshape(-1, 4)
    if len(corners) == 0:
        return None
    west, south = corners[:, :2].min(axis=0).tolist()
    east, north = corners[:, 2:].max(axis=0).tolist()
    return west, south, east, north


def _bounds_of(batches: Iterable[Geometries]) -> Bounds | None:
    return _union(tuple(shapely.total_bounds(batch).tolist()) for batch in batches)


class _Parquet:
    """GeoParquet with WKB or native geometries."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with _readable(path):
            self._file = pq.ParquetFile(path)
            metadata = {k.decode(): v for k, v in (self._file.schema_arrow.metadata or {}).items()}
            if "geo" not in metadata:
                raise IngestError(f"{path}: is Parquet without GeoParquet metadata; convert it")
            geo = json.loads(metadata["geo"])
            self._name = str(geo["primary_column"])
            column = geo["columns"][self._name]
            self._encoding = str(column["encoding"])
            crs = column.get("crs", "OGC:CRS84")
            self.crs = None if crs is None else CRS.from_user_input(crs)
            self._stated = column.get("bbox")
            self._covering: dict[str, list[str]] | None = column.get("covering", {}).get("bbox")
        texts = {key: value.decode(errors="replace") for key, value in metadata.items() if key != "geo"}
        self.licence = _stated_licence(geo, texts)

    def _edges(self) -> tuple[str, str, str, str] | None:
        """Paths of the columns whose minima and maxima bound a row group: west, south, east, north."""
        if self._covering is not None:
            west, south, east, north = (".".join(self._covering[edge]) for edge in EDGES)
            return west, south, east, north
        schema = self._file.schema
        leaves = [schema.column(i).path for i in range(len(schema))]
        inside = [leaf for leaf in leaves if leaf.startswith(f"{self._name}.")]
        x = [leaf for leaf in inside if leaf.endswith(".x")]
        y = [leaf for leaf in inside if leaf.endswith(".y")]
        return (x[0], y[0], x[0], y[0]) if x and y else None

    def _group_bounds(self, group: int) -> Bounds:
        """What the statistics say; UNKNOWN when they do not."""
        edges = self._edges()
        if edges is None:
            return UNKNOWN
        row_group = self._file.metadata.row_group(group)
        columns = {row_group.column(i).path_in_schema: i for i in range(row_group.num_columns)}
        found = [row_group.column(columns[edge]).statistics for edge in edges]
        if any(statistics is None or not statistics.has_min_max for statistics in found):
            return UNKNOWN
        return (
            float(found[0].min), float(found[1].min), float(found[2].max), float(found[3].max)
        )  # fmt: skip

    def bounds(self) -> Bounds | None:
        if self._stated is not None:
            half = len(self._stated) // 2
            return self._stated[0], self._stated[1], self._stated[half], self._stated[half + 1]
        groups = [self._group_bounds(group) for group in range(self._file.num_row_groups)]
        return _bounds_of(self.batches()) if UNKNOWN in groups else _union(groups)

    def batches(self, window: Bounds | None = None) -> Iterator[Geometries]:
        with _readable(self.path):
            groups = list(range(self._file.num_row_groups))
            if window is not None:
                boxes = np.array([self._group_bounds(group) for group in groups]).reshape(-1, 4)
                groups = np.flatnonzero(touching(boxes, window)).tolist()
            columns = [self._name]
            covering = self._covering if window is not None else None
            if covering is not None:
                columns.append(covering["xmin"][0])
            for batch in self._file.iter_batches(BATCH, row_groups=groups, columns=columns):
                if window is not None and covering is not None:
                    batch = batch.filter(_rows_touching(batch, covering, window))
                yield self._decode(batch.column(self._name))

    def _decode(self, column: pa.Array) -> Geometries:
        if isinstance(column, pa.ExtensionArray):
            column = column.storage
        if self._encoding.upper() == "WKB":
            return from_wkb(column)
        extension = {"ARROW:extension:name": f"geoarrow.{self._encoding}"}
        field = pa.field("geometry", column.type, metadata=extension)
        table = pa.Table.from_arrays([column], schema=pa.schema([field]))
        return np.asarray(gpd.GeoDataFrame.from_arrow(table).geometry.to_numpy(), dtype=object)


def touching(boxes: NDArray[np.float64], window: Bounds) -> NDArray[np.bool_]:
    """Which boxes (N, 4) are not known to lie apart from the window; NaN is not known."""
    west, south, east, north = boxes.T
    apart = (west > window[2]) | (east < window[0]) | (south > window[3]) | (north < window[1])
    return np.asarray(~apart)


def _rows_touching(batch: pa.RecordBatch, covering: dict[str, list[str]], window: Bounds) -> pa.Array:
    edges = [covering[edge] for edge in EDGES]
    boxes = [batch.column(root).field(leaf).to_numpy(zero_copy_only=False) for root, leaf in edges]
    return pa.array(touching(np.column_stack(boxes).astype(np.float64), window))


def from_wkb(column: pa.Array) -> Geometries:
    """Geometries of an Arrow array of WKB; None where it is null or no WKB."""
    with np.errstate(invalid="ignore"):  # NaN coordinates are found out later
        found = shapely.from_wkb(column.to_numpy(zero_copy_only=False), on_invalid="ignore")
    return np.asarray(found, dtype=object)


class _Lines:
    """Newline-delimited GeoJSON, plain or gzipped; RFC 7946 makes it WGS84."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.crs: CRS | None = CRS(WGS84)
        self.licence: str | None = None

    def bounds(self) -> Bounds | None:
        return _bounds_of(self.batches())

    def batches(self, window: Bounds | None = None) -> Iterator[Geometries]:
        opened = gzip.open if self.path.suffix.lower() == ".gz" else open
        with _readable(self.path), opened(self.path, "rt", encoding="utf-8-sig") as file:
            # RFC 8142 puts a record separator before each feature.
            lines = ((n, text) for n, line in enumerate(file, 1) if (text := line.strip("\x1e \t\r\n")))
            while rows := list(itertools.islice(lines, BATCH)):
                found = shapely.from_geojson([text for _, text in rows], on_invalid="ignore")
                for row in np.flatnonzero(shapely.is_missing(found)):
                    self._check(*rows[row])
                yield np.asarray(found, dtype=object)

    def _check(self, number: int, text: str) -> None:
        """A line without geometry is counted; one that is no GeoJSON means the file is damaged."""
        try:
            kind = json.loads(text)["type"]
        except (ValueError, KeyError, TypeError):
            kind = None
        if not isinstance(kind, str):
            raise IngestError(f"{self.path}: line {number} is no GeoJSON feature; export it again")


class _Gdal:
    """Anything else that GDAL reads: GeoJSON, GeoPackage, FlatGeobuf, Shapefile."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._source = f"/vsigzip/{path.resolve()}" if path.suffix.lower() == ".gz" else str(path)
        with _readable(path):
            self._layer = self._polygon_layer()
            info = pyogrio.read_info(self._source, layer=self._layer)
        self.crs = None if info["crs"] is None else CRS.from_user_input(info["crs"])
        self._bounds = info["total_bounds"] and _union([info["total_bounds"]])  # GDAL may say infinity
        self._has_geometry = info["geometry_type"] is not None
        self.licence = _stated_licence(info["layer_metadata"], info["dataset_metadata"])

    def _polygon_layer(self) -> str | None:
        """The layer that may hold polygons; None, the first, where a file has just one."""
        if self.path.suffix.lower() != ".gpkg":
            return None
        layers = [(str(name), kind or "") for name, kind in pyogrio.list_layers(self._source)]
        polygons = [name for name, kind in layers if "Polygon" in kind or "Unknown" in kind]
        if len(polygons) > 1:
            raise IngestError(
                f"{self.path}: has several polygon layers ({', '.join(polygons)}); export the buildings alone"
            )
        return polygons[0] if polygons else None

    def bounds(self) -> Bounds | None:
        return self._bounds if self._bounds is not None else _bounds_of(self.batches())

    def batches(self, window: Bounds | None = None) -> Iterator[Geometries]:
        if not self._has_geometry:
            return
        with (
            _readable(self.path),
            pyogrio.raw.open_arrow(
                self._source, layer=self._layer, columns=[], bbox=window, batch_size=BATCH, use_pyarrow=True
            ) as (meta, reader),
        ):
            for batch in reader:
                yield from_wkb(batch.column(meta["geometry_name"] or "wkb_geometry"))


def open_file(path: Path) -> FootprintFile:
    """Open a footprint file by its suffix; raises IngestError when it is missing or unreadable."""
    name = path.name.lower()
    if not path.is_file():
        raise IngestError(f"{path}: no such footprint file; give a file or folder of building polygons")
    if name.endswith(PARQUET_SUFFIXES):
        file: FootprintFile = _Parquet(path)
    elif name.endswith(LINES_SUFFIXES):
        file = _Lines(path)
    else:
        file = _Gdal(path)
    file.licence = file.licence or _fetched(path.parent).get(path.name, {}).get("licence")
    return file


def files_of(source: Path) -> list[Path]:
    """The source itself, or the footprint files of a folder, at any depth, by name."""
    if not source.is_dir():
        return [source]
    found = sorted(
        path
        for path in source.rglob("*")
        if path.is_file() and path.name.lower().endswith(PARQUET_SUFFIXES + LINES_SUFFIXES + GDAL_SUFFIXES)
    )
    if not found:
        raise IngestError(f"{source}: holds no footprint file; give GeoParquet, GeoJSON or the like")
    for folder in sorted({path.parent for path in found}):
        for name, record in _fetched(folder).items():
            if record.get("sha256") is None:
                raise IngestError(f"{folder}: {name} is incomplete; run `buildloc refdb fetch` again")
    return found


def _fetched(folder: Path) -> dict[str, dict[str, Any]]:
    """What ``buildloc refdb fetch`` noted of the files of a folder, by name."""
    path = folder / FETCH_MANIFEST
    if not path.is_file():
        return {}
    with _readable(path):
        files: dict[str, dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["files"]
    return files
