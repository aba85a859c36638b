"""Real ground for the whole method: the Barnarp orthophoto set into the Lexington part of Boston.

Barnarp's outlines are moved rigidly (one translation in metres, no scaling) into a hole cut into the
surrounding footprints, so that a flight over real imagery meets a reference of tens of thousands of
buildings that it did not choose.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from buildloc_msgs_py.errors import BuildlocError
from pyproj import CRS, Transformer
from shapely import affinity

from buildloc_eval.world import to_utm

LEXINGTON_DEG = (42.447, -71.225)
RADIUS_KM = 6.0
HOLE_MARGIN_M = 10.0
DATA_VARIABLE = "BUILDLOC_DATA"


class DataError(BuildlocError):
    """Data that an evaluation needs is absent."""


def data_folder() -> Path:
    """The folder of the real data. Raises DataError when it is absent."""
    folder = Path(os.environ.get(DATA_VARIABLE, "../shared/data"))
    if not (folder / "footprints").is_dir():
        raise DataError(
            f"{folder}: no data here; set {DATA_VARIABLE} to the folder with footprints/ and imagery/"
        )
    return folder


@dataclass(frozen=True)
class Ground:
    """Reference footprints with the orthophoto's buildings set in, and the orthophoto's placement."""

    footprints: Path
    georef: Path
    ortho: Path
    buildings: int


def place_barnarp(data: Path, out: Path, radius_km: float = RADIUS_KM) -> Ground:
    """Write reference.parquet and georef.json under ``out``."""
    barnarp = data / "imagery" / "barnarp"
    nominal = json.loads((barnarp / "georef.json").read_text())
    gsd, width, height = nominal["gsd_m"], nominal["width_px"], nominal["height_px"]
    local = CRS.from_proj4(
        f"+proj=aeqd +lat_0={nominal['origin_lat_deg']} +lon_0={nominal['origin_lon_deg']} +units=m"
    )
    outlines = gpd.read_file(barnarp / "footprints.geojson").geometry.to_crs(local)
    epsg, east, north = to_utm(*LEXINGTON_DEG)
    left, top = east - width * gsd / 2.0, north + height * gsd / 2.0
    moved = gpd.GeoSeries([affinity.translate(g, left, top) for g in outlines], crs=epsg)
    degrees = radius_km / 111.0
    lat, lon = LEXINGTON_DEG
    stretch = degrees / np.cos(np.radians(lat))
    boston = gpd.read_parquet(data / "footprints" / "boston_osm.parquet", columns=["geometry"]).geometry
    around = boston.cx[lon - stretch : lon + stretch, lat - degrees : lat + degrees].to_crs(epsg)
    centre = shapely.Point(east, north)
    inside = shapely.distance(shapely.centroid(around.to_numpy()), centre) <= radius_km * 1e3
    hole = shapely.box(left, top - height * gsd, left + width * gsd, top).buffer(HOLE_MARGIN_M)
    kept = around[inside & ~shapely.intersects(around.to_numpy(), hole)]
    out.mkdir(parents=True, exist_ok=True)
    everything = gpd.GeoSeries(pd.concat([kept, moved], ignore_index=True), crs=epsg).to_crs(4326)
    footprints, georef = out / "reference.parquet", out / "georef.json"
    gpd.GeoDataFrame(geometry=everything).to_parquet(footprints)
    longitude, latitude = Transformer.from_crs(epsg, 4326, always_xy=True).transform(left, top)
    placed = {"origin_lat_deg": latitude, "origin_lon_deg": longitude, "gsd_m": gsd}
    georef.write_text(json.dumps(placed) + "\n")
    return Ground(footprints, georef, barnarp / "ortho.jpg", len(everything))
