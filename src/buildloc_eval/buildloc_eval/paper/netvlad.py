"""Baseline NetVLAD, after Arandjelovic et al. 2016: descriptors of keyframes and of tiles of the reference.

What both sides share is masks of buildings: a keyframe's, turned north-up by the heading that this method is
given, and the reference's outlines, drawn. Two branches of a network (`training/netvlad.py`) describe them.
Every tile is a hypothesis of where the first keyframe is; odometry carries it on, and the squared distances
of all keyframes' descriptors to the tiles it passes add up.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import shapely
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import Quaternion, level_to_ray, resample
from buildloc_msgs_py.types import ByteArray, CameraModel, FloatArray
from numpy.typing import NDArray

from buildloc_eval.paper.brm import Survivors
from buildloc_eval.segmentation_errors import Outlines

NETVLAD = "NetVLAD"
SIDE_PX, PIXEL_M = 64, 2.0  # of a tile: 128 m, about what a frame shows
FINE = 2  # masks are drawn so many times finer, then averaged
STEP_M = 50.0  # of the grid of tiles
BATCH = 128
FARTHEST = 4.0  # squared distance of opposite descriptors: what lies beyond the tiles
BRANCHES = ("drone", "reference")  # ONNX files of a folder

Tiles = NDArray[np.float32]
Descriptors = NDArray[np.float32]
Encode = Callable[[Tiles], Descriptors]


class NetVladError(BuildlocError):
    """The networks cannot be used."""


@dataclass(frozen=True)
class Encoders:
    """The two branches: keyframes (N, 2, SIDE_PX, SIDE_PX), building and seen, and tiles (N, 1, ...),
    building, all 0 to 1, to descriptors (N, D) of length 1. ``digest`` tells them from others."""

    drone: Encode
    reference: Encode
    digest: str


@dataclass(frozen=True)
class Grid:
    """Tiles at whole multiples of STEP_M: the centre of the first, and which of them (rows north, columns
    east) are searched."""

    west_m: float
    south_m: float
    inside: NDArray[np.bool_]

    @classmethod
    def about(cls, centre_m: FloatArray, radius_m: float) -> Grid:
        """Tiles within a circle. Were they laid about the circle, a flight about its centre would lie on
        them better than by chance."""
        west, south = np.ceil((centre_m - radius_m) / STEP_M) * STEP_M
        steps = STEP_M * np.arange(math.floor(2.0 * radius_m / STEP_M) + 1)
        east_m, north_m = west + steps - centre_m[0], south + steps - centre_m[1]
        return cls(float(west), float(south), np.hypot(east_m[None, :], north_m[:, None]) <= radius_m)

    @classmethod
    def over(cls, grids: Sequence[Grid]) -> Grid:
        """The tiles of any of some grids, at least one."""
        west, south = min(grid.west_m for grid in grids), min(grid.south_m for grid in grids)
        corners = [grid._first_in(west, south) for grid in grids]
        rows = max(row + grid.inside.shape[0] for grid, (row, _) in zip(grids, corners, strict=True))
        columns = max(column + grid.inside.shape[1] for grid, (_, column) in zip(grids, corners, strict=True))
        inside = np.zeros((rows, columns), dtype=np.bool_)
        for grid, (row, column) in zip(grids, corners, strict=True):
            inside[row : row + grid.inside.shape[0], column : column + grid.inside.shape[1]] |= grid.inside
        return cls(west, south, inside)

    def columns_of(self, whole: Grid, row: int, columns: NDArray[np.intp]) -> tuple[int, NDArray[np.intp]]:
        """The row and the columns (C,) that tiles of another grid have in this one; -1 for those outside."""
        first_row, first_column = self._first_in(whole.west_m, whole.south_m)
        row, columns = row - first_row, columns - first_column
        if not 0 <= row < self.inside.shape[0]:
            return row, np.full_like(columns, -1)
        known = (columns >= 0) & (columns < self.inside.shape[1])
        known[known] = self.inside[row, columns[known]]
        return row, np.where(known, columns, -1)

    def _first_in(self, west_m: float, south_m: float) -> tuple[int, int]:
        """Row and column of the first tile in a grid that begins there."""
        return round((self.south_m - south_m) / STEP_M), round((self.west_m - west_m) / STEP_M)


def load_encoders(folder: Path) -> Encoders:
    """The networks of a folder that `training/netvlad.py` wrote. Raises NetVladError."""
    digest, found = hashlib.sha256(), dict[str, Encode]()
    for name in BRANCHES:
        path = folder / f"{name}.onnx"
        if not path.is_file():
            raise NetVladError(f"{path}: no such network; make it with training/netvlad.py --out {folder}")
        digest.update(path.read_bytes())
        try:
            found[name] = _encoder(onnxruntime.InferenceSession(path, providers=_providers()))
        except Exception as error:  # onnxruntime has no base class for its errors
            raise NetVladError(f"{path}: is not a loadable ONNX network; export it again") from error
    return Encoders(found["drone"], found["reference"], digest.hexdigest())


def _providers() -> list[str]:
    gpu = "CUDAExecutionProvider"
    return [p for p in (gpu, "CPUExecutionProvider") if p in onnxruntime.get_available_providers()]


def _encoder(session: onnxruntime.InferenceSession) -> Encode:
    (given,) = session.get_inputs()

    def encode(tiles: Tiles) -> Descriptors:
        parts = [
            session.run(None, {given.name: tiles[k : k + BATCH]})[0] for k in range(0, len(tiles), BATCH)
        ]
        return np.concatenate(parts)

    return encode


def keyframe_tile(
    mask: ByteArray, camera: CameraModel, altitude_m: float, attitude_xyzw: Quaternion, yaw_rad: float
) -> Tiles:
    """(2, SIDE_PX, SIDE_PX) share of building, and of what the frame shows, in each pixel about the point
    below the camera, north up.

    ``yaw_rad``: of image-right, counter-clockwise from east, as a compass gives it.
    """
    side, pixel = SIDE_PX * FINE, PIXEL_M / FINE
    half, c, s = (side - 1) / 2.0, math.cos(yaw_rad), math.sin(yaw_rad)
    to_east_north = np.array([[pixel, 0.0, -half * pixel], [0.0, -pixel, half * pixel], [0.0, 0.0, 1.0]])
    to_level = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    to_ray = level_to_ray(altitude_m, attitude_xyzw) @ to_level @ to_east_north
    # Averaged twice: the mask has several pixels in each fine one.
    soft = cv2.blur(mask, (max(1, round(pixel * camera.fx / altitude_m)),) * 2)
    planes = [
        resample(np.asarray(p, np.uint8), camera, to_ray, (side, side))
        for p in (soft, np.full_like(mask, 255))
    ]
    return np.stack([shrunk(plane) for plane in planes])


def shrunk(plane: ByteArray) -> Tiles:
    """(H, W) of 0 to 255, drawn FINE times finer -> shares, 0 to 1."""
    size = (plane.shape[1] // FINE, plane.shape[0] // FINE)
    small = cv2.resize(plane, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32) / np.float32(255.0)


def raster(outlines: Outlines, west_m: float, south_m: float, size_px: tuple[int, int]) -> Tiles:
    """Share (rows, columns) of built ground in pixels of PIXEL_M; rows run south from the north edge.

    ``size_px``: columns and rows.
    """
    fine, pixel = np.zeros((size_px[1] * FINE, size_px[0] * FINE), dtype=np.uint8), PIXEL_M / FINE
    points, of = shapely.get_coordinates(shapely.get_exterior_ring(outlines), return_index=True)
    north = south_m + size_px[1] * PIXEL_M
    pixels = np.round(((points - (west_m, north)) * (1.0, -1.0) / pixel - 0.5) * 16.0).astype(np.int32)
    for ring in np.split(pixels, np.flatnonzero(np.diff(of)) + 1) if len(pixels) else []:
        cv2.fillPoly(fine, [ring], 255, cv2.LINE_8, 4)
    return shrunk(fine)


def tile_rows(outlines: Outlines, grid: Grid) -> Iterator[tuple[int, NDArray[np.intp], Tiles]]:
    """Row, columns (C,) and tiles (C, 1, SIDE_PX, SIDE_PX) of every row of the grid."""
    tree, half, stride = shapely.STRtree(outlines), SIDE_PX * PIXEL_M / 2.0, round(STEP_M / PIXEL_M)
    count, across = grid.inside.shape
    west, wide = grid.west_m - half, (across - 1) * stride + SIDE_PX
    for row in range(count):
        south = grid.south_m + row * STEP_M - half
        strip = shapely.box(west, south, west + wide * PIXEL_M, south + 2.0 * half)
        drawn = raster(outlines[np.sort(tree.query(strip))], west, south, (wide, SIDE_PX))
        windows = np.lib.stride_tricks.sliding_window_view(drawn, SIDE_PX, axis=1)[:, ::stride]
        columns = np.flatnonzero(grid.inside[row])
        yield row, columns, np.ascontiguousarray(windows[:, columns].swapaxes(0, 1))[:, None]


def distances(
    outlines: Outlines,
    grids: Sequence[Grid],
    encode: Encode,
    queries: Sequence[Descriptors],
    step: Callable[[], None],
) -> tuple[list[NDArray[np.float16]], list[float]]:
    """Of every grid the squared distances (Q, rows, columns) of its descriptors (Q, D) to its tiles, FARTHEST
    outside the circle; and the seconds that comparing took, without describing the tiles. A tile of several
    grids is described once. ``step`` follows a row."""
    found = [
        np.full((len(some), *grid.inside.shape), FARTHEST, dtype=np.float16)
        for grid, some in zip(grids, queries, strict=True)
    ]
    whole, seconds = Grid.over(grids), [0.0] * len(grids)
    empty = encode(np.zeros((1, 1, SIDE_PX, SIDE_PX), dtype=np.float32))
    for row, columns, tiles in tile_rows(outlines, whole):
        built = tiles.any(axis=(1, 2, 3))
        described = np.repeat(empty, len(columns), axis=0)  # water and woods look the same everywhere
        if built.any():
            described[built] = encode(tiles[built])
        for number, (grid, some) in enumerate(zip(grids, queries, strict=True)):
            started = time.perf_counter()
            at, where = grid.columns_of(whole, row, columns)
            if (known := where >= 0).any():
                found[number][:, at, where[known]] = 2.0 - 2.0 * (some @ described[known].T)
            seconds[number] += time.perf_counter() - started
        step()
    return found, seconds


def accumulate(distance: NDArray[np.float16], path_m: FloatArray, grid: Grid) -> Survivors:
    """Where the last keyframe is (H, 2), and the mean distance, of a hypothesis in every tile of the circle.

    ``distance`` (N, rows, columns) is of keyframes at ``path_m`` (N, 2), metres east and north of anywhere.
    """
    moves, total = path_m - path_m[0], np.zeros(distance.shape[1:], dtype=np.float32)
    for plane, (east, north) in zip(distance, moves / STEP_M, strict=True):
        # Between tiles distances are interpolated: what is carried on never rounds its place.
        by = np.array([[1.0, 0.0, east], [0.0, 1.0, north]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        total += cv2.warpAffine(
            plane.astype(np.float32), by, plane.shape[::-1], flags=flags, borderValue=FARTHEST
        )
    rows, columns = np.nonzero(grid.inside)
    places = np.column_stack([columns, rows]) * STEP_M + (grid.west_m, grid.south_m) + moves[-1]
    return Survivors(places, np.asarray(total[rows, columns] / len(distance), dtype=np.float64))
