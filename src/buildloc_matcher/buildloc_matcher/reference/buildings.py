"""Measured buildings, and where they came from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray

OUTLINE_VERTICES = 12
OUTLINE_UNIT_M = 0.1
FINEST_M = 0.2  # tolerance that outlines are simplified with, doubled until they have no more vertices


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
    and ``shapes`` (N, 4) float32 in the order of SHAPE_METRICS; ``outlines`` as :func:`stored_outlines` has
    them, or None where only centroids are known."""

    centroids_m: FloatArray
    areas_m2: NDArray[np.float32]
    shapes: NDArray[np.float32]
    outlines: NDArray[np.int16] | None = None

    def __len__(self) -> int:
        return len(self.areas_m2)

    def select(self, rows: NDArray[Any]) -> Buildings:
        """The buildings of these rows (indices or a mask), in that order."""
        outlines = None if self.outlines is None else self.outlines[rows]
        return Buildings(self.centroids_m[rows], self.areas_m2[rows], self.shapes[rows], outlines)


def stored_outlines(polygons: NDArray[np.object_], centroids_m: FloatArray) -> NDArray[np.int16]:
    """(N, OUTLINE_VERTICES, 2) counter-clockwise vertices of N valid polygons about their centroids (N, 2),
    in units of OUTLINE_UNIT_M; the last one is repeated where there are fewer. Courtyards are left out.

    An outline with more vertices is simplified until it fits; one too wide for the unit is all zero.
    """
    rings = shapely.get_exterior_ring(shapely.normalize(polygons))  # which makes them clockwise
    tolerance, many = FINEST_M, np.ones(len(rings), dtype=bool)
    while many.any():
        rings[many] = shapely.simplify(rings[many], tolerance)
        many = shapely.get_num_coordinates(rings) > OUTLINE_VERTICES + 1
        tolerance *= 2.0
    counts = shapely.get_num_coordinates(rings)
    last = np.cumsum(counts) - 1
    rows = last[:, None] - np.minimum(np.arange(OUTLINE_VERTICES), counts[:, None] - 2)
    about = (shapely.get_coordinates(rings)[rows] - centroids_m[:, None]) / OUTLINE_UNIT_M
    fits = np.abs(about).max(axis=(1, 2), initial=0.0) <= np.iinfo(np.int16).max
    return np.where(fits[:, None, None], np.rint(about), 0.0).astype(np.int16)


def no_buildings() -> Buildings:
    """Zero buildings."""
    outlines = np.empty((0, OUTLINE_VERTICES, 2), dtype=np.int16)
    return Buildings(
        np.empty((0, 2)), np.empty(0, dtype=np.float32), np.empty((0, 4), dtype=np.float32), outlines
    )


def concatenate(parts: Sequence[Buildings]) -> Buildings:
    """All buildings of the parts, in order; without outlines where a part has none."""
    parts = parts or [no_buildings()]
    outlines = [p.outlines for p in parts if p.outlines is not None]
    return Buildings(
        np.concatenate([p.centroids_m for p in parts]),
        np.concatenate([p.areas_m2 for p in parts]),
        np.concatenate([p.shapes for p in parts]),
        np.concatenate(outlines) if len(outlines) == len(parts) else None,
    )
