"""How a large image is covered by smaller windows that overlap."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Block:
    """A window of an image, and the part of it (left, top, right, bottom; pixels of the image) whose
    buildings are its own. The parts of all blocks share out the plane."""

    rows: slice
    columns: slice
    own: tuple[float, float, float, float]

    @property
    def is_all(self) -> bool:
        """Whether it is the only one of its image."""
        return all(math.isinf(side) for side in self.own)

    def own_in_window(self, zoom: float) -> tuple[float, float, float, float]:
        """``own`` in pixels of the window, magnified by ``zoom``."""
        left, top, right, bottom = self.own
        x, y = self.columns.start, self.rows.start
        return (left - x) * zoom, (top - y) * zoom, (right - x) * zoom, (bottom - y) * zoom


def starts(size: int, tile: int, overlap: int) -> list[int]:
    """Where tiles begin so that they cover ``size`` pixels and overlap by at least ``overlap``."""
    count = math.ceil(max(size - overlap, 1) / (tile - overlap)) if size > tile else 1
    return [round(start) for start in np.linspace(0, size - tile, count)]


def _spans(size: int, tile: int, overlap: int) -> list[tuple[slice, float, float]]:
    tile = min(tile, size)
    begins = starts(size, tile, overlap)
    borders = [(a + tile + b) / 2.0 for a, b in itertools.pairwise(begins)]
    return [
        (slice(begin, begin + tile), low, high)
        for begin, low, high in zip(begins, [-math.inf, *borders], [*borders, math.inf], strict=True)
    ]


def blocks(height: int, width: int, side: int, overlap: int) -> Iterator[Block]:
    """Blocks of ``side`` pixels that cover an image and overlap; one when it is no larger."""
    for rows, top, bottom in _spans(height, side, overlap):
        for columns, left, right in _spans(width, side, overlap):
            yield Block(rows, columns, (left, top, right, bottom))
