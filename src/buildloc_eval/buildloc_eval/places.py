"""Labelled ground: imagery with the building that every pixel belongs to.

Readers of the layouts in which labelled imagery comes, and the real places of the project's own data.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import geopandas as gpd
import numpy as np
import shapely
from buildloc.images import SUFFIXES
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import ByteArray
from numpy.typing import NDArray
from pyproj import CRS

Labels = NDArray[np.int32]
BoolArray = NDArray[np.bool_]
EQUATOR_M = 2.0 * math.pi * 6378137.0
INRIA_GSD_M = 0.3
FINER = 5
SPECK_PX = 10  # mask components smaller than this are rasterisation crumbs, no buildings


class PlaceError(BuildlocError):
    """Labelled imagery is absent or not laid out as said."""


@dataclass(frozen=True)
class Scene:
    """A north-up picture with its labels, all (H, W): the building of each pixel, 0 for none, and whether the
    pixel is labelled at all. Unlabelled pixels neither train nor count. ``told_apart``: touching buildings
    have labels of their own; where they came as a mask, they are one."""

    name: str
    gsd_m: float
    rgb: ByteArray
    buildings: Labels
    labelled: BoolArray
    told_apart: bool = True

    def part(self, rows: slice, columns: slice, name: str) -> Scene:
        """A rectangular part."""
        at = (rows, columns)
        return replace(
            self, name=name, rgb=self.rgb[at], buildings=self.buildings[at], labelled=self.labelled[at]
        )

    def resampled(self, gsd_m: float) -> Scene:
        """The same ground at another ground sampling distance."""
        zoom = self.gsd_m / gsd_m
        height, width = (max(1, round(side * zoom)) for side in self.labelled.shape)
        method = cv2.INTER_AREA if zoom < 1.0 else cv2.INTER_CUBIC
        rgb = cv2.resize(self.rgb, (width, height), interpolation=method)
        rows = np.minimum((np.arange(height) + 0.5) / zoom, self.labelled.shape[0] - 1).astype(int)
        columns = np.minimum((np.arange(width) + 0.5) / zoom, self.labelled.shape[1] - 1).astype(int)
        at = np.ix_(rows, columns)
        return replace(
            self, gsd_m=gsd_m, rgb=rgb.astype(np.uint8), buildings=self.buildings[at],
            labelled=self.labelled[at],
        )  # fmt: skip


def _read(path: Path, flags: int) -> ByteArray:
    picture = cv2.imread(str(path), flags)
    if picture is None:
        raise PlaceError(f"{path}: is not a readable image; replace it or take it out of the folder")
    return np.asarray(picture, dtype=np.uint8)


def _read_rgb(path: Path) -> ByteArray:
    return np.asarray(cv2.cvtColor(_read(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), dtype=np.uint8)


def components(mask: ByteArray) -> Labels:
    """Buildings of a mask (H, W), building above 127: its connected components, numbered from 1."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats((mask > 127).astype(np.uint8), connectivity=4)
    kept = stats[:, cv2.CC_STAT_AREA] >= SPECK_PX
    kept[0] = False
    return np.asarray(np.where(kept, np.cumsum(kept), 0)[labels], dtype=np.int32)


def _pairs(images: Path, masks: Path) -> list[tuple[Path, Path]]:
    """Images and masks of the same stem. Raises PlaceError when there are none."""
    by_stem = {path.stem: path for path in images.glob("*") if path.suffix.lower() in SUFFIXES}
    pairs = [
        (by_stem[mask.stem], mask)
        for mask in sorted(masks.glob("*"))
        if mask.suffix.lower() in SUFFIXES and mask.stem in by_stem
    ]
    if not pairs:
        raise PlaceError(
            f"{images.parent}: no image in {images.name}/ has a mask of its name in {masks.name}/"
        )
    return pairs


def read_pairs(images: Path, masks: Path, gsd_m: float) -> Iterator[Scene]:
    """A folder of images beside a folder of masks (0 and 255) of the same names, one scene a pair."""
    for image, mask in _pairs(images, masks):
        rgb, buildings = _read_rgb(image), components(_read(mask, cv2.IMREAD_GRAYSCALE))
        if rgb.shape[:2] != buildings.shape:
            raise PlaceError(f"{mask}: its size is not that of {image.name}; make it again")
        everywhere = np.ones(buildings.shape, dtype=np.bool_)
        yield Scene(image.stem, gsd_m, rgb, buildings, everywhere, told_apart=False)


def read_inria(folder: Path) -> Iterator[tuple[str, Scene]]:
    """The INRIA aerial image layout, images/ beside gt/, 0.3 m: the town of each scene, and the scene."""
    for scene in read_pairs(folder / "images", folder / "gt", INRIA_GSD_M):
        yield scene.name.rstrip("0123456789"), scene


def read_web_tiles(images: Path, masks: Path, only_zoom: int | None = None) -> Iterator[Scene]:
    """Tiles of the web-mercator grid, named ...x-y-zoom, pasted together: one scene for every zoom, or of one
    zoom alone."""
    tiles: dict[int, list[tuple[int, int, Path, Path]]] = {}
    for image, mask in _pairs(images, masks):
        try:
            x, y, zoom = (int(number) for number in mask.stem.split("-")[-3:])
        except ValueError as error:
            raise PlaceError(f"{mask}: a web tile is named NAME-x-y-zoom; rename it") from error
        if only_zoom in (None, zoom):
            tiles.setdefault(zoom, []).append((x, y, image, mask))
    for zoom, at in sorted(tiles.items()):
        side = _read(at[0][3], cv2.IMREAD_GRAYSCALE).shape[0]
        left, top = min(t[0] for t in at), min(t[1] for t in at)
        columns, rows = max(t[0] for t in at) - left + 1, max(t[1] for t in at) - top + 1
        rgb = np.zeros((rows * side, columns * side, 3), dtype=np.uint8)
        mask_all = np.zeros(rgb.shape[:2], dtype=np.uint8)
        labelled = np.zeros(rgb.shape[:2], dtype=np.bool_)
        for x, y, image, mask in at:
            window = np.s_[(y - top) * side : (y - top + 1) * side, (x - left) * side : (x - left + 1) * side]
            rgb[window], mask_all[window] = _read_rgb(image), _read(mask, cv2.IMREAD_GRAYSCALE)
            labelled[window] = True
        gsd = web_tile_gsd_m(top + rows / 2.0, zoom, side)
        yield Scene(f"z{zoom}", gsd, rgb, components(mask_all), labelled, told_apart=False)


def web_tile_gsd_m(y: float, zoom: int, side_px: int) -> float:
    """Ground sampling distance of a web-mercator tile in row ``y``."""
    latitude = math.atan(math.sinh(math.pi * (1.0 - 2.0 * y / 2**zoom)))
    return float(EQUATOR_M * math.cos(latitude) / (2**zoom * side_px))


def drawn(outlines_px: list[shapely.Polygon], shape: tuple[int, int]) -> Labels:
    """Outlines in pixels (outer corner of pixel (0, 0) is the origin) as labels 1, 2, ...; where two overlap,
    the smaller lies on top. Courtyards stay open."""
    labels = np.zeros(shape, dtype=np.int32)
    for number in sorted(range(len(outlines_px)), key=lambda i: -outlines_px[i].area):
        outline = outlines_px[number]
        west, south, east, north = outline.bounds
        r0, c0 = max(0, int(south) - 1), max(0, int(west) - 1)
        r1, c1 = min(shape[0], int(north) + 2), min(shape[1], int(east) + 2)
        if r1 <= r0 or c1 <= c0:
            continue
        # fillPoly also paints the pixels that an outline touches: on a finer grid that is next to nothing.
        inside = np.zeros(((r1 - r0) * FINER, (c1 - c0) * FINER), dtype=np.uint8)
        rings = [
            (np.array(ring.coords) - (c0, r0)) * FINER - 0.5
            for ring in (outline.exterior, *outline.interiors)
        ]
        cv2.fillPoly(inside, [np.round(ring * 16.0).astype(np.int32) for ring in rings], 1, cv2.LINE_8, 4)
        inside = inside[FINER // 2 :: FINER, FINER // 2 :: FINER]
        labels[r0:r1, c0:c1][inside > 0] = number + 1
    return labels


def read_ortho(image: Path, outlines: Path, georef: Path) -> Scene:
    """An orthophoto with building polygons (any file geopandas reads) and a JSON with its placement:
    origin_lat_deg, origin_lon_deg, gsd_m; azimuthal equidistant about the origin, rows run south."""
    try:
        placed = json.loads(georef.read_text())
        gsd, lat, lon = (float(placed[key]) for key in ("gsd_m", "origin_lat_deg", "origin_lon_deg"))
        polygons = gpd.read_file(outlines).geometry
    except (OSError, ValueError, KeyError) as error:
        raise PlaceError(f"{image.parent}: needs {georef.name} and {outlines.name} ({error})") from error
    local = CRS.from_proj4(f"+proj=aeqd +lat_0={lat} +lon_0={lon} +units=m")
    rgb = _read_rgb(image)
    pixels = shapely.transform(
        polygons.to_crs(local).to_numpy(), lambda xy: np.column_stack([xy[:, 0], -xy[:, 1]]) / gsd
    )
    buildings = drawn(_polygons(pixels), rgb.shape[:2])
    return Scene(image.parent.name, gsd, rgb, buildings, np.ones(buildings.shape, dtype=np.bool_))


def _polygons(geometries: NDArray[np.object_]) -> list[shapely.Polygon]:
    parts = shapely.get_parts(geometries)
    return [part for part in parts if isinstance(part, shapely.Polygon) and not part.is_empty]


def read_web_ortho(images: Path, masks: Path, outlines: Path) -> Scene:
    """Contiguous web-mercator tiles of one zoom, labelled where a mask lies beside them, with the polygons
    (WGS84) that tell touching buildings apart."""
    (scene,) = read_web_tiles(images, masks)
    left, top, zoom, side = _web_origin(masks)
    polygons = gpd.read_file(outlines).geometry.to_crs(3857)
    metres = EQUATOR_M / (2**zoom * side)
    pixels = shapely.transform(
        polygons.to_numpy(),
        lambda xy: np.column_stack(
            [
                (xy[:, 0] + EQUATOR_M / 2.0) / metres - left * side,
                (EQUATOR_M / 2.0 - xy[:, 1]) / metres - top * side,
            ]
        ),
    )
    outlined = drawn(_polygons(pixels), scene.buildings.shape)
    return replace(scene, buildings=outlined, told_apart=True)


def _web_origin(masks: Path) -> tuple[int, int, int, int]:
    tiles = [[int(n) for n in path.stem.split("-")[-3:]] for path in sorted(masks.glob("*.png"))]
    side = _read(next(iter(sorted(masks.glob("*.png")))), cv2.IMREAD_GRAYSCALE).shape[0]
    return min(t[0] for t in tiles), min(t[1] for t in tiles), tiles[0][2], side


def _barnarp(imagery: Path) -> Scene:
    folder = imagery / "barnarp"
    return read_ortho(folder / "ortho.jpg", folder / "footprints.geojson", folder / "georef.json")


def _half(imagery: Path, west: bool) -> list[Scene]:
    scene = _barnarp(imagery)
    middle = 4096  # tile columns 0-7 of 17
    columns = slice(0, middle) if west else slice(middle, None)
    return [scene.part(slice(None), columns, f"barnarp_{'west' if west else 'east'}")]


def _tiles(imagery: Path, folder: str, only_zoom: int | None) -> list[Scene]:
    images, masks = imagery / folder / "images", imagery / folder / "masks"
    return [
        replace(scene, name=f"{folder}/{scene.name}") for scene in read_web_tiles(images, masks, only_zoom)
    ]


def _banepa_ortho(imagery: Path) -> Scene:
    folder = imagery / "banepa_ortho"
    scene = read_web_ortho(folder / "tiles", folder / "masks", folder / "labels.geojson")
    return replace(scene, name="banepa_ortho")


# Places whose ground is apart; the halves are parts of barnarp. banepa's two sources adjoin.
PLACES: dict[str, Callable[[Path, int | None], list[Scene]]] = {
    "barnarp": lambda imagery, _: [_barnarp(imagery)],
    "barnarp_west": lambda imagery, _: _half(imagery, west=True),
    "barnarp_east": lambda imagery, _: _half(imagery, west=False),
    "banepa": lambda imagery, zoom: [_banepa_ortho(imagery), *_tiles(imagery, "tiles_banepa_z", zoom)],
    "zanzibar": lambda imagery, zoom: _tiles(imagery, "tiles_zanzibar", zoom),
    "philippines": lambda imagery, zoom: _tiles(imagery, "tiles_philippines", zoom),
}
PARTS = {"barnarp": ("barnarp_west", "barnarp_east")}  # places that are made of others


def overlap(one: str, other: str) -> bool:
    """Whether two places share ground."""
    return not set(PARTS.get(one, (one,))).isdisjoint(PARTS.get(other, (other,)))


def place(imagery: Path, name: str, only_zoom: int | None = None) -> list[Scene]:
    """Every labelled scene of a place, at its own ground sampling distance.

    Zooms of web tiles repeat the same ground: ``only_zoom`` leaves one of them. Raises PlaceError.
    """
    if name not in PLACES:
        raise PlaceError(f"{name}: is no place of the data; they are {', '.join(PLACES)}")
    return PLACES[name](imagery, only_zoom)


def patches(scene: Scene) -> list[Scene]:
    """The connected parts of a scene's labelled ground, each cut out; parts beside it are unlabelled."""
    count, part, stats, _ = cv2.connectedComponentsWithStats(scene.labelled.astype(np.uint8), connectivity=8)
    found = []
    for number in range(1, count):
        left, top, width, height = stats[number, :4]
        window = np.s_[top : top + height, left : left + width]
        labelled = part[window] == number
        found.append(
            replace(
                scene, name=f"{scene.name}#{number}" if count > 2 else scene.name, rgb=scene.rgb[window],
                buildings=np.where(labelled, scene.buildings[window], 0).astype(np.int32), labelled=labelled,
            )
        )  # fmt: skip
    return found
