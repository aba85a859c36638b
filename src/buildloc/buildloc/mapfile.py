"""Map files: building polygons in local metres (GeoJSON or GeoParquet), and trajectories in TUM format."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pyarrow.parquet as pq
import pyogrio
import shapely
from buildloc_matcher.reference.ingest import polygons
from buildloc_matcher.reference.readers import GDAL_SUFFIXES, PARQUET_SUFFIXES, open_file
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import footprints
from buildloc_msgs_py.types import Keyframe, LocalMap
from numpy.typing import NDArray
from shapely.geometry import Polygon


class MapFileError(BuildlocError):
    """A map file cannot be used."""


def _columns(local_map: LocalMap) -> dict[str, NDArray[Any]]:
    covariances = local_map.covariances_m2
    return {
        "id": local_map.ids,
        "observations": local_map.observations,
        "covariance_xx": covariances[:, 0, 0],
        "covariance_xy": covariances[:, 0, 1],
        "covariance_yy": covariances[:, 1, 1],
        "cut": local_map.cut,
    }


def write_map(outlines: Sequence[Polygon], local_map: LocalMap, path: Path) -> None:
    """Write the buildings with their ids, times observed, covariances (m2) of their centroids, and whether
    they are cut by the border of the seen area; GeoParquet by suffix, GeoJSON otherwise."""
    columns = _columns(local_map)
    if path.suffix.lower() in PARQUET_SUFFIXES:
        gpd.GeoDataFrame(columns, geometry=list(outlines), crs=None).to_parquet(path)
        return
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    features = [
        {
            "type": "Feature",
            "properties": dict(zip(columns, row, strict=True)),
            "geometry": json.loads(shapely.to_geojson(outline)),
        }
        for outline, row in zip(outlines, rows, strict=True)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": None, "features": features}))


def read_map(path: Path) -> LocalMap:
    """Measure the polygons of a map file, this project's or any other; coordinates are taken as metres.

    What :func:`write_map` notes beside the polygons is taken over where all of it is there; other files'
    buildings are taken as whole, seen once. Raises IngestError or MapFileError when there is nothing to use.
    """
    batches = [polygons(batch)[0] for batch in open_file(path).batches()]
    outlines = np.concatenate([np.empty(0, dtype=object), *batches])
    if len(outlines) == 0:
        raise MapFileError(f"{path}: has no building polygon; give a map file with polygons")
    found = footprints(outlines)
    ids = np.arange(len(outlines), dtype=np.int64)
    local_map = LocalMap.whole(0, ids, found.centroids_m, found.areas_m2, found.shapes, np.ones_like(ids))
    noted = _noted(path, list(_columns(local_map)))
    # Polygons that had to be repaired or split are no longer those of the rows.
    if noted is None or len(noted) != len(outlines) or (noted.geometry.to_numpy() != outlines).any():
        return local_map
    xx, xy, yy = (noted[f"covariance_{name}"].to_numpy(dtype=np.float64) for name in ("xx", "xy", "yy"))
    return replace(
        local_map,
        ids=noted["id"].to_numpy(dtype=np.int64),
        observations=noted["observations"].to_numpy(dtype=np.int64),
        covariances_m2=np.column_stack([xx, xy, xy, yy]).reshape(-1, 2, 2),
        cut=noted["cut"].to_numpy(dtype=bool),
    )


def _noted(path: Path, columns: list[str]) -> gpd.GeoDataFrame | None:
    """The rows of a map file that has all of these columns."""
    if path.suffix.lower() in PARQUET_SUFFIXES:
        return gpd.read_parquet(path) if set(columns) <= set(pq.read_schema(path).names) else None
    if path.suffix.lower() not in GDAL_SUFFIXES:
        return None
    return gpd.read_file(path) if set(columns) <= set(pyogrio.read_info(path)["fields"]) else None


def write_tum(keyframes: Sequence[Keyframe], path: Path) -> None:
    """``timestamp tx ty tz qx qy qz qw`` per keyframe, seconds and metres, in ``buildloc_map``."""
    lines = [
        f"{k.stamp_ns // 10**9}.{k.stamp_ns % 10**9:09d} {k.x_m:.4f} {k.y_m:.4f} 0 "
        f"0 0 {math.sin(k.yaw_rad / 2):.9f} {math.cos(k.yaw_rad / 2):.9f}"
        for k in keyframes
    ]
    path.write_text("\n".join(lines) + "\n")
