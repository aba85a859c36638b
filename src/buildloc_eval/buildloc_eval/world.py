"""Worlds seen from above: an orthophoto, or a rendered town over footprints.

Metres are UTM east and north.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import geopandas as gpd
import numpy as np
import shapely
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.geodesy import utm_epsg
from buildloc_msgs_py.types import ByteArray, FloatArray
from numpy.typing import NDArray
from pyproj import Transformer

Box = tuple[float, float, float, float]  # west, south, east, north, m
RENDERED_GSD_M = 0.15
GRASS, SOIL = np.array([62.0, 96.0, 84.0]), np.array([96.0, 120.0, 134.0])  # BGR
ROOFS = np.array(
    [[70, 86, 150], [92, 104, 160], [118, 120, 126], [86, 84, 90], [150, 152, 160], [84, 96, 124]]
)


class WorldError(BuildlocError):
    """A world cannot be made from what was given."""


@dataclass(frozen=True)
class Window:
    """A north-up picture of a part of the world: (H, W, 3) BGR with its outer top-left corner."""

    image_bgr: ByteArray
    left_m: float
    top_m: float
    gsd_m: float


class Surface(Protocol):
    """Ground that can be photographed, in metres east and north of anywhere."""

    @property
    def bounds_m(self) -> Box:
        """What there is to see."""

    def window(self, box_m: Box) -> Window:
        """At least the part of the box that lies within the bounds; raises WorldError outside."""


class World(Surface, Protocol):
    """A surface that has its place on Earth."""

    @property
    def epsg(self) -> int:
        """UTM zone of all coordinates."""


def to_utm(latitude_deg: float, longitude_deg: float) -> tuple[int, float, float]:
    """(EPSG, easting, northing)."""
    epsg = utm_epsg(longitude_deg, latitude_deg)
    east, north = Transformer.from_crs(4326, epsg, always_xy=True).transform(longitude_deg, latitude_deg)
    return epsg, float(east), float(north)


class PictureWorld:
    """A north-up picture in memory, (H, W) or (H, W, 3), whose outer top-left corner lies at ``left_m``,
    ``top_m`` of a UTM zone."""

    def __init__(self, image: ByteArray, epsg: int, left_m: float, top_m: float, gsd_m: float) -> None:
        self.epsg = epsg
        self._image, self._left_m, self._top_m, self._gsd_m = image, left_m, top_m, gsd_m

    @property
    def bounds_m(self) -> Box:
        """The whole picture."""
        height, width = self._shape
        return (
            self._left_m, self._top_m - height * self._gsd_m, self._left_m + width * self._gsd_m, self._top_m,
        )  # fmt: skip

    def window(self, box_m: Box) -> Window:
        """The pixels that touch the box."""
        west, south, east, north = box_m
        height, width = self._shape
        c0, c1 = _pixels(west - self._left_m, east - self._left_m, self._gsd_m, width)
        r0, r1 = _pixels(self._top_m - north, self._top_m - south, self._gsd_m, height)
        if c1 <= c0 or r1 <= r0:
            raise WorldError("the flight leaves the orthophoto; shorten it or choose another region")
        left, top = self._left_m + c0 * self._gsd_m, self._top_m - r0 * self._gsd_m
        return Window(self._part(r0, r1, c0, c1), left, top, self._gsd_m)

    @property
    def _shape(self) -> tuple[int, int]:
        """Rows and columns."""
        height, width = self._image.shape[:2]
        return height, width

    def _part(self, r0: int, r1: int, c0: int, c1: int) -> ByteArray:
        return self._image[r0:r1, c0:c1]


class MirroredWorld(PictureWorld):
    """A picture laid ``down`` and ``across`` times, every second one mirrored: the ground goes on over the
    seams. The first is the picture itself. Twice in one direction, no two places look alike but for a mirror;
    twice in both, every place has its like, turned by half a circle."""

    def __init__(self, picture: PictureWorld, down: int, across: int) -> None:
        super().__init__(picture._image, picture.epsg, picture._left_m, picture._top_m, picture._gsd_m)
        self._times = np.array([down, across])

    @property
    def _shape(self) -> tuple[int, int]:
        height, width = super()._shape
        down, across = self._times
        return int(down) * height, int(across) * width

    def _part(self, r0: int, r1: int, c0: int, c1: int) -> ByteArray:
        height, width = super()._shape
        rows, columns = _mirrored(np.arange(r0, r1), height), _mirrored(np.arange(c0, c1), width)
        return self._image[rows[:, None], columns[None, :]]


class OrthoWorld(PictureWorld):
    """A real orthophoto, north up, placed by a JSON with origin_lat_deg, origin_lon_deg and gsd_m."""

    def __init__(self, image: Path, georef: Path) -> None:
        try:
            placed = json.loads(georef.read_text())
            latitude, longitude = float(placed["origin_lat_deg"]), float(placed["origin_lon_deg"])
            gsd_m = float(placed["gsd_m"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise WorldError(
                f"{georef}: is no georeference; give a JSON with origin_lat_deg, origin_lon_deg, gsd_m"
            ) from error
        picture = cv2.imread(str(image), cv2.IMREAD_COLOR)
        if picture is None:
            raise WorldError(f"{image}: is not a readable image; give a JPEG, PNG or TIFF orthophoto")
        super().__init__(np.asarray(picture, dtype=np.uint8), *to_utm(latitude, longitude), gsd_m)


def _mirrored(index: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """0 to count - 1, back to 0, and so on."""
    folded = index % (2 * count)
    return np.minimum(folded, 2 * count - 1 - folded)


def _pixels(low_m: float, high_m: float, gsd_m: float, count: int) -> tuple[int, int]:
    """First pixel that an interval touches and the one after the last, within 0 and ``count``."""
    return max(0, int(low_m / gsd_m)), min(count, max(0, int(high_m / gsd_m + 1.0)))


class TownWorld:
    """A rendered town: roofs, shadows and trees over textured ground, drawn where the camera looks."""

    def __init__(self, footprints: Path, seed: int) -> None:
        try:
            outlines = gpd.read_file(footprints, columns=[]).geometry
        except Exception as error:
            raise WorldError(f"{footprints}: is not a readable footprint file; give a GeoJSON") from error
        if len(outlines) == 0 or outlines.crs is None:
            raise WorldError(f"{footprints}: has no georeferenced outlines; give a GeoJSON of polygons")
        west, south, east, north = outlines.to_crs(4326).total_bounds
        self.epsg = utm_epsg((west + east) / 2.0, (south + north) / 2.0)
        parts = shapely.get_parts(outlines.to_crs(self.epsg).to_numpy())
        self._polygons = parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON]
        if len(self._polygons) == 0:
            raise WorldError(f"{footprints}: has no polygons; give a GeoJSON of building outlines")
        self._tree = shapely.STRtree(self._polygons)
        self._seed = seed
        self.bounds_m: Box = tuple(float(v) for v in shapely.total_bounds(self._polygons))  # type: ignore[assignment]
        rng = np.random.default_rng(seed)
        self._trees_xy, self._trees_r = _plant(self.bounds_m, self._tree, self._polygons, rng)
        self._textures = [(_noise(rng, side, octaves), side) for side, octaves in ((1021, 4), (1543, 6))]

    def window(self, box_m: Box) -> Window:
        """Draw the box; the same place always looks the same."""
        gsd = RENDERED_GSD_M
        c0, r0 = int(np.floor(box_m[0] / gsd)), int(np.floor(-box_m[3] / gsd))
        c1, r1 = int(np.ceil(box_m[2] / gsd)), int(np.ceil(-box_m[1] / gsd))
        columns, rows = np.arange(c0, c1), np.arange(r0, r1)
        fine, coarse = (t[np.ix_(rows % side, columns % side)] for t, side in self._textures)
        blend = 1.0 / (1.0 + np.exp(-2.5 * coarse))[:, :, None]
        image = (GRASS * (1 - blend) + SOIL * blend) + 14.0 * fine[:, :, None] + 9.0 * coarse[:, :, None]
        shift = np.array([c0, r0])
        near = shapely.box(box_m[0] - 40, box_m[1] - 40, box_m[2] + 40, box_m[3] + 40)
        visible = np.sort(self._tree.query(near))
        self._draw_trees(image, box_m, shift, gsd, fine)
        for index in visible:
            self._draw_building(image, int(index), shift, gsd, fine)
        return Window(np.clip(image, 0, 255).astype(np.uint8), c0 * gsd, -r0 * gsd, gsd)

    def _draw_trees(
        self, image: FloatArray, box_m: Box, shift: NDArray[np.int64], gsd: float, fine: FloatArray
    ) -> None:
        x, y = self._trees_xy.T
        inside = (x > box_m[0] - 9) & (x < box_m[2] + 9) & (y > box_m[1] - 9) & (y < box_m[3] + 9)
        shade = np.zeros(image.shape[:2], dtype=np.uint8)
        crown = np.zeros_like(shade)
        for (east, north), radius in zip(self._trees_xy[inside], self._trees_r[inside], strict=True):
            centre = np.array([east, -north]) / gsd - shift
            size = int(16 * radius / gsd)
            cv2.circle(shade, _fixed(centre + radius / gsd * 0.7), size, 255, -1, cv2.LINE_AA, 4)
            cv2.circle(crown, _fixed(centre), size, 255, -1, cv2.LINE_AA, 4)
        image *= 1.0 - 0.45 * (shade[:, :, None] / 255.0)
        leaves = np.array([38.0, 70.0, 52.0]) + 16.0 * fine[:, :, None]
        alpha = crown[:, :, None] / 255.0
        image[:] = image * (1 - alpha) + leaves * alpha

    def _draw_building(
        self, image: FloatArray, index: int, shift: NDArray[np.int64], gsd: float, fine: FloatArray
    ) -> None:
        outline = shapely.get_coordinates(self._polygons[index].exterior) * [1.0, -1.0] / gsd - shift
        low = np.floor(outline.min(axis=0)).astype(int) - 3
        high = np.ceil(outline.max(axis=0)).astype(int) + 30
        low, high = np.maximum(low, 0), np.minimum(high, [image.shape[1], image.shape[0]])
        if (high <= low).any():
            return
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        rng = np.random.default_rng([self._seed, index])
        height_px = rng.uniform(3.0, 7.0) / gsd * 0.45
        shape = (int(high[1] - low[1]), int(high[0] - low[0]))
        shadow = _fill(shape, outline - low + height_px)
        roof = _fill(shape, outline - low)
        colour = ROOFS[rng.integers(len(ROOFS))] * rng.uniform(0.85, 1.2)
        axis = _long_axis(outline)
        centre = outline[:-1].mean(axis=0) - low
        grid_y, grid_x = np.mgrid[: shape[0], : shape[1]]
        across = (grid_x - centre[0]) * -axis[1] + (grid_y - centre[1]) * axis[0]
        sunny = np.where(across * np.sign(axis[0] + axis[1] + 1e-9) < 0.0, 1.12, 0.84)
        tiles = 5.0 * np.sin(2.0 * np.pi * across * gsd / 0.9)
        ridge = 14.0 * np.exp(-0.5 * (across * gsd / 0.25) ** 2)
        lit = colour * sunny[:, :, None] + (tiles + ridge + 7.0 * fine[part])[:, :, None]
        image[part] *= 1.0 - 0.5 * (shadow * (1.0 - roof))[:, :, None]
        image[part] = image[part] * (1.0 - roof[:, :, None]) + lit * roof[:, :, None]


def _fixed(point: FloatArray) -> tuple[int, int]:
    """A point with four fractional bits for OpenCV."""
    return round(float(point[0]) * 16), round(float(point[1]) * 16)


def _fill(shape: tuple[int, int], outline: FloatArray) -> FloatArray:
    plane = np.zeros(shape, dtype=np.uint8)
    cv2.fillPoly(plane, [np.round((outline - 0.5) * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
    return np.asarray(plane / 255.0, dtype=np.float64)


def _long_axis(outline: FloatArray) -> FloatArray:
    edges = np.diff(outline, axis=0)
    longest = edges[np.argmax(np.hypot(*edges.T))]
    return np.asarray(longest / np.hypot(*longest), dtype=np.float64)


def _noise(rng: np.random.Generator, side: int, octaves: int) -> FloatArray:
    """(side, side) periodic noise of unit variance, finest octave one pixel."""
    total = np.zeros((side, side))
    for octave in range(octaves):
        cells = max(3, side >> octave)
        grid = np.pad(rng.normal(size=(cells, cells)), 2, mode="wrap")
        scale = side / cells
        at = (np.arange(side) / scale + 2.0).astype(np.float32)
        x, y = np.meshgrid(at, at)
        smooth = cv2.remap(grid.astype(np.float32), x, y, cv2.INTER_CUBIC)
        total += smooth * 1.4**octave
    return np.asarray((total - total.mean()) / total.std(), dtype=np.float64)


def _plant(
    bounds_m: Box, tree: shapely.STRtree, polygons: NDArray[np.object_], rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Trees, (N, 2) and radii, three to a building, none on a roof."""
    count = 3 * len(polygons)
    xy = np.column_stack([rng.uniform(bounds_m[i], bounds_m[i + 2], count) for i in (0, 1)])
    radius = rng.uniform(1.2, 3.6, count)
    hit = tree.query(shapely.buffer(shapely.points(xy), radius), predicate="intersects")[0]
    free = np.ones(count, dtype=bool)
    free[hit] = False
    return xy[free], radius[free]
