"""Labelled web-map tiles as mosaics: loading, splitting by area, augmented crops."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
EQUATOR_M = 2 * math.pi * 6378137.0
TRAIN_GSD_M = 0.2  # ground sampling distance that the network sees
STORE_GSD_M = 0.15  # mosaics are kept a little finer, so that zooming in stays sharp
CROP_PX = 256
SPLIT_ZOOM = 19  # tiles of every zoom are split by the zoom-19 cell that holds them

# folder, image folder, share of the tiles held out.  The Philippines are too few to spare any;
# Banepa's two folders adjoin and so both train.
SOURCES: tuple[tuple[str, str, float], ...] = (
    ("tiles_zanzibar", "images", 0.1),
    ("tiles_philippines", "images", 0.0),
    ("tiles_banepa_z", "images", 0.0),
    ("banepa_ortho", "tiles", 0.0),
)


@dataclass(frozen=True)
class Tile:
    """One labelled tile of the web-mercator grid."""

    image: Path
    mask: Path
    x: int
    y: int
    zoom: int

    @property
    def row(self) -> int:
        """Row of the zoom-19 cell that holds the tile."""
        return self.y >> (self.zoom - SPLIT_ZOOM)


@dataclass(frozen=True)
class Mosaic:
    """Tiles of one source and zoom, side by side at one ground sampling distance."""

    name: str
    rgb: Image
    label: Image  # 255 where a building stands
    valid: Image  # 255 where a tile was
    centres: NDArray[np.float64]  # centre (x, y) of each tile, pixels
    tile_px: float


def find_tiles(folder: Path, images: str) -> list[Tile]:
    """List the tiles of a folder that have a mask."""
    tiles = []
    for mask in sorted((folder / "masks").glob("*.png")):
        _, x, y, zoom = mask.stem.split("-")
        tiles.append(Tile(folder / images / f"{mask.stem}.jpg", mask, int(x), int(y), int(zoom)))
    return tiles


def split_by_area(tiles: list[Tile], share: float) -> tuple[list[Tile], list[Tile]]:
    """Hold out the southernmost zoom-19 rows that together hold at least `share` of the tiles."""
    held_rows: set[int] = set()
    for row in sorted({t.row for t in tiles}, reverse=True):
        if sum(t.row in held_rows for t in tiles) >= share * len(tiles):
            break
        held_rows.add(row)
    return [t for t in tiles if t.row not in held_rows], [t for t in tiles if t.row in held_rows]


def build_mosaic(name: str, tiles: list[Tile], gsd_m: float) -> Mosaic:
    """Paste tiles of one zoom together and resample them to `gsd_m`."""
    first = cv2.imread(str(tiles[0].mask), cv2.IMREAD_GRAYSCALE)
    side, zoom = first.shape[0], tiles[0].zoom
    x0, y0 = min(t.x for t in tiles), min(t.y for t in tiles)
    cols, rows = max(t.x for t in tiles) - x0 + 1, max(t.y for t in tiles) - y0 + 1
    latitude = math.atan(math.sinh(math.pi * (1 - 2 * (y0 + rows / 2) / 2**zoom)))
    native_gsd = EQUATOR_M * math.cos(latitude) / (2**zoom * side)
    px = max(1, round(side * native_gsd / gsd_m))  # a whole number of pixels a tile
    rgb = np.zeros((rows * px, cols * px, 3), np.uint8)
    label, valid = np.zeros(rgb.shape[:2], np.uint8), np.zeros(rgb.shape[:2], np.uint8)
    method = cv2.INTER_AREA if px < side else cv2.INTER_CUBIC
    for t in tiles:
        at = np.s_[(t.y - y0) * px : (t.y - y0 + 1) * px, (t.x - x0) * px : (t.x - x0 + 1) * px]
        bgr = cv2.imread(str(t.image), cv2.IMREAD_COLOR)
        rgb[at] = cv2.cvtColor(cv2.resize(bgr, (px, px), interpolation=method), cv2.COLOR_BGR2RGB)
        mask = cv2.imread(str(t.mask), cv2.IMREAD_GRAYSCALE)
        label[at] = (cv2.resize(mask, (px, px), interpolation=cv2.INTER_LINEAR) > 127) * np.uint8(255)
        valid[at] = 255
    centres = np.array([[(t.x - x0 + 0.5) * px, (t.y - y0 + 0.5) * px] for t in tiles])
    return Mosaic(f"{name}/z{zoom}", rgb, label, valid, centres, float(px))


def load_mosaics(imagery: Path) -> tuple[list[Mosaic], list[Mosaic]]:
    """Return training mosaics (STORE_GSD_M) and validation mosaics (TRAIN_GSD_M)."""
    train: list[Mosaic] = []
    held: list[Mosaic] = []
    for folder, images, share in SOURCES:
        parts = split_by_area(find_tiles(imagery / folder, images), share)
        for out, tiles, gsd in ((train, parts[0], STORE_GSD_M), (held, parts[1], TRAIN_GSD_M)):
            for zoom in sorted({t.zoom for t in tiles}):
                out.append(build_mosaic(folder, [t for t in tiles if t.zoom == zoom], gsd))
    return train, held


def jitter_colours(rgb: Image, rng: np.random.Generator) -> NDArray[np.float32]:
    """Vary brightness, contrast, colour balance, saturation and sharpness."""
    if rng.random() < 0.3:
        rgb = cv2.GaussianBlur(rgb, (0, 0), rng.uniform(0.4, 1.2))
    out = rgb.astype(np.float32)
    grey = out.mean(axis=2, keepdims=True)
    out = grey + (out - grey) * rng.uniform(0.2 if rng.random() < 0.3 else 0.6, 1.4)
    out = out * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    mean = out.mean()
    out = (out - mean) * rng.uniform(0.65, 1.4) + mean + rng.uniform(-35, 35)
    return np.clip(out, 0, 255).astype(np.float32)


class CropSampler:
    """Draws augmented crops from mosaics held in memory."""

    def __init__(self, mosaics: list[Mosaic], seed: int) -> None:
        self._mosaics = mosaics
        self._rng = np.random.default_rng(seed)
        area = np.array([m.valid.astype(bool).sum() for m in mosaics], float) ** 0.7
        self._odds = area / area.sum()

    def crop(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """One crop: rgb CHW 0-255, label HW 0-1, weight HW 0-1 (0 where no tile was)."""
        rng = self._rng
        m = self._mosaics[rng.choice(len(self._mosaics), p=self._odds)]
        centre = m.centres[rng.integers(len(m.centres))] + rng.uniform(-0.5, 0.5, 2) * m.tile_px
        # pixels of the mosaic per pixel of the crop; a larger scale shows larger buildings
        step = TRAIN_GSD_M / STORE_GSD_M / rng.uniform(0.75, 1.35)
        angle = rng.integers(4) * math.pi / 2
        c, s = step * math.cos(angle), step * math.sin(angle)
        linear = np.array([[c, -s], [s, c]]) * np.array([rng.choice((-1, 1)), 1])
        to_mosaic = np.column_stack([linear, centre - linear @ np.full(2, (CROP_PX - 1) / 2)])
        size, inverse = (CROP_PX, CROP_PX), cv2.WARP_INVERSE_MAP
        rgb = cv2.warpAffine(m.rgb, to_mosaic, size, flags=cv2.INTER_LINEAR | inverse)
        label = cv2.warpAffine(m.label, to_mosaic, size, flags=cv2.INTER_LINEAR | inverse)
        valid = cv2.warpAffine(m.valid, to_mosaic, size, flags=cv2.INTER_NEAREST | inverse)
        chw = np.ascontiguousarray(jitter_colours(rgb, rng).transpose(2, 0, 1))
        return chw, (label > 127).astype(np.float32), (valid > 0).astype(np.float32)

    def batch(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """`count` crops, stacked: NCHW, N1HW, N1HW."""
        rgb, label, weight = zip(*(self.crop() for _ in range(count)), strict=True)
        return np.stack(rgb), np.stack(label)[:, None], np.stack(weight)[:, None]
