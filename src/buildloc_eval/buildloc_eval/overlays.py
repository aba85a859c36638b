"""Pictures of segmented ground: true and found outlines over the imagery."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from buildloc_msgs_py.types import ByteArray, FloatArray

from buildloc_eval.instance_metrics import Buildings, IntArray
from buildloc_eval.places import BoolArray, Labels
from buildloc_eval.segmented import Scored, bgr

SIDE_M = 70.0
ZOOM = 2
GREEN, MAGENTA = (60, 220, 60), (255, 40, 255)  # BGR
RANDOM, WORST = 3, 3


def rim(labels: Labels) -> BoolArray:
    """(H, W) the pixels of a region that touch another number."""
    edge = np.zeros(labels.shape, dtype=np.bool_)
    for axis in (0, 1):
        differ = np.diff(labels, axis=axis) != 0
        edge |= np.insert(differ, 0, False, axis=axis) | np.insert(
            differ, differ.shape[axis], False, axis=axis
        )
    return edge & (labels > 0)


def overlay(scored: Scored, centre_m: FloatArray) -> ByteArray:
    """A square of ground (BGR): true outlines green, found ones magenta, unlabelled ground dark."""
    gsd, side = scored.truth.gsd_m, round(SIDE_M / scored.truth.gsd_m)
    left, top = (round(float(v)) for v in centre_m / gsd - side / 2.0)
    rows, columns = scored.truth.labelled.shape
    inside = np.s_[max(top, 0) : min(top + side, rows), max(left, 0) : min(left + side, columns)]
    picture = np.zeros((side * ZOOM, side * ZOOM, 3), dtype=np.uint8)
    height, width = (span.stop - span.start for span in inside)
    r0, c0 = (inside[0].start - top) * ZOOM, (inside[1].start - left) * ZOOM
    part = picture[r0 : r0 + height * ZOOM, c0 : c0 + width * ZOOM]
    part[:] = cv2.resize(bgr(scored.truth)[inside], part.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    finer = np.ix_(np.arange(height * ZOOM) // ZOOM, np.arange(width * ZOOM) // ZOOM)
    part[~scored.truth.labelled[inside][finer]] //= 3
    part[rim(scored.truth.buildings[inside][finer])] = GREEN
    part[rim(scored.finds.instances[inside][finer])] = MAGENTA
    return picture


def windows(scored: Scored, seed: int) -> list[tuple[str, FloatArray]]:
    """Centres in metres: true buildings that the seed draws, the largest missed, the largest false."""
    true, found = scored.instances.true, scored.instances.found
    drawn = np.random.default_rng(seed).permutation(len(true))[:RANDOM]
    places = [("drawn by the seed", true.centroid_m[k]) for k in drawn]
    for name, side in (("missed", true), ("false", found)):
        places += [(f"{name}, {side.area_m2[k]:.0f} m2", side.centroid_m[k]) for k in largest(side)]
    return places


def largest(side: Buildings) -> IntArray:
    """The lost buildings of a side, the largest first, no more than WORST."""
    lost = np.flatnonzero(side.lost)
    return np.asarray(lost[np.argsort(-side.area_m2[lost], kind="stable")][:WORST])


def draw_windows(path: Path, scored: Scored, seed: int) -> None:
    """The windows in a grid, each with its caption, as a PNG."""
    tiles = []
    for caption, centre in windows(scored, seed):
        tile = overlay(scored, centre)
        cv2.putText(tile, caption, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(tile, caption, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        tiles.append(tile)
    cv2.imwrite(str(path), grid(tiles, RANDOM))


def grid(tiles: Sequence[ByteArray], columns: int) -> ByteArray:
    """Equal pictures in rows, a gap between them."""
    height, width = (side + 8 for side in tiles[0].shape[:2])
    sheet = np.full((math.ceil(len(tiles) / columns) * height, columns * width, 3), 255, dtype=np.uint8)
    for k, tile in enumerate(tiles):
        row, column = divmod(k, columns)
        sheet[row * height : (row + 1) * height - 8, column * width : (column + 1) * width - 8] = tile
    return sheet
