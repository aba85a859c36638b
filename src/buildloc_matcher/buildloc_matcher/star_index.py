"""The order in which reference stars are kept, and 22 bytes of each that tell most pairs apart.

Stars are sorted by cells of the two smaller angles of their central triangle and within a cell by its
perimeter, so that what the filter of Eq. 1 can pass lies in a few runs of stars. A sketch holds angles,
perimeters and areas of all four triangles and the shape of the central one as whole steps: from them
follows a score that the exact one (Eq. 2) never exceeds. Sketches are kept by column, for a run to go
through vector instructions.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from buildloc_matcher.descriptors import AREA, MIDDLE_ANGLE, PERIMETER, SHAPE, SMALL_ANGLE, Triangles, reorder

# Rows: smallest angle, middle angle, perimeter of the centre and of each neighbour; four shape metrics of the
# centre; the sorted areas of its vertices; the mean area of each neighbour.
SKETCH_BYTES = 22
SHAPE_ROW, CORNER_ROW, AREA_ROW = 12, 16, 19
STEPS = 256
SMALL_ANGLE_RAD = math.pi / 3.0
MIDDLE_ANGLE_RAD = math.pi / 2.0
PERIMETERS_M = (4.0, 2000.0)
AREAS_M2 = (10.0, 20_000.0)
SMALL_CELL_STEPS, MIDDLE_CELL_STEPS = 12, 8
SMALL_CELLS = -(-STEPS // SMALL_CELL_STEPS)
MIDDLE_CELLS = -(-STEPS // MIDDLE_CELL_STEPS)


def _steps(values: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint8]:
    """Which of STEPS equal steps from ``low`` to ``high`` a value lies in."""
    scaled = np.floor((np.asarray(values, dtype=np.float64) - low) * (STEPS / (high - low)))
    return np.clip(scaled, 0, STEPS - 1).astype(np.uint8)


def _log_steps(values: NDArray[np.floating], span: tuple[float, float]) -> NDArray[np.uint8]:
    return _steps(np.log(np.maximum(values, 1e-6)), math.log(span[0]), math.log(span[1]))


def corner_areas(triangles: Triangles, areas_m2: NDArray[np.floating]) -> NDArray[np.float32]:
    """(S, 3) areas of the vertices of every star's central triangle, smallest first."""
    return np.sort(areas_m2[triangles.vertices[: triangles.stars]].astype(np.float32), axis=1)


def sketch(triangles: Triangles, areas_m2: NDArray[np.floating]) -> NDArray[np.uint8]:
    """(22, S) sketches of stars of buildings with areas (N,)."""
    features = triangles.star_features()
    rows = np.empty((SKETCH_BYTES, triangles.stars), dtype=np.uint8)
    rows[0:SHAPE_ROW:3] = _steps(features[:, :, SMALL_ANGLE], 0.0, SMALL_ANGLE_RAD).T
    rows[1:SHAPE_ROW:3] = _steps(features[:, :, MIDDLE_ANGLE], 0.0, MIDDLE_ANGLE_RAD).T
    rows[2:SHAPE_ROW:3] = _log_steps(features[:, :, PERIMETER], PERIMETERS_M).T
    rows[SHAPE_ROW:CORNER_ROW] = _steps(features[:, 0, SHAPE:], 0.0, 1.0).T
    rows[CORNER_ROW:AREA_ROW] = _log_steps(corner_areas(triangles, areas_m2), AREAS_M2).T
    rows[AREA_ROW:] = _log_steps(features[:, 1:, AREA], AREAS_M2).T
    return rows


def cells(sketches: NDArray[np.uint8]) -> NDArray[np.int32]:
    """(S,) cell of every star."""
    small = sketches[0].astype(np.int32) // SMALL_CELL_STEPS
    return np.asarray(small * MIDDLE_CELLS + sketches[1] // MIDDLE_CELL_STEPS, dtype=np.int32)


def cell_starts(sketches: NDArray[np.uint8]) -> NDArray[np.int64]:
    """(cells + 1,) first row of every cell of sorted sketches."""
    counts = np.bincount(cells(sketches), minlength=SMALL_CELLS * MIDDLE_CELLS)
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def index_triangles(
    triangles: Triangles, areas_m2: NDArray[np.floating]
) -> tuple[Triangles, NDArray[np.uint8]]:
    """The same triangles with their stars in the order of the index, and the sketches of those."""
    sketches = sketch(triangles, areas_m2)
    order = np.lexsort((sketches[2], cells(sketches)))
    rest = np.arange(triangles.stars, len(triangles))
    indexed = reorder(triangles, np.concatenate([order, rest]), triangles.stars)
    return indexed, np.ascontiguousarray(sketches[:, order])
