"""Which keyframes look alike, whatever their heading and wherever they are: a guess that costs little."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from buildloc_mapper.matching import Described

LANDMARKS = 64  # features that stand for a keyframe
DIMENSIONS = 32  # of each, of SIFT's 128
FIRST_CAPACITY = 64


def _projection() -> NDArray[np.float32]:
    """(128, DIMENSIONS) of orthonormal columns: distances are kept well enough for a guess."""
    square = np.random.default_rng(0).normal(size=(128, 128))
    return np.linalg.qr(square)[0][:, :DIMENSIONS].astype(np.float32)


PROJECTION = _projection()


def signature(described: Described) -> NDArray[np.float32]:
    """(K, DIMENSIONS), K <= LANDMARKS: the strongest SIFT features (unit RootSIFT, projected)."""
    strongest = described.descriptors[:LANDMARKS].astype(np.float32)
    root = np.sqrt(strongest / np.maximum(strongest.sum(axis=1, keepdims=True), 1.0))
    return np.asarray(root @ PROJECTION, dtype=np.float32)


class Appearance:
    """Signatures of keyframes 0, 1, 2, ... in one array, so that all are compared in one product."""

    def __init__(self) -> None:
        self._rows = np.empty((FIRST_CAPACITY, LANDMARKS, DIMENSIONS), dtype=np.float32)
        self._count = 0

    def add(self, of_keyframe: NDArray[np.float32]) -> None:
        """Keep the signature of the next keyframe."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
        row = self._rows[self._count]
        row[:] = 1e3  # a missing feature is far from all
        row[: len(of_keyframe)] = of_keyframe
        self._count += 1

    def alike(self, of_keyframe: NDArray[np.float32], among: NDArray[np.int64]) -> NDArray[np.int64]:
        """Keyframes ``among`` (M,), those first that have the nearest of the most features."""
        rows = self._rows[among].reshape(-1, DIMENSIONS)
        square = (rows * rows).sum(axis=1) - 2.0 * (of_keyframe @ rows.T)
        votes = np.bincount(square.argmin(axis=1) // LANDMARKS, minlength=len(among))
        return among[np.argsort(-votes, kind="stable")]
