"""Real footprints, in metres."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import shapely
from buildloc_matcher.reference.buildings import Buildings, stored_outlines
from buildloc_msgs_py.footprint import footprints
from pyproj import Transformer

from buildloc_eval.paper.flights import EPSG, MIN_AREA_M2
from buildloc_eval.realworld import data_folder
from buildloc_eval.segmentation_errors import Outlines

FOOTPRINTS = "footprints/boston_osm.parquet"


def read_boston(path: Path | None = None) -> Outlines:
    """Greater Boston, metres of EPSG, as :func:`read_outlines`."""
    return read_outlines(path or data_folder() / FOOTPRINTS, EPSG)


def read_outlines(path: Path, epsg: int) -> Outlines:
    """(N,) polygons fit for use, metres of a UTM zone. Raises DataError without the data."""
    degrees = gpd.read_parquet(path, columns=["geometry"]).geometry.to_numpy()
    to_utm = Transformer.from_crs(4326, epsg, always_xy=True)
    return usable(
        shapely.transform(degrees, lambda xy: np.column_stack(to_utm.transform(xy[:, 0], xy[:, 1])))
    )


def usable(outlines: Outlines) -> Outlines:
    """The valid polygons of at least 20 m2 (outlines in metres)."""
    valid = shapely.is_valid(outlines) & (shapely.get_type_id(outlines) == shapely.GeometryType.POLYGON)
    return np.asarray(outlines[valid & (shapely.area(outlines) >= MIN_AREA_M2)])


def measure(outlines: Outlines) -> Buildings:
    """The outlines as a reference has them."""
    found = footprints(outlines)
    areas, shapes = found.areas_m2.astype(np.float32), found.shapes.astype(np.float32)
    return Buildings(found.centroids_m, areas, shapes, stored_outlines(outlines, found.centroids_m))
