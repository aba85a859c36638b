"""Map files: building polygons in local metres (GeoJSON or GeoParquet), and trajectories in TUM format."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import geopandas as gpd
import numpy as np
import shapely
from buildloc_matcher.reference.ingest import polygons
from buildloc_matcher.reference.readers import PARQUET_SUFFIXES, open_file
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import footprints
from buildloc_msgs_py.types import Keyframe, LocalMap
from shapely.geometry import Polygon


class MapFileError(BuildlocError):
    """A map file cannot be used."""


def write_map(outlines: Sequence[Polygon], local_map: LocalMap, path: Path) -> None:
    """Write the buildings with how often each was observed; GeoParquet by suffix, GeoJSON otherwise."""
    if path.suffix.lower() in PARQUET_SUFFIXES:
        frame = gpd.GeoDataFrame({"observations": local_map.observations}, geometry=list(outlines), crs=None)
        frame.to_parquet(path)
        return
    features = [
        {
            "type": "Feature",
            "properties": {"observations": int(count)},
            "geometry": json.loads(shapely.to_geojson(outline)),
        }
        for outline, count in zip(outlines, local_map.observations, strict=True)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": None, "features": features}))


def read_map(path: Path) -> LocalMap:
    """Measure the polygons of a map file, this project's or any other; coordinates are taken as metres.

    Raises IngestError or MapFileError when there is nothing to use.
    """
    batches = [polygons(batch)[0] for batch in open_file(path).batches()]
    outlines = np.concatenate([np.empty(0, dtype=object), *batches])
    if len(outlines) == 0:
        raise MapFileError(f"{path}: has no building polygon; give a map file with polygons")
    found = footprints(outlines)
    ids = np.arange(len(outlines), dtype=np.int64)
    return LocalMap(0, ids, found.centroids_m, found.areas_m2, found.shapes, np.ones_like(ids))


def write_tum(keyframes: Sequence[Keyframe], path: Path) -> None:
    """``timestamp tx ty tz qx qy qz qw`` per keyframe, seconds and metres, in ``buildloc_map``."""
    lines = [
        f"{k.stamp_ns // 10**9}.{k.stamp_ns % 10**9:09d} {k.x_m:.4f} {k.y_m:.4f} 0 "
        f"0 0 {math.sin(k.yaw_rad / 2):.9f} {math.cos(k.yaw_rad / 2):.9f}"
        for k in keyframes
    ]
    path.write_text("\n".join(lines) + "\n")
