"""The real footprints of greater Boston, in metres."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import shapely
from pyproj import Transformer

from buildloc_eval.paper.flights import EPSG, MIN_AREA_M2
from buildloc_eval.realworld import data_folder
from buildloc_eval.segmentation_errors import Outlines

FOOTPRINTS = "footprints/boston_osm.parquet"


def read_boston(path: Path | None = None) -> Outlines:
    """(N,) valid polygons of at least 20 m2, metres of EPSG. Raises DataError without the data."""
    degrees = gpd.read_parquet(path or data_folder() / FOOTPRINTS, columns=["geometry"]).geometry.to_numpy()
    to_utm = Transformer.from_crs(4326, EPSG, always_xy=True)
    metres = shapely.transform(degrees, lambda xy: np.column_stack(to_utm.transform(xy[:, 0], xy[:, 1])))
    usable = shapely.is_valid(metres) & (shapely.get_type_id(metres) == shapely.GeometryType.POLYGON)
    return np.asarray(metres[usable & (shapely.area(metres) >= MIN_AREA_M2)])
