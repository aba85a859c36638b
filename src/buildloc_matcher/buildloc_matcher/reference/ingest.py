"""Footprint files into measured buildings in metres of one UTM zone, batch by batch."""

from __future__ import annotations

import hashlib
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from buildloc_msgs_py.footprint import footprints
from buildloc_msgs_py.geodesy import utm_epsg
from buildloc_msgs_py.types import FloatArray
from pyproj import CRS, Transformer

from buildloc_matcher.reference.buildings import Buildings, SourceRecord, concatenate, stored_outlines
from buildloc_matcher.reference.merge import overlapping_ids, windows
from buildloc_matcher.reference.readers import (
    FootprintFile,
    Geometries,
    IngestError,
    files_of,
    open_file,
    touching,
)
from buildloc_matcher.reference.region import WGS84, Bounds, Region, transformer
from buildloc_matcher.reference.spool import CELL_M, ROW, Rows, Spool

# Every geometry read, and every piece gained by splitting one, ends as one of those after "split".
COUNTS = (
    "read", "repaired", "split", "empty", "unusable", "not_polygon", "outside", "small", "duplicate",
    "overlapping", "used",
)  # fmt: skip
MAX_EXTENT_M = 10_000.0  # no building is this wide; the largest are below two kilometres
MIN_AREA_M2 = 1e-4  # below it a shape is rounding
MAX_WIDTH_DEG = 12.0  # two UTM zones: further away from the middle metres are none

NOT_STATED = "not stated"

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Source:
    """One file of the source that stands at place ``rank`` of the command line."""

    rank: int
    file: FootprintFile


def open_sources(sources: Sequence[Path]) -> list[Source]:
    """Open all files of all sources; raises IngestError for the first that cannot be used."""
    if not sources:
        raise IngestError("no footprint file given; name at least one file or folder of building polygons")
    opened = [
        Source(rank, open_file(path))
        for rank, source in enumerate(sources)
        for path in files_of(Path(source))
    ]
    for source in opened:
        if source.file.crs is None:
            raise IngestError(
                f"{source.file.path}: states no coordinate reference system; set its CRS and export it again"
            )
    return opened


def zone_of(sources: Sequence[Source], region: Region | None) -> int:
    """EPSG code of the UTM zone of the region's centre, or of the middle of everything.

    Raises IngestError when there is nothing, when coordinates do not fit their CRS, or when everything is too
    wide for one zone.
    """
    if region is not None:
        latitude, longitude = region.center_deg
        return utm_epsg(longitude, latitude)
    boxes = []
    for source in sources:
        bounds = source.file.bounds()
        if bounds is None:
            raise _without_geometry(source.file)
        boxes.append(_in_degrees(source.file, bounds))
    corners = np.array(boxes)
    west, south = corners[:, :2].min(axis=0).tolist()
    east, north = corners[:, 2:].max(axis=0).tolist()
    if east - west > MAX_WIDTH_DEG:
        raise IngestError(
            f"the footprints span {east - west:.0f} degrees of longitude, too many for one UTM zone; "
            "cut out a part with --center and --radius-km or --bbox"
        )
    return utm_epsg((west + east) / 2.0, (south + north) / 2.0)


def _crs(file: FootprintFile) -> CRS:
    assert file.crs is not None, "open_sources refuses files without CRS"
    return file.crs


def _in_degrees_itself(file: FootprintFile) -> bool:
    crs = _crs(file)
    return bool(crs.is_geographic and crs.axis_info[0].unit_name == "degree")


def _in_degrees(file: FootprintFile, bounds: Bounds) -> Bounds:
    west, south, east, north = transformer(_crs(file), CRS(WGS84)).transform_bounds(*bounds)
    if not (-180.0 <= west <= east <= 180.0 and -90.0 <= south <= north <= 90.0):
        raise _misfit(file)
    return west, south, east, north


def _without_geometry(file: FootprintFile) -> IngestError:
    return IngestError(f"{file.path}: has no geometry at all; give a file with building polygons")


def _misfit(file: FootprintFile) -> IngestError:
    name = _crs(file).name
    return IngestError(f"{file.path}: coordinates do not fit its CRS {name}; correct the CRS")


def _window(file: FootprintFile, region: Region | None) -> Bounds | None:
    """The region's bounds in the file's CRS; None where they cannot be told, then all is read."""
    if region is None:
        return None
    window = transformer(CRS(WGS84), _crs(file)).transform_bounds(*region.bounds_deg)
    west, south, east, north = window
    return window if np.isfinite(window).all() and west < east and south < north else None


def polygons(geometries: Geometries) -> tuple[Geometries, Counter[str]]:
    """Valid single polygons: invalid ones repaired, multi-polygons split, everything else counted."""
    counts: Counter[str] = Counter()
    empty = shapely.is_missing(geometries) | shapely.is_empty(geometries)
    counts["empty"] = int(empty.sum())
    values = geometries[~empty]
    coordinates, index = shapely.get_coordinates(values, return_index=True)
    usable = np.ones(len(values), dtype=bool)
    usable[index[~np.isfinite(coordinates).all(axis=1)]] = False
    counts["unusable"] = int((~usable).sum())
    values = values[usable]
    invalid = ~shapely.is_valid(values)
    counts["repaired"] = int(invalid.sum())
    values[invalid] = shapely.make_valid(values[invalid])
    single = shapely.get_type_id(values) == shapely.GeometryType.POLYGON
    parts = values[~single]  # few, and copying the rest takes as long as testing it
    for _ in range(2):  # a collection made by the repair may hold multi-polygons
        parts = shapely.get_parts(parts)
    counts["split"] = len(parts) - int((~single).sum())
    values = np.concatenate([values[single], parts])
    keep = (shapely.get_type_id(values) == shapely.GeometryType.POLYGON) & (shapely.area(values) > 0.0)
    counts["not_polygon"] = int((~keep).sum())
    return values[keep], counts


def _projected(file: FootprintFile, geometries: Geometries, to_utm: Transformer) -> Geometries:
    def project(xy: FloatArray) -> FloatArray:
        metres = np.column_stack(to_utm.transform(xy[:, 0], xy[:, 1]))
        if (np.isfinite(xy) & ~np.isfinite(metres)).any():
            raise _misfit(file)
        return metres

    return np.asarray(shapely.transform(geometries, project), dtype=object)


@dataclass(frozen=True)
class _Measure:
    """What the batches of one file go through."""

    source: Source
    epsg: int
    region: Region | None
    window: Bounds | None
    to_utm: Transformer
    min_area_m2: float

    def __call__(self, geometries: Geometries) -> tuple[Rows, Geometries, Counter[str]]:
        """Measured buildings, their outlines in metres, and what became of the rest."""
        counts = Counter(read=len(geometries))
        if _in_degrees_itself(self.source.file):
            west, south, east, north = shapely.total_bounds(geometries)
            if west < -180.0 or south < -90.0 or east > 180.0 or north > 90.0:  # not so if all are NaN
                raise _misfit(self.source.file)
        if self.window is not None:
            near = touching(shapely.bounds(geometries), self.window)
            counts["outside"] = int((~near).sum())
            geometries = geometries[near]
        outlines, cleaned = polygons(_projected(self.source.file, geometries, self.to_utm))
        counts += cleaned
        boxes = shapely.bounds(outlines)
        building = (boxes[:, 2:] - boxes[:, :2] < MAX_EXTENT_M).all(axis=1)
        counts["unusable"] += int((~building).sum())
        outlines = outlines[building]
        if self.region is not None:
            centroids = shapely.get_coordinates(shapely.centroid(outlines))
            within = self.region.holds(centroids, self.epsg)
            counts["outside"] += int((~within).sum())
            outlines = outlines[within]
        large = shapely.area(outlines) >= max(self.min_area_m2, MIN_AREA_M2)
        counts["small"] = int((~large).sum())
        outlines = outlines[large]
        found = footprints(outlines)
        rows = np.zeros(len(outlines), ROW)
        rows["x"], rows["y"] = found.centroids_m.T
        rows["area"], rows["shape"] = found.areas_m2, found.shapes
        rows["outline"] = stored_outlines(outlines, found.centroids_m)
        rows["source"] = self.source.rank
        return rows, outlines, counts


@dataclass(frozen=True)
class Ingested:
    """What was read of each file, and what became of it all before duplicates are sought (see COUNTS)."""

    records: tuple[SourceRecord, ...]
    counts: Counter[str]


def ingest(
    sources: Sequence[Source],
    spool: Spool,
    epsg: int,
    region: Region | None,
    min_area_m2: float,
    licence: str | None,
    progress: Progress,
) -> Ingested:
    """Measure the buildings of all sources into the spool.

    Raises IngestError when a file cannot be read or holds no polygon, or when nothing at all is left.
    """
    counts: Counter[str] = Counter()
    records = []
    for source in sources:
        file = source.file
        to_utm = transformer(_crs(file), CRS(epsg))
        measure = _Measure(source, epsg, region, _window(file, region), to_utm, min_area_m2)
        of_file: Counter[str] = Counter()
        kinds: set[int] = set()
        for batch in file.batches(measure.window):
            rows, outlines, found = measure(batch)
            rows["id"] = np.arange(len(rows)) + counts["measured"]
            spool.add(rows, outlines)
            of_file += found
            counts["measured"] += len(rows)
            kinds |= set(shapely.get_type_id(batch).tolist())
            progress(f"{file.path.name}: {of_file['read']:,} read, {counts['measured']:,} buildings kept")
        _refuse_without_polygons(measure, of_file, kinds)
        counts += of_file
        stated = licence or file.licence or NOT_STATED
        records.append(SourceRecord(str(file.path), stated, _sha256(file.path), of_file["read"]))
    if counts["measured"] == 0:
        if region is not None and counts["small"] == 0:
            raise IngestError(f"no building {region}; check the latitude, longitude and extent")
        raise IngestError(f"no building of at least {min_area_m2:g} m2 in the footprints; lower min_area_m2")
    return Ingested(tuple(records), counts)


def _refuse_without_polygons(measure: _Measure, counts: Counter[str], kinds: set[int]) -> None:
    path = measure.source.file.path
    if counts["read"] == 0 and measure.window is None:
        raise _without_geometry(measure.source.file)
    if 0 < counts["read"] + counts["split"] == counts["empty"] + counts["not_polygon"]:
        names = sorted(shapely.GeometryType(kind).name.lower() for kind in kinds if kind >= 0)
        found = ", ".join(names) or "only empty geometries"
        raise IngestError(f"{path}: has no building polygon ({found}); give a file with polygons")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True)
class Reference:
    """All buildings of some sources in one UTM zone, and what became of everything read (see COUNTS)."""

    epsg: int
    buildings: Buildings
    counts: dict[str, int]


def read_buildings(sources: Sequence[Path], min_area_m2: float, region: Region | None = None) -> Reference:
    """Measure all buildings of the sources, or those of a region, in memory: for up to a few cities.

    Raises IngestError with one line when nothing usable is left.
    """
    opened = open_sources(sources)
    epsg = zone_of(opened, region)
    with tempfile.TemporaryDirectory(prefix="buildloc-") as folder:
        spool = Spool(Path(folder), CELL_M, len(sources) > 1)
        counts = ingest(opened, spool, epsg, region, min_area_m2, None, lambda _: None).counts
        boxes = [spool.box_m(tile) for tile in spool.tiles()]
        parts = list(windows(spool, overlapping_ids(spool), boxes, 0.0, counts))
    return Reference(epsg, concatenate(parts), {name: counts[name] for name in COUNTS})
