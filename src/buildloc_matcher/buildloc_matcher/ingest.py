"""Building footprints from GeoJSON and GeoParquet, any CRS, into metres in one UTM zone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import footprint
from buildloc_msgs_py.types import FloatArray
from pyproj import CRS, Transformer

WGS84 = 4326
PARQUET_SUFFIXES = (".parquet", ".geoparquet", ".pq")


class IngestError(BuildlocError):
    """A footprint file cannot be used."""


@dataclass(frozen=True)
class Footprints:
    """N buildings in metres of a UTM zone: centroids (N, 2) east, north; areas (N,); shapes (N, 4).

    ``counts`` says what happened to the geometries read: used, repaired, not_polygon, empty, small,
    outside, unusable.
    """

    epsg: int
    centroids_m: FloatArray
    areas_m2: FloatArray
    shapes: FloatArray
    counts: dict[str, int]


def read_geometries(path: Path) -> gpd.GeoSeries:
    """The geometry column of a GeoJSON or GeoParquet file, with its CRS.

    Raises IngestError when the file is missing, unreadable or holds no geometry.
    """
    if not path.is_file():
        raise IngestError(
            f"{path}: no such footprint file; give a GeoJSON or GeoParquet of building polygons"
        )
    try:
        if path.suffix.lower() in PARQUET_SUFFIXES:
            frame = gpd.read_parquet(path)
        else:
            frame = gpd.read_file(path, columns=[])
        geometry = frame.geometry
    except Exception as error:
        line = str(error).strip().splitlines()
        raise IngestError(
            f"{path}: not a readable GeoJSON or GeoParquet footprint file "
            f"({type(error).__name__}: {line[0] if line else 'no detail'}); export it again"
        ) from error
    if len(geometry) == 0:
        raise IngestError(f"{path}: has no geometry at all; give a file with building polygons")
    return geometry


def polygons(geometry: gpd.GeoSeries, source: str) -> tuple[gpd.GeoSeries, dict[str, int]]:
    """Valid single polygons: invalid ones repaired, multi-polygons split, everything else counted.

    Raises IngestError when no polygon is left.
    """
    values = geometry.to_numpy()
    empty = shapely.is_missing(values) | shapely.is_empty(values)
    invalid = ~shapely.is_valid(values) & ~empty
    values = np.where(invalid, shapely.make_valid(values), values)[~empty]
    for _ in range(2):  # a collection made by the repair may hold multi-polygons
        values = shapely.get_parts(values)
    kinds = shapely.get_type_id(values)
    keep = (kinds == shapely.GeometryType.POLYGON) & (shapely.area(values) > 0.0)
    counts = {
        "read": len(geometry),
        "empty": int(empty.sum()),
        "repaired": int(invalid.sum()),
        "not_polygon": int((~keep).sum()),
    }
    if not keep.any():
        found = sorted({str(g.geom_type) for g in values}) or ["only empty geometries"]
        raise IngestError(
            f"{source}: has no building polygon ({', '.join(found)}); give a file with polygons"
        )
    return gpd.GeoSeries(values[keep], crs=geometry.crs), counts


def in_wgs84(outlines: gpd.GeoSeries, source: str) -> gpd.GeoSeries:
    """The outlines in degrees; raises IngestError for a missing CRS or impossible coordinates."""
    if outlines.crs is None:
        raise IngestError(f"{source}: states no coordinate reference system; set its CRS and export it again")
    degrees = outlines.to_crs(WGS84)
    west, south, east, north = degrees.total_bounds
    if not (-180.0 <= west <= east <= 180.0 and -90.0 <= south <= north <= 90.0):
        raise IngestError(f"{source}: coordinates do not fit its CRS {outlines.crs.name}; correct the CRS")
    return degrees


def utm_epsg(longitude_deg: float, latitude_deg: float) -> int:
    """EPSG code of the WGS84 UTM zone of a position."""
    zone = min(60, int((longitude_deg + 180.0) // 6.0) + 1)
    return (32600 if latitude_deg >= 0.0 else 32700) + zone


def ingest(
    sources: Sequence[Path],
    min_area_m2: float,
    center_deg: tuple[float, float] | None = None,
    radius_km: float | None = None,
) -> Footprints:
    """Measure all buildings of the sources, or those within ``radius_km`` of ``center_deg`` (lat, lon).

    Raises IngestError with one line when nothing usable is left.
    """
    if not sources:
        raise IngestError("no footprint file given; name at least one GeoJSON or GeoParquet file")
    if radius_km is not None and not radius_km > 0.0:
        raise IngestError(f"radius of {radius_km:g} km is not positive; give the search radius in km")
    counts: dict[str, int] = {}
    parts = []
    for source in sources:
        outlines, counted = polygons(read_geometries(Path(source)), str(source))
        parts.append(in_wgs84(outlines, str(source)))
        counts = {name: counts.get(name, 0) + count for name, count in counted.items()}
    degrees = gpd.GeoSeries(pd.concat(parts, ignore_index=True), crs=WGS84)
    if center_deg is None:
        west, south, east, north = degrees.total_bounds
        center_deg = ((south + north) / 2.0, (west + east) / 2.0)
    epsg = utm_epsg(center_deg[1], center_deg[0])
    metric = degrees.to_crs(epsg).to_numpy()
    if radius_km is not None:
        origin = Transformer.from_crs(CRS(WGS84), CRS(epsg), always_xy=True).transform(
            center_deg[1], center_deg[0]
        )
        middle = shapely.get_coordinates(shapely.centroid(metric))
        inside = np.hypot(middle[:, 0] - origin[0], middle[:, 1] - origin[1]) <= radius_km * 1000.0
        counts["outside"] = int((~inside).sum())
        metric = metric[inside]
        if len(metric) == 0:
            raise IngestError(
                f"no building within {radius_km:g} km of {center_deg[0]:.5f}, {center_deg[1]:.5f}; "
                "check the centre (latitude, longitude) and the radius"
            )
    large = shapely.area(metric) >= min_area_m2
    counts["small"] = int((~large).sum())
    rows, unusable = [], 0
    for outline in metric[large]:
        try:
            measured = footprint(outline)
        except BuildlocError:
            unusable += 1
            continue
        rows.append((measured.x_m, measured.y_m, measured.area_m2, *measured.shape))
    counts["unusable"] = unusable
    if not rows:
        raise IngestError(f"no building of at least {min_area_m2:g} m2 in the footprints; lower min_area_m2")
    table = np.array(rows, dtype=np.float64)
    counts["used"] = len(table)
    return Footprints(epsg, table[:, :2].copy(), table[:, 2].copy(), table[:, 3:].copy(), counts)
