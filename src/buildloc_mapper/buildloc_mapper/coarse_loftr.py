"""Coarse LoFTR (Kolkir/Coarse_LoFTR_TRT): which 16 px cells of two images show the same ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import ByteArray

from buildloc_mapper.matching import QUARTER_TURNS, Matches, fit_into, unfit
from buildloc_mapper.network import Network, NetworkError, Tensor

SIZE = (640, 480)
CELL_PX = 16
MIN_CONFIDENCE = 0.2  # LoFTR's own


@dataclass(frozen=True)
class Fitted:
    """A level image (h, w) uint8 in the size of the network's input, and by how much it was zoomed."""

    grey: ByteArray
    zoom: float

    @property
    def tensor(self) -> Tensor:
        """(1, 1, h, w) in 0..1, four times the memory: made only when it is needed."""
        return self.grey[None, None].astype(np.float32) / 255.0


def fitted(grey: ByteArray, size: tuple[int, int]) -> Fitted:
    """A level image as an input of a LoFTR of this size (width, height)."""
    return Fitted(*fit_into(grey, size))


class CoarseLoftr:
    """Both images go through the network together; nothing but the input is kept of each."""

    turns = QUARTER_TURNS

    def __init__(self, path: str) -> None:
        self._network = Network("coarse_loftr", path, 2, 1)
        if self._network.sides != SIZE[::-1]:
            raise NetworkError(f"{path}: input is not {SIZE[0]}x{SIZE[1]}; give the weights of Coarse LoFTR")

    def prepare(self, grey: ByteArray) -> Fitted:
        """The image as the network takes it."""
        return fitted(grey, SIZE)

    def match(self, earlier: Fitted, later: Fitted) -> Matches:
        """Cells that are each other's best."""
        confidence = self._network(earlier.tensor, later.tensor)[0][0]
        pairs = mutual_best(confidence)
        columns = SIZE[0] // CELL_PX
        # The feature of cell i is centred on pixel 16 i: every stride of the network keeps even pixels.
        one, other = (
            np.asarray(CELL_PX * np.column_stack([i % columns, i // columns]), dtype=np.float64)
            for i in pairs
        )
        cell = CELL_PX / min(earlier.zoom, later.zoom)
        return Matches(unfit(one, earlier.zoom), unfit(other, later.zoom), cell)


def mutual_best(confidence: Tensor) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], ...]:
    """Rows and columns of an (N, M) matrix whose entry is the largest of both, and large enough."""
    best = confidence.argmax(axis=1)
    rows = np.arange(len(best))
    kept = (confidence.argmax(axis=0)[best] == rows) & (confidence[rows, best] > MIN_CONFIDENCE)
    return rows[kept], best[kept]
