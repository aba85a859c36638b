"""Measured buildings, and where they came from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray


@dataclass(frozen=True)
class SourceRecord:
    """One input of a database: ``read`` counts the geometries it held."""

    path: str
    licence: str
    sha256: str
    read: int


@dataclass(frozen=True)
class Buildings:
    """N buildings in metres of a UTM zone: ``centroids_m`` (N, 2) float64 east, north; ``areas_m2`` (N,)
    and ``shapes`` (N, 4) float32 in the order of SHAPE_METRICS."""

    centroids_m: FloatArray
    areas_m2: NDArray[np.float32]
    shapes: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.areas_m2)

    def select(self, rows: NDArray[Any]) -> Buildings:
        """The buildings of these rows (indices or a mask), in that order."""
        return Buildings(self.centroids_m[rows], self.areas_m2[rows], self.shapes[rows])


def no_buildings() -> Buildings:
    """Zero buildings."""
    return Buildings(np.empty((0, 2)), np.empty(0, dtype=np.float32), np.empty((0, 4), dtype=np.float32))


def concatenate(parts: Sequence[Buildings]) -> Buildings:
    """All buildings of the parts, in order."""
    parts = parts or [no_buildings()]
    return Buildings(
        np.concatenate([p.centroids_m for p in parts]),
        np.concatenate([p.areas_m2 for p in parts]),
        np.concatenate([p.shapes for p in parts]),
    )
