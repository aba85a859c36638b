"""Measured buildings on disk, by square of a fixed grid, so that memory does not grow with a city."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import shapely
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray

from buildloc_matcher.reference.buildings import OUTLINE_VERTICES, Buildings
from buildloc_matcher.reference.readers import Geometries
from buildloc_matcher.reference.region import Bounds

# One building; ``source`` is its place on the command line, ``id`` unlike any other in the spool.
ROW = np.dtype(
    [
        ("x", "f8"), ("y", "f8"), ("area", "f4"), ("shape", "f4", 4), ("source", "u2"), ("id", "i8"),
        ("outline", "i2", (OUTLINE_VERTICES, 2)),
    ]
)  # fmt: skip
CELL_M = 5_000.0  # side of the squares that outlines are compared in: a city's worth fits in memory
OUTLINE = pa.schema([("source", pa.uint16()), ("id", pa.int64()), ("wkb", pa.binary())])

Rows = NDArray[np.void]
Key = tuple[int, int]


def squares(values_m: FloatArray, size_m: float) -> NDArray[np.int64]:
    """Whole numbers k with k size <= value < (k + 1) size, exactly, even where the quotient rounds up."""
    keys = np.floor(values_m / size_m)
    keys -= values_m < keys * size_m
    keys += values_m >= (keys + 1.0) * size_m
    return np.asarray(keys, dtype=np.int64)


def grown(box_m: Bounds, margin_m: float) -> Bounds:
    """The box with a margin all around."""
    west, south, east, north = box_m
    return west - margin_m, south - margin_m, east + margin_m, north + margin_m


def inside(rows: Rows, box_m: Bounds) -> NDArray[np.bool_]:
    """Which buildings have their centroid in a box, west and south edge included."""
    west, south, east, north = box_m
    x, y = rows["x"], rows["y"]
    return np.asarray((x >= west) & (x < east) & (y >= south) & (y < north))


def buildings_of(rows: Rows) -> Buildings:
    """The columns of the rows."""
    return Buildings(
        np.column_stack([rows["x"], rows["y"]]), np.ascontiguousarray(rows["area"]),
        np.ascontiguousarray(rows["shape"]), np.ascontiguousarray(rows["outline"]),
    )  # fmt: skip


def _groups(i: NDArray[np.int64], j: NDArray[np.int64]) -> Iterator[tuple[Key, NDArray[np.intp]]]:
    """Row numbers for each pair of keys."""
    order = np.lexsort((j, i))
    steps = np.flatnonzero((np.diff(i[order]) != 0) | (np.diff(j[order]) != 0)) + 1
    for rows in np.split(order, steps):
        if len(rows):
            yield (int(i[rows[0]]), int(j[rows[0]])), rows


class Spool:
    """Buildings in one file per tile (side ``tile_m``), and if asked for, outlines in one per cell."""

    def __init__(self, folder: Path, tile_m: float, with_outlines: bool) -> None:
        self.tile_m = tile_m
        self.with_outlines = with_outlines
        self._tiles = folder / "tiles"
        self._cells = folder / "cells"
        for part in (self._tiles, self._cells):
            part.mkdir()

    def add(self, rows: Rows, outlines: Geometries) -> None:
        """Append buildings; an outline goes into every cell that its bounds touch."""
        for key, group in _groups(squares(rows["x"], self.tile_m), squares(rows["y"], self.tile_m)):
            with _file(self._tiles, key).open("ab") as file:
                rows[group].tofile(file)
        if self.with_outlines and len(rows):
            self._add_outlines(rows, outlines)

    def _add_outlines(self, rows: Rows, outlines: Geometries) -> None:
        corners = squares(shapely.bounds(outlines), CELL_M)
        across = corners[:, 2:] - corners[:, :2] + 1
        copies = across.prod(axis=1)
        row = np.repeat(np.arange(len(rows)), copies)
        nth = np.arange(len(row)) - np.repeat(np.cumsum(copies) - copies, copies)
        wide = across[row, 0]
        wkb = shapely.to_wkb(outlines)
        for key, group in _groups(corners[row, 0] + nth % wide, corners[row, 1] + nth // wide):
            chosen = rows[row[group]]
            batch = pa.record_batch([chosen["source"], chosen["id"], wkb[row[group]]], schema=OUTLINE)
            with _file(self._cells, key).open("ab") as file, pa.ipc.new_stream(file, OUTLINE) as stream:
                stream.write_batch(batch)

    def tiles(self) -> list[Key]:
        """Keys of the tiles that own a building."""
        return _keys(self._tiles)

    def box_m(self, tile: Key) -> Bounds:
        """The ground of a tile."""
        i, j = tile
        return i * self.tile_m, j * self.tile_m, (i + 1) * self.tile_m, (j + 1) * self.tile_m

    def cells(self) -> list[Key]:
        """Keys of the cells with outlines."""
        return _keys(self._cells)

    def rows(self, box_m: Bounds) -> Rows:
        """The buildings in a box, in no particular order."""
        (i0, j0), (i1, j1) = squares(np.array(box_m).reshape(2, 2), self.tile_m).tolist()
        files = [_file(self._tiles, (i, j)) for i in range(i0, i1 + 1) for j in range(j0, j1 + 1)]
        parts = [np.fromfile(file, ROW) for file in files if file.is_file()]
        return np.concatenate([part[inside(part, box_m)] for part in parts] or [np.empty(0, ROW)])

    def outlines(self, cell: Key) -> tuple[NDArray[np.uint16], NDArray[np.int64], Geometries]:
        """Source, id and outline of the buildings whose bounds touch a cell."""
        tables = []
        path = _file(self._cells, cell)
        size = path.stat().st_size
        with path.open("rb") as file:
            while file.tell() < size:
                tables.append(pa.ipc.open_stream(file).read_all())
        table = pa.concat_tables(tables)
        return (
            table.column("source").to_numpy(), table.column("id").to_numpy(),
            np.asarray(shapely.from_wkb(table.column("wkb").to_numpy()), dtype=object),
        )  # fmt: skip


def _file(folder: Path, key: Key) -> Path:
    return folder / f"{key[0]}_{key[1]}"


def _keys(folder: Path) -> list[Key]:
    pairs = (path.name.split("_") for path in folder.iterdir())
    return sorted((int(i), int(j)) for i, j in pairs)
