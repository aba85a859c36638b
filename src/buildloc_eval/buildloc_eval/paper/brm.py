"""Baseline BRM, after Choi and Myung 2020: ratios of built ground in three concentric regions.

A keyframe's ratios do not depend on its heading. Every place whose ratios are near those of the first
keyframe, at every heading, is a hypothesis; odometry carries it from keyframe to keyframe, and it survives
while its residual (L1) stays below a threshold. Survivors rank by their accumulated residual.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import shapely
from buildloc_msgs_py.ground import Quaternion, pixels_to_level
from buildloc_msgs_py.types import ByteArray, CameraModel, FloatArray
from numpy.typing import NDArray

from buildloc_eval.segmentation_errors import Outlines

CELL_M = 10.0
RASTER_M = 2.5  # of the footprints, before they are averaged over half a cell
HEADINGS = 240
STEP_M = 50.0  # between the keyframes used: regions of 40 m then overlap little
TOLERANCE_CELLS = 1  # of odometry and of the steps in heading
THRESHOLDS = (0.15, 0.25, 0.4, 0.6)  # the smallest that leaves survivors is the best
UNITS = 100.0  # of a residual kept as a byte
APART_M = 100.0
KEPT = 10


@dataclass(frozen=True)
class RatioMap:
    """Ratios (3, rows, columns) of built ground around a point of every cell, see :meth:`places_m`; rows run
    north."""

    ratios: NDArray[np.float32]
    west_m: float
    south_m: float

    def places_m(self, cells: FloatArray) -> FloatArray:
        """(H, 2) of cells (H, 2), column and row."""
        return np.asarray((cells + 0.25) * CELL_M + (self.west_m, self.south_m))


@dataclass(frozen=True)
class Survivors:
    """Hypotheses (H,): where the last keyframe is, (H, 2), and the mean residual of all keyframes."""

    places_m: FloatArray
    residuals: FloatArray

    def ranked(self, centre_m: FloatArray, radius_m: float) -> FloatArray:
        """(K, 2) best places at most KEPT, no two of them close, within a circle."""
        inside = np.hypot(*(self.places_m - centre_m).T) <= radius_m
        left = self.places_m[inside][np.argsort(self.residuals[inside], kind="stable")]
        found = list[FloatArray]()
        while len(left) and len(found) < KEPT:
            found.append(left[0])
            left = left[np.hypot(*(left - left[0]).T) > APART_M]
        return np.array(found).reshape(-1, 2)


def regions(camera: CameraModel, altitude_m: float) -> tuple[float, float, float]:
    """Outer radii of the three regions: the largest is what fits into the image."""
    largest = 0.95 * min(camera.width, camera.height) / 2.0 * altitude_m / camera.fx
    return largest / 3.0, 2.0 * largest / 3.0, largest


def coverage(
    mask: ByteArray,
    camera: CameraModel,
    altitude_m: float,
    attitude_xyzw: Quaternion,
    radii_m: Sequence[float],
) -> FloatArray:
    """(3,) share of building pixels in each region about the point below the camera."""
    v, u = np.mgrid[0 : camera.height : 4, 0 : camera.width : 4]
    uv = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    away = np.hypot(*pixels_to_level(uv, camera, altitude_m, attitude_xyzw).T)
    built = mask[::4, ::4].ravel() > 127
    region = np.searchsorted(radii_m, away)
    return np.array([built[region == k].mean() if (region == k).any() else 0.0 for k in range(3)])


def ratio_map(
    outlines: Outlines, centre_m: FloatArray, radius_m: float, radii_m: Sequence[float]
) -> RatioMap:
    """The ratios of a reference, for every cell of a square about the circle."""
    cells = 2 * math.ceil(radius_m / CELL_M)
    west, south = (float(v) for v in np.floor(centre_m / CELL_M) * CELL_M - cells / 2 * CELL_M)
    side = cells * round(CELL_M / RASTER_M)
    built = np.zeros((side, side), dtype=np.uint8)
    points, of = shapely.get_coordinates(shapely.get_exterior_ring(outlines), return_index=True)
    pixels = np.round(((points - (west, south)) / RASTER_M - 0.5) * 16.0).astype(np.int32)
    # A filled polygon is half a pixel wider all around: its pixels weigh less, so that its area is right.
    areas = shapely.area(outlines)
    weights = 255.0 * areas / (areas + 0.5 * RASTER_M * shapely.length(outlines))
    rings = np.split(pixels, np.flatnonzero(np.diff(of)) + 1)
    for ring, weight in zip(rings, weights.tolist(), strict=True):
        cv2.fillPoly(built, [ring], weight, cv2.LINE_8, 4)
    half = cv2.resize(built, (2 * cells, 2 * cells), interpolation=cv2.INTER_AREA)
    inner, ratios = 0.0, np.empty((3, cells, cells), dtype=np.float32)
    for k, outer in enumerate(radii_m):
        kernel = _ring(inner, outer, CELL_M / 2.0)
        ratios[k] = cv2.filter2D(half, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT)[::2, ::2] / 255.0
        inner = outer
    return RatioMap(ratios, west, south)


def _ring(inner_m: float, outer_m: float, pixel_m: float) -> NDArray[np.float32]:
    """Weights of pixels between two radii, of sum 1."""
    reach, fine = math.ceil(outer_m / pixel_m), 5
    steps = (np.arange((2 * reach + 1) * fine) + 0.5) / fine - reach - 0.5
    away = np.hypot(steps[:, None], steps[None, :]) * pixel_m
    within = ((away >= inner_m) & (away < outer_m)).astype(np.float64)
    weights = within.reshape(2 * reach + 1, fine, 2 * reach + 1, fine).sum(axis=(1, 3))
    return np.asarray(weights / weights.sum(), dtype=np.float32)


def used_keyframes(path_m: FloatArray) -> list[int]:
    """Rows of a path (N, 2) that are STEP_M of way apart, the last among them."""
    rows, last = [0], 0
    for row in range(1, len(path_m)):
        if np.hypot(*(path_m[row] - path_m[last])) >= STEP_M:
            rows.append(row)
            last = row
    return rows if rows[-1] == len(path_m) - 1 else [*rows, len(path_m) - 1]


def search(reference: RatioMap, ratios: FloatArray, path_m: FloatArray) -> Survivors:
    """Hypotheses that survive keyframes with ratios (N, 3) at places (N, 2), metres, of any heading.

    None survive where every threshold removes all.
    """
    reach = math.ceil(float(np.hypot(*(path_m - path_m[0]).T).max()) / CELL_M) + 1
    width = reference.ratios.shape[2] + 2 * reach
    # A border that no threshold passes: hypotheses that leave the map end there.
    residuals = [np.pad(_residual(reference, query), reach, constant_values=255).ravel() for query in ratios]
    # Every second cell: the tolerance covers those between.
    first = residuals[0].reshape(-1, width)[reach:-reach:2, reach:-reach:2]
    for threshold in THRESHOLDS:
        row, column = np.nonzero(first <= threshold * UNITS)
        start = (2 * row + reach) * width + 2 * column + reach
        found = [
            _propagate(residuals, width, start, path_m, 2.0 * math.pi * h / HEADINGS, threshold * UNITS)
            for h in range(HEADINGS)
        ]
        cells = np.concatenate([cells for cells, _ in found])
        if len(cells):
            places = np.column_stack([cells % width, cells // width]) - float(reach)
            return Survivors(reference.places_m(places), np.concatenate([mean for _, mean in found]))
    return Survivors(np.empty((0, 2)), np.empty(0))


def _residual(reference: RatioMap, query: FloatArray) -> ByteArray:
    """(rows, columns) L1 distance of the ratios from those of a keyframe, the least within the tolerance."""
    total = np.zeros(reference.ratios.shape[1:], dtype=np.float32)
    for plane, value in zip(reference.ratios, query, strict=True):
        total += np.abs(plane - np.float32(value))
    near = np.ones((2 * TOLERANCE_CELLS + 1,) * 2, dtype=np.uint8)
    return np.asarray(cv2.erode(np.minimum(total * UNITS, 255.0).astype(np.uint8), near), dtype=np.uint8)


def _propagate(
    residuals: Sequence[ByteArray],
    width: int,
    start: NDArray[np.int64],
    path_m: FloatArray,
    heading_rad: float,
    level: float,
) -> tuple[NDArray[np.int64], FloatArray]:
    """Cells (H,) of the last keyframe, and mean residuals (H,), of what starts in cells (S,) at one heading
    and stays at or below the level. Cells are numbered along rows of ``width``."""
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    right, up = np.round((path_m - path_m[0]) @ np.array([[c, s], [-s, c]]) / CELL_M).astype(np.int64).T
    moves = (up * width + right).tolist()
    total = residuals[0][start].astype(np.int32)
    for residual, move in zip(residuals[1:], moves[1:], strict=True):
        here = residual[start + move]
        alive = here <= level
        start, total = start[alive], total[alive] + here[alive]
    return start + moves[-1], total / (UNITS * len(residuals))
