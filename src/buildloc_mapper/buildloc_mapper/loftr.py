"""Full LoFTR in ONNX, weights brought by the user: two images in, corresponding pixels out."""

from __future__ import annotations

import numpy as np
from buildloc_msgs_py.types import ByteArray

from buildloc_mapper.coarse_loftr import MIN_CONFIDENCE, SIZE, Fitted, fitted
from buildloc_mapper.matching import QUARTER_TURNS, Matches, unfit
from buildloc_mapper.network import Network, NetworkError


class Loftr:
    """Two (1, 1, h, w) inputs, grey in 0..1; outputs (N, 2) and (N, 2) pixels u, v, and (N,) confidences."""

    turns = QUARTER_TURNS

    def __init__(self, path: str) -> None:
        self._path = path
        self._network = Network("loftr", path, 2, 3)
        height, width = self._network.sides
        self._size = (width or SIZE[0], height or SIZE[1])

    def prepare(self, grey: ByteArray) -> Fitted:
        """The image as the network takes it."""
        return fitted(grey, self._size)

    def match(self, earlier: Fitted, later: Fitted) -> Matches:
        """The correspondences that the network is sure of."""
        one, other, confidence = self._network(earlier.tensor, later.tensor)[:3]
        if one.ndim != 2 or one.shape[1:] != (2,) or one.shape != other.shape or len(one) != confidence.size:
            raise NetworkError(
                f"{self._path}: outputs {one.shape}, {other.shape}, {confidence.shape} are not "
                "(N, 2), (N, 2), (N,); export it as docs/mapping.md says"
            )
        sure = confidence.ravel() > MIN_CONFIDENCE
        return Matches(
            unfit(one[sure].astype(np.float64), earlier.zoom),
            unfit(other[sure].astype(np.float64), later.zoom),
        )
