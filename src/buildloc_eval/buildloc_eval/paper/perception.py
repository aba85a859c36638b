"""What a segmenter makes of the buildings of a flight: errors that stay, and those of a frame.

:class:`Seen` is all that the flights need of an error model; :func:`perceive` is a plain one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import shapely
from buildloc_msgs_py.types import ByteArray, FloatArray
from numpy.typing import NDArray

from buildloc_eval.paper.differences import AutomaticMapping, merged

Outlines = NDArray[np.object_]
GAP_M = 0.4  # between touching buildings of the segmenter's masks
FRACTION_BITS = 4


class Seen(Protocol):
    """The buildings of a town as one flight finds them."""

    def frame(
        self, to_pixels: FloatArray, size: tuple[int, int], gsd_m: float, rng: np.random.Generator
    ) -> ByteArray:
        """(H, W) mask, 0 or 255, of ``size`` (width, height), of one frame with errors of its own.
        ``to_pixels`` (3, 3) takes metres (x, y, 1) to pixels, centres at whole numbers."""


# Outlines (N,) in metres, the ground that is flown over, a generator of the flight's errors.
Perceive = Callable[[Outlines, shapely.Polygon, np.random.Generator], Seen]


@dataclass(frozen=True)
class PerceptionErrors:
    """Shares of buildings never found and merged with a neighbour, false ones per km2 and their median area;
    standard deviations of a building's place per axis, of its log area and of its corners, which stay; share
    missed in a frame, and what its place changes from frame to frame. The network on ground it never saw."""

    missed: float = 0.10
    merged: float = 0.06
    false_per_km2: float = 120.0
    false_area_m2: float = 60.0
    centroid_m: float = 0.8
    log_area: float = 0.20
    corner_m: float = 0.5
    flicker: float = 0.08
    false_flicker: float = 0.5
    frame_m: float = 0.3


# Residual snow on the ground (flight 7): patches as large as roofs, which stay for the frames that see them.
SNOW = PerceptionErrors(false_per_km2=300.0, false_area_m2=90.0, false_flicker=0.3, missed=0.14)


@dataclass(frozen=True)
class SeenBuildings:
    """Outlines (M,) with the errors that stay, the probability (M,) that a frame misses each, and how far a
    frame moves them."""

    outlines: Outlines
    flicker: FloatArray
    frame_m: float

    def frame(
        self, to_pixels: FloatArray, size: tuple[int, int], gsd_m: float, rng: np.random.Generator
    ) -> ByteArray:
        """As :meth:`Seen.frame`."""
        # All is drawn before the choice of what is in view: a frame's errors are those of its generator.
        shown = rng.random(len(self.outlines)) >= self.flicker
        moved = rng.normal(0.0, self.frame_m, (len(self.outlines), 2))
        mask = np.zeros((size[1], size[0]), dtype=np.uint8)
        points, of = shapely.get_coordinates(shapely.get_exterior_ring(self.outlines), return_index=True)
        image = np.column_stack([points + moved[of], np.ones(len(points))]) @ to_pixels.T
        pixels = image[:, :2] / image[:, 2:]
        inside = np.all((pixels > -1.0) & (pixels < size), axis=1)
        in_view = np.zeros(len(self.outlines), dtype=bool)
        in_view[of[inside]] = True
        first = np.searchsorted(of, np.arange(len(self.outlines) + 1))
        fixed = np.round(np.clip(pixels, -4e3, 2e4) * 2**FRACTION_BITS).astype(np.int32)
        wide = max(1, round(GAP_M / gsd_m))
        for k in np.flatnonzero(in_view & shown):
            ring = [fixed[first[k] : first[k + 1]]]
            cv2.polylines(mask, ring, True, 0, 2 * wide + 1, cv2.LINE_8, FRACTION_BITS)
            cv2.fillPoly(mask, ring, 255, cv2.LINE_8, FRACTION_BITS)
        return mask


def perceive(
    outlines: Outlines, errors: PerceptionErrors, ground: shapely.Polygon, rng: np.random.Generator
) -> SeenBuildings:
    """The buildings (N,) of a town in metres as one flight over ``ground`` finds them."""
    kept = outlines[rng.random(len(outlines)) >= errors.missed]
    found = merged(kept, AutomaticMapping(merged=errors.merged, merge_reach_m=4.0), rng)
    true = _bent(found, errors, rng)
    per_km2 = errors.false_per_km2 / (1.0 - errors.false_flicker)
    false = _false(per_km2 * ground.area / 1e6, errors.false_area_m2, ground, rng)
    flicker = np.repeat([errors.flicker, errors.false_flicker], [len(true), len(false)])
    return SeenBuildings(np.concatenate([true, false]), flicker, errors.frame_m)


def _bent(outlines: Outlines, errors: PerceptionErrors, rng: np.random.Generator) -> Outlines:
    """Moved, resized, and every corner moved by itself."""
    points, of = shapely.get_coordinates(shapely.get_exterior_ring(outlines), return_index=True)
    centres = shapely.get_coordinates(shapely.centroid(outlines))
    zoom = np.exp(0.5 * rng.normal(0.0, errors.log_area, len(outlines)))
    moved = rng.normal(0.0, errors.centroid_m, centres.shape)
    bent = (points - centres[of]) * zoom[of, None] + (centres + moved)[of]
    bent += rng.normal(0.0, errors.corner_m, bent.shape)
    last = np.searchsorted(of, np.arange(len(outlines)), side="right") - 1
    bent[last] = bent[np.searchsorted(of, np.arange(len(outlines)))]
    return np.asarray(shapely.polygons(shapely.linearrings(bent, indices=of)))


def _false(count: float, area_m2: float, ground: shapely.Polygon, rng: np.random.Generator) -> Outlines:
    """Rectangles at any heading anywhere over the ground."""
    number = int(rng.poisson(count))
    west, south, east, north = ground.bounds
    centre = np.column_stack([rng.uniform(west, east, number), rng.uniform(south, north, number)])
    size = np.sqrt(area_m2 * np.exp(rng.normal(0.0, 0.5, number)))
    aspect, heading = rng.uniform(1.0, 1.6, number), rng.uniform(0.0, math.pi, number)
    box = np.array([-0.5 - 0.5j, 0.5 - 0.5j, 0.5 + 0.5j, -0.5 + 0.5j])
    corners = (box.real[None] * aspect[:, None] + 1j * box.imag[None] / aspect[:, None]) * size[:, None]
    corners = corners * np.exp(1j * heading)[:, None] + (centre @ (1.0, 1.0j))[:, None]
    return np.asarray(shapely.polygons(np.stack([corners.real, corners.imag], axis=2)), dtype=object)
