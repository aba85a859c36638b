"""What a building footprint is: one function for reference and query alike."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import FloatArray

SHAPE_METRICS = ("compactness", "elongation", "rectangularity", "convexity")


@dataclass(frozen=True)
class Footprint:
    """Centroid and area of an outline in metres, and its four shape metrics (Table I), each in [0, 1]."""

    x_m: float
    y_m: float
    area_m2: float
    compactness: float
    elongation: float
    rectangularity: float
    convexity: float

    @property
    def shape(self) -> tuple[float, float, float, float]:
        """The four metrics in the order of SHAPE_METRICS."""
        return self.compactness, self.elongation, self.rectangularity, self.convexity


@dataclass(frozen=True)
class Footprints:
    """N measured outlines: centroids (N, 2) and areas (N,) in metres, shapes (N, 4) as SHAPE_METRICS."""

    centroids_m: FloatArray
    areas_m2: FloatArray
    shapes: FloatArray


def _rectangle_sides(hulls: NDArray[np.object_]) -> FloatArray:
    """(N, 2) short and long side of the rotated rectangle of minimum area around each convex polygon.

    One side of that rectangle lies on an edge of the hull. GEOS knows this too, but works on absolute
    coordinates, which in UTM costs it up to several percent of the area of a thin outline, and breaks ties
    (every triangle is one) by rounding. Here the sides do not depend on where the outline lies or how
    it is turned: among rectangles equal to a millionth the longest one counts.
    """
    counts = shapely.get_num_coordinates(hulls) - 1
    xy = shapely.get_coordinates(hulls)
    first = np.cumsum(counts + 1) - counts - 1
    sides = np.empty((len(hulls), 2))
    for count in np.unique(counts):
        rows = np.flatnonzero(counts == count)
        ring = xy[first[rows][:, None] + np.arange(count + 1)]
        ring -= ring[:, :1]
        edges = np.diff(ring, axis=1)
        edges /= np.linalg.norm(edges, axis=2, keepdims=True)
        x, y = ring[..., 0], ring[..., 1]
        spans = np.empty((len(rows), count, 2))
        for k in range(count):
            cosine, sine = edges[:, k, :1], edges[:, k, 1:]
            spans[:, k, 0] = np.ptp(x * cosine + y * sine, axis=1)
            spans[:, k, 1] = np.ptp(y * cosine - x * sine, axis=1)
        area = spans.prod(axis=2)
        longest = np.where(area <= area.min(axis=1, keepdims=True) * (1.0 + 1e-6), spans.max(axis=2), 0.0)
        sides[rows] = np.sort(spans[np.arange(len(rows)), longest.argmax(axis=1)], axis=1)
    return sides


def footprints(outlines: NDArray[np.object_]) -> Footprints:
    """Measure N valid polygons given in metres, holes included.

    compactness 4 pi A / L^2, elongation w_min / w_max and rectangularity A / (w_min w_max) of the
    rotated rectangle of minimum area, convexity A / A_hull (Table "Star descriptor features").

    Raises BuildlocError when an outline is empty or without area. Validity is the caller's business:
    testing it takes as long as any of the measures.
    """
    areas = shapely.area(outlines)
    if not np.all(areas > 0.0):
        raise BuildlocError("footprint outline is empty or has no area; repair it before measuring")
    hulls = shapely.convex_hull(outlines)
    w_min, w_max = _rectangle_sides(hulls).T
    shapes = np.column_stack(
        [
            4.0 * math.pi * areas / shapely.length(outlines) ** 2,
            w_min / w_max,
            areas / (w_min * w_max),
            areas / shapely.area(hulls),
        ]
    )
    return Footprints(shapely.get_coordinates(shapely.centroid(outlines)), areas, np.minimum(shapes, 1.0))


def footprint(outline: Polygon) -> Footprint:
    """Measure one outline given in metres as :func:`footprints` does.

    Raises BuildlocError when the outline is empty, invalid or without area.
    """
    if not outline.is_valid:
        raise BuildlocError("footprint outline is invalid; repair it before measuring")
    found = footprints(np.array([outline], dtype=object))
    x_m, y_m = found.centroids_m[0].tolist()
    compactness, elongation, rectangularity, convexity = found.shapes[0].tolist()
    area_m2 = float(found.areas_m2[0])
    return Footprint(x_m, y_m, area_m2, compactness, elongation, rectangularity, convexity)
