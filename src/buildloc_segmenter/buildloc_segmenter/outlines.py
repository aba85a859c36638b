"""From labels to polygons: outlines below the pixel, simplified, with right angles where walls have them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray
from scipy import ndimage
from shapely.affinity import affine_transform, translate
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from buildloc_segmenter.instances import Instances

FINER = 4  # outlines are traced on a raster so much finer than the labels
SIMPLIFY_M = 0.5  # how far an outline may lie from the traced one
SNAP_RAD = math.radians(20.0)  # walls this close to the building's axes are taken to run along them
MIN_SNAPPED = 0.75  # share of the outline that must do so
MIN_IOU = 0.9  # of the outline with right angles and the traced one


@dataclass(frozen=True)
class Building:
    """A building of an image.

    ``outline`` in pixels of the image, x right, y down, (0, 0) the outer corner of the first pixel;
    courtyards are filled. ``area_m2`` that of the outline. ``score`` as Instances.scores.
    """

    outline: Polygon
    area_m2: float
    score: float

    def moved(self, x: float, y: float) -> Building:
        """The same building in an image whose pixel (x, y) is the first of this one."""
        return replace(self, outline=translate(self.outline, x, y))


@dataclass(frozen=True)
class Wall:
    """A straight part of an outline: a point on it, its direction, and the length it was seen over."""

    point: FloatArray
    direction: FloatArray
    length: float
    snapped: bool


def buildings(instances: Instances, pixel_m: float) -> list[Building]:
    """The buildings with their outlines in pixels of an image of ``pixel_m`` metres per pixel."""
    scale = instances.gsd_m / pixel_m
    # A pixel of ground all around: outlines end at the image's edge, and every window can take one more.
    margin, labels = np.pad(instances.margin(), 1, mode="edge"), np.pad(instances.labels, 1)
    found = []
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        if box is None:
            continue
        top, left = (side.start - 1 for side in box)
        window = np.s_[top : box[0].stop + 1, left : box[1].stop + 1]
        inside = labels[window] == number
        outline = trace(np.where(inside, margin[window], -margin[window]), SIMPLIFY_M / instances.gsd_m)
        if outline is None:
            continue
        placed = affine_transform(outline, [scale, 0.0, 0.0, scale, (left - 1) * scale, (top - 1) * scale])
        score = float(instances.scores[number - 1])
        found.append(Building(placed, placed.area * pixel_m**2, score))
    return found


def trace(field: NDArray[np.float32], tolerance: float) -> Polygon | None:
    """The outline of the largest part where ``field`` (h, w) is positive, in its pixels; None: no area.

    The field is negative along its border. ``tolerance`` in pixels.
    """
    fine = cv2.resize(field, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LINEAR)
    contours, _ = cv2.findContours((fine > 0.0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    contour = max(contours, key=cv2.contourArea)
    points = contour[:, 0].astype(np.float64)
    corners = cv2.approxPolyDP(contour, tolerance * FINER, True)
    at = np.sort([int(np.flatnonzero((contour == corner).all(axis=(1, 2)))[0]) for corner in corners])
    if len(at) < 3:
        return None
    raw = _largest(Polygon(points).buffer(0.0))
    outline = square(points, at, tolerance * FINER)
    if outline is None or raw is None or _iou(outline, raw) < MIN_IOU:
        outline = Polygon(points[at])
    # Contours run through pixel centres: half a (fine) pixel outwards is the pixels' own outline.
    grown = _largest(outline.buffer(0.5, join_style="mitre"))
    if grown is None:
        return None
    step = 1.0 / FINER
    return affine_transform(grown, [step, 0.0, 0.0, step, 0.5 * step, 0.5 * step])


def square(points: FloatArray, corners: NDArray[np.int64], tolerance: float) -> Polygon | None:
    """An outline with right angles, or None when its walls do not run along two axes.

    ``points`` (N, 2) trace the outline, ``corners`` (K,) are the indices between its walls. Walls close to
    the axes are turned into them about their middle, others keep their direction; where two meet is a corner.
    Walls along one axis that are less than ``tolerance`` out of line become one.
    """
    closed = np.vstack([points, points[: corners[0] + 1]])
    parts = [closed[i : j + 1] for i, j in itertools.pairwise([*corners, len(points) + corners[0]])]
    lengths = np.array([math.dist(part[0], part[-1]) for part in parts])
    angles = np.array([_angle(part) for part in parts])
    axis = float(np.angle(np.sum(lengths * np.exp(4j * angles)))) / 4.0
    turns = np.round((angles - axis) / (math.pi / 2.0))
    snapped = np.abs(angles - axis - turns * (math.pi / 2.0)) <= SNAP_RAD
    if lengths[snapped].sum() < MIN_SNAPPED * lengths.sum():
        return None
    angles = np.where(snapped, axis + turns * (math.pi / 2.0), angles)
    walls = [
        Wall(_middle(part).mean(axis=0), np.array([math.cos(angle), math.sin(angle)]), length, along_axis)
        for part, angle, length, along_axis in zip(parts, angles, lengths, snapped, strict=True)
    ]
    return _meet(_in_line(walls, tolerance))


def _middle(part: FloatArray) -> FloatArray:
    """A wall's points (N, 2) without its ends, which lie on rounded corners."""
    cut = len(part) // 8
    return part[cut : len(part) - cut]


def _angle(part: FloatArray) -> float:
    """Direction of the line through a wall's points (N, 2), from the first to the last."""
    middle = _middle(part)
    _, _, (axis, *_) = np.linalg.svd(middle - middle.mean(axis=0), full_matrices=False)
    forward = axis if np.dot(axis, part[-1] - part[0]) >= 0.0 else -axis
    return math.atan2(forward[1], forward[0])


def _cross(a: FloatArray, b: FloatArray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _in_line(walls: list[Wall], tolerance: float) -> list[Wall]:
    """Joins neighbours in line; puts a step at right angles between neighbours side by side."""
    joined: list[Wall] = []
    for wall in walls:
        if joined and _one_line(joined[-1], wall, tolerance):
            joined[-1] = _join(joined[-1], wall)
        else:
            joined.append(wall)
    while len(joined) > 1 and _one_line(joined[-1], joined[0], tolerance):
        joined[0] = _join(joined.pop(), joined[0])
    stepped: list[Wall] = []
    for wall, following in zip(joined, [*joined[1:], *joined[:1]], strict=True):
        stepped.append(wall)
        if abs(_cross(wall.direction, following.direction)) < math.sin(SNAP_RAD):
            # Half way between the two middles, moved by their lengths to where one ends and the next begins.
            along = wall.direction
            where = 0.5 * (
                np.dot(wall.point, along) + 0.5 * wall.length + np.dot(following.point, along)
                - math.copysign(0.5, np.dot(along, following.direction)) * following.length
            )  # fmt: skip
            across = np.array([-along[1], along[0]])
            point = along * where + across * np.dot(0.5 * (wall.point + following.point), across)
            stepped.append(Wall(point, across, 0.0, wall.snapped))
    return stepped


def _one_line(a: Wall, b: Wall, tolerance: float) -> bool:
    parallel = a.snapped and b.snapped and float(np.dot(a.direction, b.direction)) > 0.5
    return parallel and abs(_cross(a.direction, b.point - a.point)) < tolerance


def _join(a: Wall, b: Wall) -> Wall:
    length = a.length + b.length
    return Wall((a.point * a.length + b.point * b.length) / max(length, 1e-9), a.direction, length, True)


def _meet(walls: list[Wall]) -> Polygon | None:
    """The polygon of the points where each wall meets the next; None when there is none."""
    corners = []
    for a, b in zip(walls, [*walls[1:], *walls[:1]], strict=True):
        across = _cross(a.direction, b.direction)
        if abs(across) < 1e-6:
            return None
        corners.append(a.point + a.direction * (_cross(b.point - a.point, b.direction) / across))
    polygon = Polygon(corners) if len(corners) >= 3 else None
    return polygon if polygon is not None and polygon.is_valid else None


def _largest(geometry: BaseGeometry) -> Polygon | None:
    """The largest polygon of a geometry; None when it has none."""
    polygons = [part for part in getattr(geometry, "geoms", [geometry]) if isinstance(part, Polygon)]
    largest = max(polygons, key=lambda part: part.area, default=None)
    return Polygon(largest.exterior) if largest is not None and largest.area > 0.0 else None


def _iou(a: Polygon, b: Polygon) -> float:
    either = a.union(b).area
    return float(a.intersection(b).area / either) if either > 0.0 else 0.0
