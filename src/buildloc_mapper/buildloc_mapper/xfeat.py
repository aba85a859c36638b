"""XFeat (verlab/accelerated_features): keypoints and descriptors of one image, decoded without torch."""

from __future__ import annotations

import cv2
import numpy as np
from buildloc_msgs_py.types import ByteArray, FloatArray
from numpy.typing import NDArray

from buildloc_mapper.matching import QUARTER_TURNS, Described, Matches, fit_into, unfit
from buildloc_mapper.network import Network, NetworkError, Tensor

SIDE_PX = 640
CELL_PX = 8
MIN_SCORE = 0.05  # XFeat's own: probability of a keypoint, and cosine of a match
MIN_COSINE = 0.82
NMS = np.ones((5, 5), np.uint8)


class XFeat:
    """Upright features: a turned camera is found by turning the image."""

    turns = QUARTER_TURNS

    def __init__(self, path: str, features: int) -> None:
        self._features = features
        self._network = Network("xfeat", path, 1, 3)
        if self._network.sides != (SIDE_PX, SIDE_PX):
            raise NetworkError(f"{path}: input is not {SIDE_PX}x{SIDE_PX}; export XFeat for that size")

    def prepare(self, grey: ByteArray) -> Described:
        """The strongest keypoints of the image, fitted into the network's input."""
        fitted, zoom = fit_into(grey, (SIDE_PX, SIDE_PX))
        tensor = np.repeat(fitted[None, None].astype(np.float32) / 255.0, 3, axis=1)
        descriptors, logits, reliability = self._network(tensor)[:3]
        uv, scores = keypoints(logits[0])
        inside = (uv < np.array(grey.shape[::-1]) * zoom - 1).all(axis=1)
        uv, scores = uv[inside], scores[inside]
        scores = scores * sample(reliability[0], uv)[:, 0]
        strongest = np.argsort(-scores, kind="stable")[: self._features]
        uv = uv[strongest]
        described = sample(descriptors[0], uv)
        described /= np.maximum(np.linalg.norm(described, axis=1, keepdims=True), 1e-9)
        return Described(unfit(uv, zoom), described.astype(np.float16))

    def match(self, earlier: Described, later: Described) -> Matches:
        """Mutual nearest neighbours that are alike."""
        if not len(earlier.uv) or not len(later.uv):
            return Matches(np.empty((0, 2)), np.empty((0, 2)))
        cosine = later.descriptors.astype(np.float32) @ earlier.descriptors.astype(np.float32).T
        nearest = cosine.argmax(axis=1)
        rows = np.arange(len(nearest))
        mutual = (cosine.argmax(axis=0)[nearest] == rows) & (cosine[rows, nearest] > MIN_COSINE)
        return Matches(earlier.uv[nearest[mutual]], later.uv[mutual])


def keypoints(logits: Tensor) -> tuple[FloatArray, NDArray[np.float32]]:
    """(65, h, w) logits, 8x8 pixels of each cell and "none" -> (N, 2) pixels and their (N,) scores."""
    exponents = np.exp(logits - logits.max(axis=0))
    cells = (exponents / exponents.sum(axis=0))[:-1]
    height, width = cells.shape[1:]
    heat = cells.reshape(CELL_PX, CELL_PX, height, width).transpose(2, 0, 3, 1)
    heat = np.ascontiguousarray(heat.reshape(height * CELL_PX, width * CELL_PX))
    peak = (heat == cv2.dilate(heat, NMS)) & (heat > MIN_SCORE)
    row, column = np.nonzero(peak)
    return np.column_stack([column, row]).astype(np.float64), heat[row, column]


def sample(planes: Tensor, uv: FloatArray) -> Tensor:
    """(C, h, w) planes of cells at image pixels (N, 2), linearly interpolated -> (N, C)."""
    height, width = planes.shape[1:]
    at = np.clip((uv + 0.5) / CELL_PX - 0.5, 0.0, [width - 1.0, height - 1.0])
    low = np.minimum(at.astype(int), [width - 2, height - 2])
    (x, y), (fx, fy) = low.T, (at - low).T
    top = planes[:, y, x] * (1 - fx) + planes[:, y, x + 1] * fx
    bottom = planes[:, y + 1, x] * (1 - fx) + planes[:, y + 1, x + 1] * fx
    return np.asarray((top * (1 - fy) + bottom * fy).T, dtype=np.float32)
