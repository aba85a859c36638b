"""Real orthophotos with the building outlines that were drawn on them: what flights are cut out of."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import geopandas as gpd
import numpy as np
import shapely
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import ByteArray
from numpy.typing import NDArray
from pyproj import CRS

from buildloc_eval.world import Box, PictureWorld, to_utm

BANEPA_ZOOM, BANEPA_TILE_PX = 19, 512
BANEPA_TILE = re.compile(r"OAM-(\d+)-(\d+)-19\.jpg")
EQUATOR_M = 2.0 * math.pi * 6378137.0
AROUND_M = 250.0
JOINED_M = 0.25  # outlines nearer than this are one building in a mask


@dataclass(frozen=True)
class LabelledGround:
    """An orthophoto and its building outlines, UTM metres, as if the zone were a plane.

    ``labels`` is 255 on buildings. ``outlines`` (M,) polygons as they were drawn; ``buildings`` (N,): those
    that touch are one.
    """

    name: str
    picture: PictureWorld
    labels: PictureWorld
    buildings: NDArray[np.object_]
    outlines: NDArray[np.object_]

    def flown_m(self) -> Box:
        """Where flights go: not farther than ``AROUND_M`` from what is labelled."""
        west, south, east, north = shapely.total_bounds(self.buildings).tolist()
        left, bottom, right, top = self.picture.bounds_m
        return (
            max(left, west - AROUND_M), max(bottom, south - AROUND_M),
            min(right, east + AROUND_M), min(top, north + AROUND_M),
        )  # fmt: skip


def barnarp(data: Path) -> LabelledGround:
    """A Swedish suburb, all of it labelled. Raises BuildlocError when it is absent."""
    folder = data / "imagery" / "barnarp"
    image = _read(folder / "ortho.jpg")
    placed = json.loads((folder / "georef.json").read_text())
    latitude, longitude = placed["origin_lat_deg"], placed["origin_lon_deg"]
    local = CRS.from_proj4(f"+proj=aeqd +lat_0={latitude} +lon_0={longitude} +units=m")
    outlines = gpd.read_file(folder / "footprints.geojson").geometry.to_crs(local).to_numpy()
    # The picture lies in the plane of its nominal placement: y is minus the way down from its top.
    pixels = shapely.transform(outlines, lambda xy: xy * [1.0, -1.0] / placed["gsd_m"])
    return _ground("barnarp", image, to_utm(latitude, longitude), placed["gsd_m"], pixels)


def banepa(data: Path) -> LabelledGround:
    """A dense town in Nepal, put together from its tiles; the 48 in the middle are labelled.

    Raises BuildlocError when it is absent.
    """
    folder = data / "imagery" / "banepa_ortho"
    tiles = {
        (int(found[1]), int(found[2])): path
        for path in sorted((folder / "tiles").glob("*.jpg"))
        if (found := BANEPA_TILE.fullmatch(path.name))
    }
    if not tiles:
        raise BuildlocError(f"{folder}: no tiles here; set BUILDLOC_DATA to the folder of the data")
    at = np.array(sorted(tiles))
    (left, top), (columns, rows) = at.min(axis=0), np.ptp(at, axis=0) + 1
    side = BANEPA_TILE_PX
    image = np.zeros((rows * side, columns * side, 3), dtype=np.uint8)
    for (x, y), path in tiles.items():
        row, column = (y - top) * side, (x - left) * side
        image[row : row + side, column : column + side] = _read(path)
    world = 2**BANEPA_ZOOM
    longitude = left / world * 360.0 - 180.0
    latitude, middle = (
        math.degrees(math.atan(math.sinh(math.pi * (1.0 - 2.0 * y / world)))) for y in (top, top + rows / 2.0)
    )
    mercator_px = EQUATOR_M / world / side
    outlines = gpd.read_file(folder / "labels.geojson").geometry.to_crs(3857).to_numpy()
    origin = np.array([left / world - 0.5, 0.5 - top / world]) * EQUATOR_M
    pixels = shapely.transform(outlines, lambda xy: (xy - origin) * [1.0, -1.0] / mercator_px)
    gsd = mercator_px * math.cos(math.radians(middle))
    return _ground("banepa_ortho", image, to_utm(latitude, longitude), gsd, pixels)


def _read(path: Path) -> ByteArray:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise BuildlocError(f"{path}: no image here; set BUILDLOC_DATA to the folder of the data")
    return np.asarray(image, dtype=np.uint8)


def _ground(
    name: str, image: ByteArray, placed: tuple[int, float, float], gsd_m: float, outlines: NDArray[np.object_]
) -> LabelledGround:
    """Ground of a picture and outlines (N,) in its pixels, u to the right and v down from its corner."""
    epsg, left_m, top_m = placed
    parts = shapely.get_parts(outlines)
    parts = parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON]
    labels = np.zeros(image.shape[:2], dtype=np.uint8)
    rings = [shapely.get_coordinates(part.exterior) - 0.5 for part in parts]
    cv2.fillPoly(labels, [np.round(ring * 16).astype(np.int32) for ring in rings], 255, cv2.LINE_8, 4)
    metres = shapely.transform(parts, lambda uv: uv * [gsd_m, -gsd_m] + [left_m, top_m])
    joined = shapely.buffer(shapely.union_all(shapely.buffer(metres, JOINED_M)), -JOINED_M)
    world = (epsg, left_m, top_m, gsd_m)
    return LabelledGround(
        name, PictureWorld(image, *world), PictureWorld(labels, *world), shapely.get_parts(joined), metres
    )
