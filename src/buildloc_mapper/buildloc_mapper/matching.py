"""What a matching method is: features of one level image, and correspondences of two. SIFT is the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from buildloc_msgs_py.types import ByteArray, FloatArray
from numpy.typing import NDArray

CONTRAST = 0.04  # that a SIFT feature must have: of towns, and the noise has none of it
FAINT = 0.01  # of meadows, where few features have more
FEW = 500  # features with CONTRAST
QUARTER_TURNS: tuple[int, ...] = (0, 1, 2, 3)


@dataclass(frozen=True)
class Matches:
    """Corresponding pixels (N, 2) of two level images; each is right to about ``cell_px`` at best."""

    earlier_uv: FloatArray
    later_uv: FloatArray
    cell_px: float = 0.0


@dataclass(frozen=True)
class Described:
    """Keypoints (N, 2) in pixels of the level image, strongest first, and descriptors (N, D)."""

    uv: FloatArray
    descriptors: NDArray[Any]


class Method(Protocol):
    """A matching method. ``turns``: by how many quarter turns the later image may have to be turned."""

    turns: tuple[int, ...]

    def prepare(self, grey: ByteArray) -> Any:
        """Features of a level image (H, W) uint8, which :meth:`match` takes."""

    def match(self, earlier: Any, later: Any) -> Matches:
        """Correspondences of two images by their features."""


def fit_into(grey: ByteArray, size: tuple[int, int]) -> tuple[ByteArray, float]:
    """The image shrunk or enlarged into the top left of ``size`` (width, height), and by how much.

    The rest is filled with the image's mean, so that a network that normalises sees no other contrast.
    """
    zoom = min(size[0] / grey.shape[1], size[1] / grey.shape[0])
    shape = (min(size[0], round(grey.shape[1] * zoom)), min(size[1], round(grey.shape[0] * zoom)))
    method = cv2.INTER_AREA if zoom < 1.0 else cv2.INTER_LINEAR
    canvas = np.full((size[1], size[0]), round(float(grey.mean())), dtype=np.uint8)
    canvas[: shape[1], : shape[0]] = cv2.resize(grey, shape, interpolation=method)
    return canvas, zoom


def unfit(uv: FloatArray, zoom: float) -> FloatArray:
    """Pixels (N, 2) of a fitted image -> pixels of the image itself."""
    return np.asarray((uv + 0.5) / zoom - 0.5, dtype=np.float64)


class Sift:
    """SIFT with the ratio test. It knows no up: a turn of the camera is in its descriptors."""

    turns: tuple[int, ...] = (0,)

    def __init__(self, features: int, width_px: int, ratio: float) -> None:
        self._features, self._width_px, self._ratio = features, width_px, ratio

    def prepare(self, grey: ByteArray) -> Described:
        """The strongest features of the image, shrunk to ``width_px`` where it is wider; faint ones too where
        there are few others."""
        zoom = min(1.0, self._width_px / grey.shape[1])
        if zoom < 1.0:
            grey = np.asarray(
                cv2.resize(grey, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA), dtype=np.uint8
            )
        keypoints, descriptors = self._detect(grey, CONTRAST)
        if len(keypoints) < min(FEW, self._features):
            keypoints, descriptors = self._detect(grey, FAINT)
        if descriptors is None:
            return Described(np.empty((0, 2)), np.empty((0, 128), dtype=np.uint8))
        strongest = np.argsort([-k.response for k in keypoints], kind="stable")
        uv = unfit(np.array([k.pt for k in keypoints]), zoom)[strongest]
        return Described(
            uv, descriptors[strongest].astype(np.uint8)
        )  # whole numbers, a quarter of the memory

    def _detect(self, grey: ByteArray, contrast: float) -> tuple[Sequence[Any], NDArray[Any] | None]:
        sift = cv2.SIFT.create(nfeatures=self._features, contrastThreshold=contrast)
        keypoints, descriptors = sift.detectAndCompute(grey, None)
        return keypoints, descriptors

    def match(self, earlier: Described, later: Described) -> Matches:
        """Nearest neighbours that pass the ratio test, one to one."""
        if len(earlier.uv) < 2 or len(later.uv) < 2:
            return Matches(np.empty((0, 2)), np.empty((0, 2)))
        one, other = later.descriptors.astype(np.float32), earlier.descriptors.astype(np.float32)
        square = (other * other).sum(axis=1) - 2.0 * (one @ other.T)
        rows = np.arange(len(one))
        nearest = square.argmin(axis=1)
        length = (one * one).sum(axis=1)
        best = square[rows, nearest] + length
        square[rows, nearest] = np.inf
        second = square.min(axis=1) + length
        passed = np.flatnonzero(best < self._ratio**2 * second)
        passed = passed[np.argsort(best[passed], kind="stable")]
        _, first = np.unique(nearest[passed], return_index=True)
        kept = passed[first]
        return Matches(earlier.uv[nearest[kept]], later.uv[kept])
