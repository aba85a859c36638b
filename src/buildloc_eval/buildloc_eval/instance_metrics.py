"""Found buildings against true ones: two label images of the same ground.

A building is what has one number. Pairs are one to one, best IoU first. Whatever is cut by the edge of the
labelled ground or smaller than the least area counts for nothing, found or true; nor does what was found on
such a true building.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
import shapely
from buildloc_msgs_py.footprint import footprints
from buildloc_msgs_py.types import ByteArray, FloatArray
from numpy.typing import NDArray
from scipy import ndimage

from buildloc_eval.places import BoolArray, Labels

IntArray = NDArray[np.int64]
MIN_AREA_M2 = 8.0  # the segmenter's own
STRICT_IOU, LEAST_IOU = 0.5, 0.3
HALF = 0.5  # share of a building that lies in another one for the two to be one, or one a part
SIMPLIFY_M = 0.5  # outlines are compared in shape as the mapper draws them


@dataclass(frozen=True)
class Buildings:
    """The counted buildings (N,) of one side, true or found: number in the label image, centroid (N, 2) x, y
    in metres from the image's outer corner, area, and what became of each.

    ``matched_strict``, ``matched``: one of the other side was matched with it at the strict, the least IoU.
    ``merged``: one found building holds at least half of this true one and of another; or is such a one.
    ``split``: at least half of each of several found buildings lies in this true one; or is one of those.
    """

    number: IntArray
    centroid_m: FloatArray
    area_m2: FloatArray
    matched_strict: BoolArray
    matched: BoolArray
    merged: BoolArray
    split: BoolArray

    def __len__(self) -> int:
        return len(self.number)

    @property
    def lost(self) -> BoolArray:
        """Neither matched nor merged nor split: a true building was missed, a found one is false."""
        return ~(self.matched | self.merged | self.split)


@dataclass(frozen=True)
class Pairs:
    """The matched buildings (K,), found less true: centroid (K, 2) metres east and north in a north-up
    picture, logarithm of the areas' ratio, four shape metrics (K, 4); and the mean distance between the two
    outlines, metres. ``true`` and ``found`` are their numbers."""

    true: IntArray
    found: IntArray
    centroid_m: FloatArray
    log_area: FloatArray
    shape: FloatArray
    outline_m: FloatArray


@dataclass(frozen=True)
class Comparison:
    """Of one or more label images. ``pixels`` (3,): building in both, in the found one alone, in the true one
    alone; of ``area_m2`` of labelled ground."""

    pixels: IntArray
    area_m2: float
    true: Buildings
    found: Buildings
    pairs: Pairs


def compare(
    true: Labels,
    found: Labels,
    labelled: BoolArray,
    gsd_m: float,
    min_area_m2: float = MIN_AREA_M2,
) -> Comparison:
    """Compare two label images (H, W), 0 for none, where the ground is labelled (H, W)."""
    true, found = (np.where(labelled, side, 0).astype(np.int32, copy=False) for side in (true, found))
    inner = cv2.erode(labelled.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0)
    edge = labelled & (inner == 0)
    sides = [_Regions.of(side, edge, min_area_m2 / gsd_m**2) for side in (true, found)]
    t, f, shared = _overlaps(true, found)
    t_px, f_px = sides[0].pixels[t], sides[1].pixels[f]
    iou = shared / (t_px + f_px - shared)
    strict, least = one_to_one(t, f, iou, STRICT_IOU), one_to_one(t, f, iou, LEAST_IOU)
    both_large = sides[0].large[t] & sides[1].large[f]
    merging = _several((shared >= HALF * t_px) & both_large, f)
    splitting = _several((shared >= HALF * f_px) & both_large, t)
    # What lies on a true building that does not count is neither right nor false.
    void = ~sides[0].counted[t]
    on_void = np.zeros(len(sides[1].pixels), dtype=bool)
    on_void[f[void & (shared >= HALF * f_px)]] = True
    matched_void = f[least][void[least]]
    counted_true = sides[0].counted
    counted_found = sides[1].counted & ~on_void
    counted_found[f[least]] = True
    counted_found[matched_void] = False
    kept = least[counted_true[t[least]]]
    rows = (strict, least, merging, splitting)
    return Comparison(
        np.array([((true > 0) & (found > 0)).sum(), ((found > 0) & (true == 0)).sum(),
                  ((true > 0) & (found == 0)).sum()]),
        float(labelled.sum()) * gsd_m**2,
        sides[0].buildings(counted_true, [t[row] for row in rows], gsd_m),
        sides[1].buildings(counted_found, [f[row] for row in rows], gsd_m),
        _pairs(true, found, t[kept], f[kept], sides[0], sides[1], gsd_m),
    )  # fmt: skip


@dataclass(frozen=True)
class _Regions:
    """The numbers (N,) of a label image, those that it lacks and 0 (none) with no pixels; centroids (N, 2)
    x, y in pixels, the corner of the first one being (0, 0)."""

    pixels: IntArray
    centroid_px: FloatArray
    large: BoolArray
    counted: BoolArray

    @staticmethod
    def of(labels: Labels, edge: BoolArray, min_px: float) -> _Regions:
        rows, columns = np.nonzero(labels)
        numbers = labels[rows, columns]
        pixels = np.bincount(numbers, minlength=1)
        centroid = np.column_stack([np.bincount(numbers, at, len(pixels)) for at in (columns, rows)])
        large = pixels >= max(min_px, 1.0)
        counted = large.copy()
        counted[labels[edge]] = False
        return _Regions(pixels, centroid / np.maximum(pixels, 1)[:, None] + 0.5, large, counted)

    def buildings(self, counted: BoolArray, flagged: Sequence[IntArray], gsd_m: float) -> Buildings:
        """The counted ones, with the numbers that are matched strictly, matched, merged and split."""
        number = np.flatnonzero(counted)
        flags = np.zeros((4, len(self.pixels)), dtype=bool)
        for flag, numbers in zip(flags, flagged, strict=True):
            flag[numbers] = True
        area = np.asarray(self.pixels[number] * gsd_m**2, dtype=np.float64)
        return Buildings(number, self.centroid_px[number] * gsd_m, area, *flags[:, number])


def _overlaps(true: Labels, found: Labels) -> tuple[IntArray, IntArray, IntArray]:
    """Numbers (P,) of each true and found region that share pixels, and how many."""
    both = (true > 0) & (found > 0)
    width = int(found.max(initial=0)) + 1
    keys, shared = np.unique(true[both].astype(np.int64) * width + found[both], return_counts=True)
    t, f = np.divmod(keys, width)
    return t, f, shared


def one_to_one(t: IntArray, f: IntArray, iou: FloatArray, least: float) -> IntArray:
    """Rows of the pairs (t, f) that match: by descending IoU, each region once, none below ``least``."""
    matched, taken_t, taken_f = [], set[int](), set[int]()
    for row in np.argsort(-iou, kind="stable"):
        if iou[row] < least:
            break
        if t[row] not in taken_t and f[row] not in taken_f:
            taken_t.add(t[row])
            taken_f.add(f[row])
            matched.append(int(row))
    return np.array(matched, dtype=np.int64)


def _several(member: BoolArray, group: IntArray) -> BoolArray:
    """Which members (P,) are not the only one of their group."""
    counts = np.bincount(group[member], minlength=int(group.max(initial=0)) + 1)
    return np.asarray(member & (counts[group] > 1), dtype=np.bool_)


def _pairs(
    true: Labels, found: Labels, t: IntArray, f: IntArray, ts: _Regions, fs: _Regions, gsd_m: float
) -> Pairs:
    boxes_t, boxes_f = ndimage.find_objects(true), ndimage.find_objects(found)
    outline_m, drawn = np.empty(len(t)), np.empty((2, len(t)), dtype=object)
    for k, (number_t, number_f) in enumerate(zip(t, f, strict=True)):
        window = tuple(
            slice(min(a.start, b.start), max(a.stop, b.stop))
            for a, b in zip(boxes_t[number_t - 1], boxes_f[number_f - 1], strict=True)
        )
        masks = [
            np.pad((side[window] == number).astype(np.uint8), 1)
            for side, number in ((true, number_t), (found, number_f))
        ]
        outline_m[k] = outline_distance(*masks) * gsd_m
        drawn[:, k] = [outline(mask, gsd_m) for mask in masks]
    whole = np.array([a is not None and b is not None for a, b in drawn.T], dtype=bool)
    shape = np.full((len(t), 4), np.nan)
    shape[whole] = footprints(drawn[1, whole]).shapes - footprints(drawn[0, whole]).shapes
    moved = (fs.centroid_px[f] - ts.centroid_px[t]) * (gsd_m, -gsd_m)
    return Pairs(t, f, moved, np.log(fs.pixels[f] / ts.pixels[t]), shape, outline_m)


def outline_distance(a: ByteArray, b: ByteArray) -> float:
    """Mean distance between the outlines of two masks (h, w), pixels, from each to the other and averaged.

    An outline is the pixels of the mask that touch what is not; the masks do not reach the border.
    """
    edges = [mask - cv2.erode(mask, np.ones((3, 3), np.uint8)) for mask in (a, b)]
    away = [cv2.distanceTransform(1 - edge, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for edge in edges]
    return float((away[1][edges[0] > 0].mean() + away[0][edges[1] > 0].mean()) / 2.0)


def outline(mask: ByteArray, gsd_m: float) -> shapely.Polygon | None:
    """The outline in metres of the largest part of a mask (h, w); None when it has no area."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    contour = max(contours, key=cv2.contourArea)
    if len(contour) < 3:
        return None
    # Contours run through pixel centres; half a pixel outwards gives the pixels' own outline.
    traced = shapely.Polygon(contour[:, 0] * gsd_m).buffer(0.5 * gsd_m, join_style="mitre")
    simple = traced.simplify(SIMPLIFY_M)
    return simple if isinstance(simple, shapely.Polygon) and simple.is_valid and simple.area > 0.0 else None


def pooled(comparisons: Sequence[Comparison]) -> Comparison:
    """Several pieces of ground as one. Numbers and centroids stay those of their own piece."""

    def join(kind: type[Any], parts: list[Any]) -> Any:
        return kind(*(np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(kind)))

    return Comparison(
        np.sum([c.pixels for c in comparisons], axis=0),
        sum(c.area_m2 for c in comparisons),
        join(Buildings, [c.true for c in comparisons]),
        join(Buildings, [c.found for c in comparisons]),
        join(Pairs, [c.pairs for c in comparisons]),
    )


def robust_sigma(values: FloatArray) -> float:
    """Standard deviation of the normal distribution with the same median absolute deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def figures(c: Comparison) -> dict[str, float | None]:
    """The figures of a report; None where there is nothing to measure."""
    both, false, missed = (float(n) for n in c.pixels)
    length = np.hypot(*c.pairs.centroid_m.T)
    some = len(length) > 0

    def share(flags: BoolArray) -> float | None:
        return float(flags.mean()) if len(flags) else None

    return {
        "km2": c.area_m2 / 1e6,
        "true": float(len(c.true)),
        "found": float(len(c.found)),
        "pixel_iou": both / max(both + false + missed, 1.0),
        "pixel_f1": 2.0 * both / max(2.0 * both + false + missed, 1.0),
        "recall_0.5": share(c.true.matched_strict),
        "precision_0.5": share(c.found.matched_strict),
        "recall_0.3": share(c.true.matched),
        "precision_0.3": share(c.found.matched),
        "missed": share(c.true.lost),
        "merged": share(c.true.merged),
        "split": share(c.true.split),
        "false_per_km2": float(c.found.lost.sum()) / (c.area_m2 / 1e6),
        "centroid_median_m": float(np.median(length)) if some else None,
        "centroid_p90_m": float(np.quantile(length, 0.9)) if some else None,
        "log_area_median": float(np.median(c.pairs.log_area)) if some else None,
        "log_area_std": float(c.pairs.log_area.std()) if some else None,
        "outline_m": float(c.pairs.outline_m.mean()) if some else None,
    }
