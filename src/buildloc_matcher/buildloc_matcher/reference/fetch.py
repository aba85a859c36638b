"""Building footprints of an area from Microsoft or Overture: just the parts needed, each with its licence."""

from __future__ import annotations

import contextlib
import csv
import gzip
import io
import json
import math
import re
import socket
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import mercantile
import pyarrow as pa
import pyarrow.compute as pc
from overturemaps.core import get_latest_release, record_batch_reader
from overturemaps.writers import get_writer

from buildloc_matcher.reference.download import (
    AGAIN,
    PART,
    FetchError,
    HttpConfig,
    Progress,
    Record,
    download,
    finish,
    intact,
    open_session,
    read_manifest,
    today,
)
from buildloc_matcher.reference.region import Circle

LEVEL = 9  # of the quadkeys that Microsoft files its buildings under
EARTH_RADIUS_KM = 6371.0
MARGIN_KM = 0.5  # a building is filed where one point of it lies, and the sphere is no ellipsoid
SPHERE_ERROR = 0.006

# Every release has an index of its own; the newest that was known when this was written.
MICROSOFT_INDEX = "https://bfppub.blob.core.windows.net/%24web/2026-08-13/dataset-links.csv"
MICROSOFT_PAGE = "https://github.com/microsoft/GlobalMLBuildingFootprints"
MICROSOFT_COLUMNS = {"Location", "QuadKey", "Url", "Size"}
MICROSOFT_RELICENSED = "2026-03-11"
UNITS = {"B": 1.0, "KB": 1e3, "MB": 1e6, "GB": 1e9}
OVERTURE_LICENCE = "ODbL-1.0, OpenStreetMap contributors and Overture Maps Foundation"
OVERTURE_BUILDINGS = "s3://overturemaps-us-west-2/release/{release}/theme=buildings/type=building/"
LONGEST_FEATURE = 1 << 24  # bytes of a line, beyond every real building

Box = tuple[float, float, float, float]  # west, south, east, north in degrees


@dataclass(frozen=True)
class Fetched:
    """A finished file; ``fresh`` if this run brought it, ``doubt`` if its size is not what the index says."""

    path: Path
    size: int
    licence: str
    fresh: bool
    doubt: str | None = None


@dataclass(frozen=True)
class Link:
    """A row of Microsoft's index."""

    location: str
    quadkey: str
    url: str
    size: str


def _reach_km(area: Circle) -> float:
    """Radius with everything that makes it uncertain."""
    return area.radius_km * (1.0 + SPHERE_ERROR) + MARGIN_KM


def _wrap(longitude_deg: float) -> float:
    return (longitude_deg + 180.0) % 360.0 - 180.0


def _spans(area: Circle) -> tuple[float, float, float]:
    """South, north and half width in degrees of the box around the circle."""
    angle = min(_reach_km(area) / EARTH_RADIUS_KM, math.pi)
    south, north = area.latitude_deg - math.degrees(angle), area.latitude_deg + math.degrees(angle)
    if south <= -90.0 or north >= 90.0:  # a pole is inside
        return south, north, 360.0
    width = math.asin(math.sin(angle) / math.cos(math.radians(area.latitude_deg)))
    return south, north, math.degrees(width)


def _offset(area: Circle, tile: Any) -> tuple[Any, float]:
    """Bounds of a tile and how far its west edge lies east of the centre, degrees."""
    bounds = mercantile.bounds(tile)
    return bounds, _wrap(bounds.west - area.longitude_deg)


def _touches(area: Circle, tile: Any) -> bool:
    bounds, west = _offset(area, tile)
    longitude = math.radians(min(max(0.0, west), west + bounds.east - bounds.west))
    here = math.radians(area.latitude_deg)
    there = math.radians(min(max(area.latitude_deg, bounds.south), bounds.north))
    haversine = (
        math.sin((there - here) / 2.0) ** 2
        + math.cos(here) * math.cos(there) * math.sin(longitude / 2.0) ** 2
    )
    return 2.0 * EARTH_RADIUS_KM * math.asin(math.sqrt(min(haversine, 1.0))) <= _reach_km(area)


def quadkeys(area: Circle) -> list[str]:
    """Level 9 tiles that the circle touches, across the 180th meridian too."""
    south, north, width = _spans(area)
    west, east = area.longitude_deg - width, area.longitude_deg + width
    box = (-180.0, 180.0) if width >= 180.0 else (_wrap(west), _wrap(east))
    tiles = mercantile.tiles(box[0], south, box[1], north, zooms=LEVEL)
    return sorted({str(mercantile.quadkey(tile)) for tile in tiles if _touches(area, tile)})


def part_of(area: Circle, quadkey: str) -> Box:
    """The part of a tile inside the box around the circle."""
    south, north, width = _spans(area)
    bounds, west = _offset(area, mercantile.quadkey_to_tile(quadkey))
    east = west + bounds.east - bounds.west
    # An edge that is not cut keeps its exact value, so that neighbours share it.
    return (
        bounds.west if west >= -width else _wrap(area.longitude_deg - width),
        max(bounds.south, south),
        bounds.east if east <= width else _wrap(area.longitude_deg + width),
        min(bounds.north, north),
    )


def index_fault(path: Path) -> str | None:
    """What makes a file something else than Microsoft's index."""
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        columns = set(next(csv.reader([file.readline(1000)]), []))
    if columns >= MICROSOFT_COLUMNS:
        return None
    return f"not an index of Microsoft footprints; see {MICROSOFT_PAGE} and give its address with --index-url"


def tile_fault(path: Path) -> str | None:
    """What makes a file something else than intact gzipped GeoJSON lines."""
    try:
        with gzip.open(path) as file:
            first = file.readline(LONGEST_FEATURE)
            while file.read(1 << 20):  # to the end, where the checksum is
                pass
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        return f"wrong content, no intact gzip file ({error}); try later, or check for a proxy in between"
    try:
        feature = json.loads(first)
        right = feature["type"] == "Feature" and "coordinates" in feature["geometry"]
    except (ValueError, KeyError, TypeError):
        right = False
    return None if right else "wrong content, no GeoJSON features; try later or another --source"


def links(index: Path, wanted: set[str]) -> list[Link]:
    """The rows for the tiles; a tile on a border is listed once for each country, and all are needed."""
    found: dict[str, Link] = {}
    with index.open(encoding="utf-8", errors="replace", newline="") as file:
        for row in csv.DictReader(file):
            # Some releases dropped the zeros that a quadkey starts with.
            quadkey = (row["QuadKey"] or "").zfill(LEVEL)
            if quadkey in wanted and row["Url"]:
                found[row["Url"]] = Link(row["Location"] or "", quadkey, row["Url"], row["Size"] or "")
    return sorted(found.values(), key=lambda link: (link.quadkey, link.location, link.url))


def file_names(rows: list[Link]) -> list[str]:
    """One name for each row, of harmless characters and all different."""
    names: list[str] = []
    for row in rows:
        stem = f"microsoft_{row.quadkey}_{re.sub(r'[^A-Za-z0-9]+', '', row.location)}"
        same = sum(name.split(".")[0].split("-")[0] == stem for name in names)
        names.append(f"{stem}-{same + 1}.csv.gz" if same else f"{stem}.csv.gz")
    return names


def microsoft_licence(url: str) -> str:
    """The licence of the release a file belongs to; the stricter one if its address does not say."""
    release = re.search(r"/(\d{4}-\d\d-\d\d)/", url)
    newer = release is not None and release[1] >= MICROSOFT_RELICENSED
    return f"{'CDLA-Permissive-2.0' if newer else 'ODbL-1.0'}, Microsoft Global ML Building Footprints"


def size_doubt(size: int, listed: str) -> str | None:
    """A warning when a file is not about as large as the index says ("23.1MB", rounded)."""
    found = re.fullmatch(r"([\d.]+)\s*([KMG]?B)", listed.strip())
    if found is None or 0.5 <= size / max(float(found[1]) * UNITS[found[2]], 1.0) <= 2.0:
        return None
    return f"has {size} bytes where the index says {listed}; compare with {MICROSOFT_PAGE}"


def _folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FetchError(f"{path}: cannot be a folder ({error.strerror}); choose another --out") from error


def fetch_microsoft(
    area: Circle, folder: Path, index_url: str, config: HttpConfig, progress: Progress
) -> list[Fetched]:
    """Microsoft's files for the area, in ``folder``.

    Raises FetchError; what has arrived by then stays for the next run.
    """
    _folder(folder)
    index = folder / "dataset-links.csv"
    licence = microsoft_licence(index_url)
    done: list[Fetched] = []
    with open_session() as session:
        download(session, index_url, index, licence, index_fault, config, progress)
        rows = links(index, set(quadkeys(area)))
        if not rows:
            raise FetchError(
                f"Microsoft lists no buildings {area}; check the centre (latitude, longitude), "
                "or take --source overture"
            )
        for number, (row, name) in enumerate(zip(rows, file_names(rows), strict=True), start=1):
            path, licence = folder / name, microsoft_licence(row.url)
            fresh = download(
                session, row.url, path, licence, tile_fault, config,
                _behind(f"file {number} of {len(rows)}, ", progress),
            )  # fmt: skip
            size = path.stat().st_size
            done.append(Fetched(path, size, licence, fresh, size_doubt(size, row.size)))
    return done


def _behind(prefix: str, progress: Progress) -> Progress:
    return lambda text: progress(prefix + text)


class OvertureClient(Protocol):
    """What is used of Overture."""

    def latest_release(self) -> str:
        """Name of the newest release."""

    def buildings(self, box: Box, release: str) -> pa.RecordBatchReader | None:
        """Buildings whose bounding boxes meet ``box``; None if there are none."""


@dataclass(frozen=True)
class OvertureMaps:
    """The client of the Overture Maps Foundation, which reads its public bucket."""

    timeout_s: float = 30.0

    def latest_release(self) -> str:
        """Name of the newest release."""
        with self._tamed():
            return str(get_latest_release())

    def buildings(self, box: Box, release: str) -> pa.RecordBatchReader | None:
        """Buildings whose bounding boxes meet ``box``; None if there are none."""
        said = io.StringIO()
        with self._tamed(), contextlib.redirect_stdout(said):
            reader = record_batch_reader(
                "building", box, release, self.timeout_s, self.timeout_s, stac=True
            )  # fmt: skip
        if reader is None and "No data found" not in said.getvalue():  # it prints its errors
            raise OSError(" ".join(said.getvalue().split()) or "no reason given")
        return reader

    @contextlib.contextmanager
    def _tamed(self) -> Iterator[None]:
        """The client opens its catalogue without a time limit."""
        before = socket.getdefaulttimeout()
        socket.setdefaulttimeout(self.timeout_s)
        try:
            yield
        finally:
            socket.setdefaulttimeout(before)


@contextlib.contextmanager
def _overture_errors() -> Iterator[None]:
    # The client raises bare Exceptions, and pyarrow many kinds below it.
    try:
        yield
    except Exception as error:
        line = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise FetchError(f"Overture: {line}; check that this machine is online, then {AGAIN}") from error


def fetch_overture(area: Circle, folder: Path, client: OvertureClient, progress: Progress) -> list[Fetched]:
    """Overture's newest buildings of the area as GeoParquet, one file for each level 9 tile with buildings.

    A tile is the unit that is not fetched again; a tile that was interrupted begins anew.
    """
    _folder(folder)
    with _overture_errors():
        release = client.latest_release()
    done: list[Fetched] = []
    keys = quadkeys(area)
    for number, quadkey in enumerate(keys, start=1):
        box = part_of(area, quadkey)
        url = f"{OVERTURE_BUILDINGS.format(release=release)}?bbox={','.join(f'{v:.7f}' for v in box)}"
        where = f"{area.latitude_deg:.5f}_{area.longitude_deg:.5f}_{area.radius_km:g}km"
        path = folder / f"overture_{where}_{quadkey}.parquet"
        fresh = not intact(path, read_manifest(folder).get(path.name), url)
        if fresh:
            part = path.with_name(path.name + PART)
            progress(f"tile {number} of {len(keys)}")
            try:
                with _overture_errors():
                    rows = _write_tile(
                        client.buildings(box, release), box, part,
                        _behind(f"tile {number} of {len(keys)}, ", progress),
                    )  # fmt: skip
                if rows == 0:
                    continue
                finish(part, path, Record(url, OVERTURE_LICENCE, today()))
            finally:
                part.unlink(missing_ok=True)  # Parquet cannot be resumed
        done.append(Fetched(path, path.stat().st_size, OVERTURE_LICENCE, fresh))
    if not done:
        raise FetchError(
            f"Overture has no buildings {area} in release {release}; check the centre (latitude, longitude), "
            "or take --source microsoft"
        )
    return done


def _write_tile(reader: pa.RecordBatchReader | None, box: Box, part: Path, progress: Progress) -> int:
    """Write the buildings whose south-west corner lies in ``box``, so that no two tiles have the same one."""
    if reader is None:
        return 0
    rows = 0
    with contextlib.ExitStack() as stack:
        writer = None
        for batch in reader:
            kept = batch.filter(_starts_in(batch.column("bbox"), box))
            if kept.num_rows == 0:
                continue
            if writer is None:
                writer = stack.enter_context(get_writer("geoparquet", str(part), reader.schema))
            writer.write_batch(kept)
            rows += kept.num_rows
            progress(f"{rows} buildings")
    return rows


def _starts_in(corners: pa.StructArray, box: Box) -> pa.BooleanArray:
    west, south, east, north = box
    x, y = (pc.cast(pc.struct_field(corners, name), pa.float64()) for name in ("xmin", "ymin"))
    inside_x = pc.and_(pc.greater_equal(x, west), pc.less(x, east))
    return pc.and_(inside_x, pc.and_(pc.greater_equal(y, south), pc.less(y, north)))
