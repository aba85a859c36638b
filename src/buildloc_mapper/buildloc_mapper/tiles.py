"""The pixel grid of the map in square tiles: a dict of those that hold anything, read by boxes of pixels.

Pixel (column c, row r) covers x from ``c gsd`` to ``(c + 1) gsd`` and y from ``-(r + 1) gsd`` to
``-r gsd`` of ``buildloc_map``, so the grid does not depend on what was flown. Tile (i, j) holds columns
from ``i TILE_PX`` and rows from ``j TILE_PX``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

TILE_PX = 256
Tile = tuple[int, int]
Counts = NDArray[np.uint16]


class Piece(NamedTuple):
    """What a box and a tile have in common: where it is in the tile's array and in the box's."""

    tile: Tile
    in_tile: tuple[slice, slice]
    in_box: tuple[slice, slice]


class Box(NamedTuple):
    """Pixels of the grid, half open."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return self.bottom - self.top, self.right - self.left

    def grown(self, pixels: int) -> Box:
        """The box with so many pixels more on every side."""
        return Box(self.left - pixels, self.top - pixels, self.right + pixels, self.bottom + pixels)

    def pieces(self) -> Iterator[Piece]:
        """The box cut along the tiles."""
        for j in range(self.top // TILE_PX, (self.bottom - 1) // TILE_PX + 1):
            for i in range(self.left // TILE_PX, (self.right - 1) // TILE_PX + 1):
                x, y = i * TILE_PX, j * TILE_PX
                left, right = max(self.left, x), min(self.right, x + TILE_PX)
                top, bottom = max(self.top, y), min(self.bottom, y + TILE_PX)
                yield Piece(
                    (i, j),
                    np.s_[top - y : bottom - y, left - x : right - x],
                    np.s_[top - self.top : bottom - self.top, left - self.left : right - self.left],
                )


def read(tiles: Mapping[Tile, Counts], box: Box) -> Counts:
    """(2, rows, columns) counts of a box, zero where there is no tile."""
    found = np.zeros((2, *box.shape), dtype=np.uint16)
    for tile, in_tile, in_box in box.pieces():
        if tile in tiles:
            found[:, *in_box] = tiles[tile][:, *in_tile]
    return found
