"""What a segmenter does to buildings: measured on real ground it never saw, and done to simulated ones.

`buildloc eval segmentation --write-errors` measures; the file that ships is what simulated flights use.
"""

from __future__ import annotations

import importlib.resources
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import ByteArray, FloatArray
from buildloc_segmenter.instances import GAP_M
from numpy.typing import NDArray

from buildloc_eval.instance_metrics import Comparison, figures, robust_sigma
from buildloc_eval.overlapping import Flicker
from buildloc_eval.places import drawn

SHIPPED = "segmentation_errors.json"
POOLED = "all"  # the places together
MERGE_REACH_M = 4.0  # buildings further apart are not taken for one
BRIDGE_M = 1.0  # half the width of what joins two that are
VERTEX_M = 4.0  # distance of the points that outlines are bent at
LEAST_SHOWN = 0.05  # a false building is shown in no fewer frames
MEAN_OF_NORMAL = math.sqrt(2.0 / math.pi)  # mean absolute value over standard deviation

Outlines = NDArray[np.object_]


class ErrorModelError(BuildlocError):
    """An error model cannot be read."""


@dataclass(frozen=True)
class SegmentationErrors:
    """Shares are of true buildings unless told otherwise; what each means is told by
    :mod:`buildloc_eval.instance_metrics`, of the mask as the mapper receives it.

    ``true``: how many were measured. ``false_share``: of those found. ``false_median_m2``: area of the false.
    ``centroid_sigma_m`` per axis, ``log_area_bias`` and ``log_area_sigma`` (found over true), ``shape_sigma``
    of the four shape metrics: robust, of matched buildings. ``outline_m``: mean distance between outlines.
    Of two overlapping frames: ``flicker`` is the share found in one and not in the other,
    ``centroid_frame_sigma_m`` the part of the centroid's error that is new in each frame, ``false_again`` the
    share of the false ones of one that the other shows too. ``twice``: how many were seen in two.
    """

    true: int
    missed: float
    merged: float
    split: float
    false_per_km2: float
    false_share: float
    false_median_m2: float
    centroid_sigma_m: float
    log_area_bias: float
    log_area_sigma: float
    shape_sigma: tuple[float, float, float, float]
    outline_m: float
    twice: int
    flicker: float
    centroid_frame_sigma_m: float
    false_again: float

    @property
    def frame_missed(self) -> float:
        """Probability that a frame misses a building that the segmenter is able to find."""
        return min(self.missed, 0.5 * self.flicker / max(1.0 - self.missed, 1e-9))

    @property
    def never_found(self) -> float:
        """Share of buildings that no frame shows: with ``frame_missed`` it makes what one view misses."""
        return 1.0 - (1.0 - self.missed) / (1.0 - self.frame_missed)


def measured(c: Comparison, seen: Flicker) -> SegmentationErrors:
    """The errors of a comparison with matched buildings, and of overlapping frames."""
    values = figures(c)
    false = c.found.area_m2[c.found.lost]
    shape = c.pairs.shape[np.isfinite(c.pairs.shape).all(axis=1)]
    compactness, elongation, rectangularity, convexity = (robust_sigma(column) for column in shape.T)
    return SegmentationErrors(
        true=len(c.true),
        missed=float(c.true.lost.mean()),
        merged=float(c.true.merged.mean()),
        split=float(c.true.split.mean()),
        false_per_km2=float(values["false_per_km2"] or 0.0),
        false_share=float(c.found.lost.mean()),
        false_median_m2=float(np.median(false)) if len(false) else 0.0,
        centroid_sigma_m=robust_sigma(c.pairs.centroid_m.ravel()),
        log_area_bias=float(np.median(c.pairs.log_area)),
        log_area_sigma=robust_sigma(c.pairs.log_area),
        shape_sigma=(compactness, elongation, rectangularity, convexity),
        outline_m=float(c.pairs.outline_m.mean()),
        twice=seen.buildings,
        flicker=seen.share,
        centroid_frame_sigma_m=seen.centroid_sigma_m,
        false_again=seen.false_again,
    )


def write_errors(path: Path, about: dict[str, Any], places: dict[str, SegmentationErrors]) -> None:
    """Write the errors of each place (and POOLED), with how they were measured."""
    document = {"about": about, "places": {name: asdict(errors) for name, errors in places.items()}}
    path.write_text(json.dumps(document, indent=2) + "\n")


def read_errors(place: str = POOLED, path: Path | None = None) -> SegmentationErrors:
    """The errors measured on a place, of the shipped file by default. Raises ErrorModelError."""
    path = path or Path(str(importlib.resources.files("buildloc_eval").joinpath(SHIPPED)))
    try:
        values = json.loads(path.read_text())["places"]
        if place not in values:
            raise ErrorModelError(f"{path}: has no place {place}; it has {', '.join(values)}")
        found = {field.name: values[place][field.name] for field in fields(SegmentationErrors)}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ErrorModelError(
            f"{path}: is no error model ({error}); write one with `buildloc eval segmentation --write-errors`"
        ) from error
    return SegmentationErrors(**found | {"shape_sigma": tuple(found["shape_sigma"])})


@dataclass(frozen=True)
class Perceived:
    """What a segmenter makes of a town in one flight: outlines (M,) in metres with the errors that stay, and
    the probability (M,) that a frame shows each."""

    outlines: Outlines
    shown: FloatArray
    frame_sigma_m: float

    def frame(
        self, to_pixels: FloatArray, size: tuple[int, int], gsd_m: float, rng: np.random.Generator
    ) -> ByteArray:
        """(H, W) mask, 0 or 255, of ``size`` (width, height), of one frame with errors of its own.

        ``to_pixels`` (3, 3) takes metres (x, y, 1) to pixels, centres at whole numbers. Touching buildings
        have a line between them, as in the masks of the segmenter.
        """
        seen = rng.random(len(self.outlines)) < self.shown
        shifts = rng.normal(0.0, self.frame_sigma_m, (len(self.outlines), 2))
        # Everything is drawn before the choice of what is in view: a frame's errors are those of its seed.
        corners = np.array([[0, 0, 1], [size[0], 0, 1], [size[0], size[1], 1], [0, size[1], 1]]) - (
            0.5,
            0.5,
            0,
        )
        ground = corners @ np.linalg.inv(to_pixels).T
        view = shapely.Polygon(ground[:, :2] / ground[:, 2:]).buffer(4.0 * self.frame_sigma_m)
        rows = np.flatnonzero(seen & shapely.intersects(self.outlines, view))
        labels = drawn([_in_pixels(self.outlines[k], shifts[k], to_pixels) for k in rows], (size[1], size[0]))
        values, reach = labels.astype(np.float32), max(1, round(0.5 * GAP_M / gsd_m))
        kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        lowest = cv2.erode(np.where(labels > 0, values, np.float32(np.inf)), kernel)
        touching = cv2.dilate(values, kernel) > lowest
        return ((labels > 0) & ~touching).astype(np.uint8) * np.uint8(255)


def _in_pixels(outline: shapely.Polygon, shift_m: FloatArray, to_pixels: FloatArray) -> shapely.Polygon:
    def place(xy: FloatArray) -> FloatArray:
        image = np.column_stack([xy + shift_m, np.ones(len(xy))]) @ to_pixels.T
        return np.asarray(image[:, :2] / image[:, 2:] + 0.5, dtype=np.float64)

    return shapely.transform(outline, place)


def perceive(
    outlines: Outlines, errors: SegmentationErrors, ground: shapely.Polygon, rng: np.random.Generator
) -> Perceived:
    """The buildings (N,) of a town (valid polygons, metres) as one flight over ``ground`` finds them.

    Some are never found, the closest neighbours are merged, some are split; all are moved, resized and bent;
    false ones are added. What changes from frame to frame is left to :meth:`Perceived.frame`.
    """
    kept = outlines[rng.random(len(outlines)) >= errors.never_found]
    single, joined = merge(kept, errors.merged)
    broken = rng.random(len(single)) < errors.split * len(kept) / max(len(single), 1)
    pieces = [piece for outline in single[broken] for piece in halves(outline)]
    whole = np.array([*single[~broken], *joined, *pieces], dtype=object)
    true = np.array([disturb(outline, errors, rng) for outline in whole], dtype=object)
    shown = max(errors.false_again, LEAST_SHOWN)
    false = invented(outlines, errors.false_per_km2 / shown, errors.false_median_m2, ground, rng)
    return Perceived(
        np.concatenate([true, false]),
        np.concatenate([np.full(len(true), 1.0 - errors.frame_missed), np.full(len(false), shown)]),
        errors.centroid_frame_sigma_m,
    )


def merge(outlines: Outlines, share: float) -> tuple[Outlines, list[shapely.Polygon]]:
    """Join the closest neighbours in twos until so many are merged: the others, and the joined ones."""
    tree = shapely.STRtree(outlines)
    a, b = tree.query(outlines, predicate="dwithin", distance=MERGE_REACH_M)
    a, b = a[a < b], b[a < b]
    alone, joined = np.ones(len(outlines), dtype=bool), list[shapely.Polygon]()
    for k in np.argsort(shapely.distance(outlines[a], outlines[b]), kind="stable"):
        if len(joined) * 2 + 1 > share * len(outlines):
            break
        if alone[a[k]] and alone[b[k]]:
            bridge = shapely.shortest_line(outlines[a[k]], outlines[b[k]]).buffer(BRIDGE_M)
            joined.append(
                shapely.Polygon(shapely.union_all([outlines[a[k]], outlines[b[k]], bridge]).exterior)
            )
            alone[[a[k], b[k]]] = False
    return outlines[alone], joined


def halves(outline: shapely.Polygon) -> list[shapely.Polygon]:
    """A building cut across its long side, with a gap between the parts."""
    corners = shapely.get_coordinates(shapely.oriented_envelope(outline))
    sides = np.diff(corners[:3], axis=0)
    short = sides[np.argmin(np.hypot(*sides.T))]
    centre = shapely.get_coordinates(outline.centroid)[0]
    reach = short / np.hypot(*short) * 2.0 * outline.length
    cut = shapely.LineString([centre - reach, centre + reach]).buffer(0.5 * GAP_M, cap_style="flat")
    parts = shapely.get_parts(outline.difference(cut))
    return [part for part in parts if isinstance(part, shapely.Polygon) and part.area > 0.0]


def disturb(
    outline: shapely.Polygon, errors: SegmentationErrors, rng: np.random.Generator
) -> shapely.Polygon:
    """Move, resize and bend an outline, by what stays the same in a flight."""
    constant = math.sqrt(max(errors.centroid_sigma_m**2 - errors.centroid_frame_sigma_m**2, 0.0))
    area = outline.area * math.exp(rng.normal(errors.log_area_bias, errors.log_area_sigma))
    place = shapely.get_coordinates(outline.centroid)[0] + rng.normal(0.0, constant, 2)
    # What is left of the outline's error, over what moving and resizing do to it already.
    grown = math.sqrt(area / math.pi) - math.sqrt(outline.area / math.pi)
    left = (errors.outline_m / MEAN_OF_NORMAL) ** 2 - errors.centroid_sigma_m**2 - grown**2
    if left > 0.0:
        # Between bent points the outline is straight: there it moves less, by two thirds of the variance.
        sigma = math.sqrt(1.5 * left)
        points = shapely.get_coordinates(shapely.segmentize(outline.exterior, VERTEX_M))[:-1]
        bent = shapely.Polygon(points + rng.normal(0.0, sigma, points.shape)).buffer(0.0)
        outline = max(shapely.get_parts(bent), key=lambda part: part.area, default=outline)
    centre = shapely.get_coordinates(outline.centroid)[0]
    zoom = math.sqrt(area / outline.area)
    return shapely.transform(outline, lambda xy: (xy - centre) * zoom + place)


def invented(
    outlines: Outlines, per_km2: float, area_m2: float, ground: shapely.Polygon, rng: np.random.Generator
) -> Outlines:
    """False buildings, clear of the true ones: rectangles at any heading."""
    count = int(rng.poisson(per_km2 * ground.area / 1e6))
    west, south, east, north = ground.bounds
    aspect, heading = rng.uniform(1.0, 2.5, count), rng.uniform(0.0, math.pi, count)
    places = np.column_stack([rng.uniform(west, east, 8 * count), rng.uniform(south, north, 8 * count)])
    free = shapely.contains_xy(ground, places)
    hit, _ = shapely.STRtree(outlines).query(
        shapely.points(places), predicate="dwithin", distance=math.sqrt(area_m2)
    )
    free[hit] = False
    places = places[free][:count]
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    found: list[shapely.Polygon] = []
    for place, long, angle in zip(places, aspect, heading, strict=False):
        box = corners * (math.sqrt(area_m2 * long), math.sqrt(area_m2 / long))
        c, s = math.cos(angle), math.sin(angle)
        found.append(shapely.Polygon(box @ np.array([[c, s], [-s, c]]) + place))
    return np.array(found, dtype=object)


def summary(places: dict[str, SegmentationErrors]) -> Sequence[str]:
    """A table for people, empty without places."""
    if not places:
        return []
    lines = [
        f"{'error model':<24} missed merged  split  f/km2 centre  frame area_b area_s line_m flicker again"
    ]
    for name, e in places.items():
        lines.append(
            f"{name:<24} {e.missed:6.3f} {e.merged:6.3f} {e.split:6.3f} {e.false_per_km2:6.0f} "
            f"{e.centroid_sigma_m:6.3f} {e.centroid_frame_sigma_m:6.3f} {e.log_area_bias:6.3f} "
            f"{e.log_area_sigma:6.3f} {e.outline_m:6.3f} {e.flicker:7.3f} {e.false_again:5.2f}"
        )
    return lines
