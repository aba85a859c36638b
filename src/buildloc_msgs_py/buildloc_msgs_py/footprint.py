"""What a building footprint is: one function for reference and query alike."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import Polygon

from buildloc_msgs_py.errors import BuildlocError

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


def footprint(outline: Polygon) -> Footprint:
    """Measure an outline given in metres.

    compactness 4 pi A / L^2, elongation w_min / w_max and rectangularity A / (w_min w_max) of the
    minimum rotated rectangle, convexity A / A_hull (Table "Star descriptor features").

    Raises BuildlocError when the outline is empty, invalid or without area.
    """
    area = float(outline.area)
    if outline.is_empty or not outline.is_valid or not area > 0.0:
        raise BuildlocError("footprint outline is empty, invalid or has no area; repair it before measuring")
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(outline))[:3]
    sides = np.hypot(*np.diff(corners, axis=0).T)
    w_min, w_max = float(sides.min()), float(sides.max())
    perimeter = float(outline.length)
    return Footprint(
        x_m=float(outline.centroid.x),
        y_m=float(outline.centroid.y),
        area_m2=area,
        compactness=min(1.0, 4.0 * math.pi * area / perimeter**2),
        elongation=w_min / w_max,
        rectangularity=min(1.0, area / (w_min * w_max)),
        convexity=min(1.0, area / float(outline.convex_hull.area)),
    )
