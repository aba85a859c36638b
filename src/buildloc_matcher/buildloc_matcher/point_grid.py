"""Points in square cells, for nearest-neighbour look-ups inside compiled loops."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numba import njit
from numpy.typing import NDArray

Frame = tuple[float, float, float, int, int]
MIN_CELL_M = 25.0
POINTS_PER_CELL = 0.5


@dataclass(frozen=True)
class PointGrid:
    """Points (N, 2) in the order of their cells, row by row from the south-west.

    ``order`` (N,) gives their places in the input; ``starts`` (rows * columns + 1,) the first of each cell.
    """

    points_m: FloatArray
    order: NDArray[np.int64]
    starts: NDArray[np.int64]
    west_m: float
    south_m: float
    cell_m: float
    columns: int
    rows: int

    @property
    def frame(self) -> Frame:
        """West, south, cell, columns, rows, as compiled loops take them."""
        return self.west_m, self.south_m, self.cell_m, self.columns, self.rows


def grid_points(points_m: FloatArray) -> PointGrid:
    """Sort points (N, 2), N >= 1, into cells that hold about half a point each, or are MIN_CELL_M wide."""
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    width, height = np.maximum(high - low, 1.0)
    cell = max(MIN_CELL_M, math.sqrt(width * height * POINTS_PER_CELL / len(points_m)))
    columns, rows = int(width // cell) + 1, int(height // cell) + 1
    column, row = ((points_m - low) // cell).astype(np.int64).T
    cells = row * columns + column
    order = np.argsort(cells, kind="stable")
    counts = np.bincount(cells, minlength=rows * columns)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    ordered = np.ascontiguousarray(points_m[order])
    return PointGrid(ordered, order, starts, float(low[0]), float(low[1]), cell, columns, rows)


def within(
    grid: PointGrid, west_m: float, south_m: float, east_m: float, north_m: float
) -> NDArray[np.int64]:
    """Rows of the input of :func:`grid_points` that lie in a box, in rising order."""
    columns = np.clip(
        [(west_m - grid.west_m) // grid.cell_m, (east_m - grid.west_m) // grid.cell_m + 1], 0, grid.columns
    )
    rows = np.clip(
        [(south_m - grid.south_m) // grid.cell_m, (north_m - grid.south_m) // grid.cell_m + 1], 0, grid.rows
    )
    spans = [
        np.arange(
            grid.starts[row * grid.columns + int(columns[0])],
            grid.starts[row * grid.columns + int(columns[1])],
        )
        for row in range(int(rows[0]), int(rows[1]))
    ]
    found = np.concatenate(spans) if spans else np.empty(0, dtype=np.int64)
    x, y = grid.points_m[found].T
    inside = (x >= west_m) & (x <= east_m) & (y >= south_m) & (y <= north_m)
    return np.sort(grid.order[found[inside]])


def near(grid: PointGrid, around_m: FloatArray, radius_m: float) -> NDArray[np.int64]:
    """Rows of the input of :func:`grid_points` within the radius of any of the points (M, 2), rising."""
    places = _near(grid.points_m, grid.starts, grid.frame, np.ascontiguousarray(around_m), radius_m)
    return np.sort(grid.order[np.unique(places)])


@njit(nogil=True, cache=True)
def _near(points_m, starts, frame, around_m, radius):  # type: ignore[no-untyped-def]
    """Places of the points near each of ``around_m``, those near several of them several times."""
    found, count = np.empty(256, np.int64), 0
    for x, y in around_m:
        first_column, last_column, first_row, last_row = _reach(frame, x, y, radius)
        for row in range(first_row, last_row + 1):
            first = row * frame[3]
            for at in range(starts[first + first_column], starts[first + last_column + 1]):
                if (points_m[at, 0] - x) ** 2 + (points_m[at, 1] - y) ** 2 <= radius * radius:
                    if count == len(found):
                        found = np.concatenate((found, np.empty_like(found)))
                    found[count] = at
                    count += 1
    return found[:count]


@njit(nogil=True, cache=True, inline="always")
def _reach(frame, x, y, radius):  # type: ignore[no-untyped-def]
    """First and last column and row of the cells that a disc touches; no row where it touches none."""
    west, south, cell, columns, rows = frame
    first_column = max(0, math.floor((x - radius - west) / cell))
    last_column = min(columns - 1, math.floor((x + radius - west) / cell))
    first_row = max(0, math.floor((y - radius - south) / cell))
    last_row = min(rows - 1, math.floor((y + radius - south) / cell))
    if first_column > last_column:
        last_row = first_row - 1
    return first_column, last_column, first_row, last_row


@njit(nogil=True, cache=True)
def nearest(points_m, starts, frame, x, y, reach):  # type: ignore[no-untyped-def]
    """Place in ``points_m`` of the point nearest to (x, y) and its squared distance; -1 beyond ``reach``.

    ``frame`` is (west, south, cell, columns, rows) of the grid.
    """
    best, best_squared = -1, reach * reach
    first_column, last_column, first_row, last_row = _reach(frame, x, y, reach)
    for row in range(first_row, last_row + 1):
        first = row * frame[3]
        for at in range(starts[first + first_column], starts[first + last_column + 1]):
            squared = (points_m[at, 0] - x) ** 2 + (points_m[at, 1] - y) ** 2
            if squared < best_squared:
                best, best_squared = at, squared
    return best, best_squared
