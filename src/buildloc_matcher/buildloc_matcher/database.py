"""The reference database: one Arrow IPC file with the buildings, their stars and what made them."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import SHAPE_METRICS
from buildloc_msgs_py.types import FloatArray
from pyproj import CRS, Transformer
from scipy.spatial import cKDTree

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.descriptors import DESCRIPTOR_VERSION, STAR_FEATURES, Stars, stars
from buildloc_matcher.matching import StarIndex, index_stars
from buildloc_matcher.reference.ingest import read_buildings
from buildloc_matcher.reference.region import WGS84, Circle

FORMAT = "buildloc-reference"
FORMAT_VERSION = 1
MAGIC = b"ARROW1"
REBUILD = "build it again with `buildloc refdb build`"
WIDTHS = {"centroids_m": 2, "areas_m2": 1, "shapes": 4, "features": STAR_FEATURES, "triangles": 3}


class DatabaseError(BuildlocError):
    """A reference database cannot be used."""


class DatabaseMissingError(DatabaseError):
    """There is no such file."""


@dataclass(frozen=True)
class ReferenceDatabase:
    """Buildings (N) in metres of UTM zone ``epsg`` (x east, y north) and their star descriptors (S)."""

    epsg: int
    centroids_m: FloatArray
    areas_m2: FloatArray
    shapes: FloatArray
    stars: Stars
    descriptor_hash: str

    def __len__(self) -> int:
        return len(self.centroids_m)

    @cached_property
    def tree(self) -> cKDTree:
        """KD-tree over the centroids."""
        return cKDTree(self.centroids_m)

    @cached_property
    def index(self) -> StarIndex:
        """Stars sorted for matching."""
        return index_stars(self.stars)

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
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
    settings = {"descriptor": DESCRIPTOR_VERSION, "shapes": SHAPE_METRICS, "min_area_m2": config.min_area_m2}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def assemble(
    epsg: int, centroids_m: FloatArray, areas_m2: FloatArray, shapes: FloatArray, config: MatcherConfig
) -> ReferenceDatabase:
    """A database from measured buildings."""
    return ReferenceDatabase(
        epsg, centroids_m, areas_m2, shapes, stars(centroids_m, shapes), descriptor_hash(config)
    )


def build(
    sources: Sequence[Path],
    config: MatcherConfig,
    center_deg: tuple[float, float] | None = None,
    radius_km: float | None = None,
) -> ReferenceDatabase:
    """Read footprints and describe them; ``center_deg`` is (latitude, longitude)."""
    region = None if center_deg is None or radius_km is None else Circle(*center_deg, radius_km)
    found = read_buildings(sources, config.min_area_m2, region)
    buildings = found.buildings
    areas_m2, shapes = buildings.areas_m2.astype(np.float64), buildings.shapes.astype(np.float64)
    return assemble(found.epsg, buildings.centroids_m, areas_m2, shapes, config)


def save(database: ReferenceDatabase, path: Path) -> None:
    """Write the file under a temporary name beside ``path``, then rename: never half a database."""
    columns = {
        "centroids_m": database.centroids_m,
        "areas_m2": database.areas_m2,
        "shapes": database.shapes,
        "features": database.stars.features,
        "triangles": database.stars.triangles,
    }
    meta = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "epsg": database.epsg,
        "descriptor_hash": database.descriptor_hash,
        "bounds_m": database.bounds_m,
        "buildings": len(database),
        "stars": len(database.stars),
    }
    arrays = [
        pa.LargeListArray.from_arrays(pa.array([0, values.size], pa.int64()), pa.array(values.reshape(-1)))
        for values in columns.values()
    ]
    table = pa.table(dict(zip(columns, arrays, strict=True))).replace_schema_metadata(
        {FORMAT: json.dumps(meta)}
    )
    path = Path(path)
    if not path.parent.is_dir():
        raise DatabaseError(f"{path}: the folder {path.parent} does not exist; make it first")
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            with pa.ipc.new_file(file, table.schema) as writer:
                writer.write_table(table)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def open_database(path: Path, config: MatcherConfig) -> ReferenceDatabase:
    """Read a database made with the same descriptor configuration.

    Raises DatabaseMissingError, or DatabaseError for a file that is foreign, truncated, of another version
    or of another descriptor configuration.
    """
    path = Path(path)
    if not path.is_file():
        raise DatabaseMissingError(f"{path}: no such reference database; {REBUILD}")
    with path.open("rb") as file:
        head = file.read(len(MAGIC))
    if head != MAGIC:
        raise DatabaseError(f"{path}: is not a buildloc reference database; {REBUILD}")
    try:
        table = pa.ipc.open_file(path.read_bytes()).read_all()
    except (pa.ArrowException, OSError) as error:
        raise DatabaseError(f"{path}: reference database is truncated or damaged; {REBUILD}") from error
    metadata = table.schema.metadata or {}
    try:
        meta = json.loads(metadata[FORMAT.encode()])
        version = meta["version"]
    except (KeyError, ValueError, TypeError) as error:
        raise DatabaseError(
            f"{path}: is an Arrow file but not a buildloc reference database; {REBUILD}"
        ) from error
    if version != FORMAT_VERSION:
        raise DatabaseError(
            f"{path}: reference database has version {version}, not {FORMAT_VERSION}; {REBUILD}"
        )
    if meta.get("descriptor_hash") != descriptor_hash(config):
        raise DatabaseError(
            f"{path}: reference database was built with another descriptor configuration "
            f"({meta.get('descriptor_hash')}, not {descriptor_hash(config)}); {REBUILD}"
        )
    try:
        flat = {name: np.asarray(table.column(name)[0].values) for name in WIDTHS}
        rows = {
            name: (values if WIDTHS[name] == 1 else values.reshape(-1, WIDTHS[name]))
            for name, values in flat.items()
        }
        epsg, buildings, count = int(meta["epsg"]), int(meta["buildings"]), int(meta["stars"])
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise DatabaseError(f"{path}: reference database is truncated or damaged; {REBUILD}") from error
    whole = all(len(rows[n]) == buildings for n in ("centroids_m", "areas_m2", "shapes"))
    if not whole or len(rows["features"]) != count or len(rows["triangles"]) != count or buildings == 0:
        raise DatabaseError(f"{path}: reference database is truncated or damaged; {REBUILD}")
    return ReferenceDatabase(
        epsg,
        rows["centroids_m"],
        rows["areas_m2"],
        rows["shapes"],
        Stars(rows["features"], rows["triangles"]),
        str(meta["descriptor_hash"]),
    )
