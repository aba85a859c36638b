"""From the scores of pixels to buildings: one label per building, a mask that keeps them apart.

Everything here is at the network's ground sampling distance; a score is a logit, above 0 for yes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from buildloc_msgs_py.types import ByteArray
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]
LabelImage = NDArray[np.int32]

# A core is what is left of a building when so much is taken off its edge: by the network where it marks
# cores, by distance where it does not.
CORE_INSET_M = 0.6
MIN_CORE_M2 = 1.0  # smaller ones are noise: a shed of 8 m2 has a core of 2.6 m2
# Two cores are told apart by the valley between them in the score of cores. The ridge of a roof looks like
# one, but the network is not so sure of it.
VALLEY = -0.75  # logit
# In a dense town it is as unsure of the gaps: there any valley with enough on both sides parts a core.
DENSE_VALLEYS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)  # logits
MIN_PEAK_M2 = 6.0
DENSE_SCORE = 0.75  # of the score that a building needs elsewhere: such cores are doubtful, not the buildings
# A town is dense where blocks are a tenth of what is built. A block is a connected part of the mask that is
# larger than any house and far from the shape of one building.
DENSE_SHARE = 0.1
BLOCK_M2 = 500.0
BLOCK_SOLIDITY = 0.7  # share of its convex hull that one building fills at least
# The line between touching buildings on the wire. The mapper fuses at 0.25 m per pixel: anything narrower
# than 0.25 m times the root of two, at a slant, would have gaps there.
GAP_M = 0.4
GAP_PX = 1.5  # of the image: its own neighbours across corners
GROUND = 1  # the watershed's mark of what is no building
SQUARE = np.ones((3, 3), np.uint8)
MAX_LOGIT = 4.0  # beyond it a pixel is as sure as its neighbour: edges stay in the middle between two


@dataclass(frozen=True)
class Instances:
    """The buildings of an image.

    ``labels`` (h, w) int32: 0 ground, 1 to N the buildings. ``building`` (h, w) float32: the score of each
    pixel, above 0 where the network saw a building. ``scores`` (N,) float32: the mean core probability of
    each building, building probability where the network marks no cores. ``between`` (h, w) bool: the line
    between touching buildings, which a mask leaves out. ``gsd_m`` metres per pixel.
    """

    labels: LabelImage
    building: FloatImage
    scores: FloatImage
    between: NDArray[np.bool_]
    gsd_m: float

    def __len__(self) -> int:
        return int(self.labels.max(initial=0))

    def margin(self) -> FloatImage:
        """(h, w) how surely a pixel is on its side of the outline, > 0: it places edges between pixels."""
        return np.clip(np.abs(self.building), 0.5, MAX_LOGIT)


def probability(logits: FloatImage) -> FloatImage:
    """Of logits, of any shape."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(logits, -60.0, 60.0))), dtype=np.float32)


def find_instances(
    building: FloatImage,
    core: FloatImage | None,
    gsd_m: float,
    min_area_m2: float,
    min_score: float,
    image_gsd_m: float,
) -> Instances:
    """Split a building score (h, w) into buildings, by the score of their cores where there is one.

    A core is what lies well inside one building; touching roofs have separate ones. Each grows in its
    connected part of the mask until it meets the next. A part without a core is one building. Holes and
    buildings below ``min_area_m2`` are removed, and buildings that score below ``min_score``: the mean core
    probability of their pixels. The small ones have to be surer, as less of them is core. Without ``core`` it
    is the building probability. In a dense town DENSE_SCORE of ``min_score`` is enough. ``image_gsd_m`` is
    that of the image the mask is for.
    """
    min_px = min_area_m2 / gsd_m**2
    mask = fill_holes((building > 0.0).view(np.uint8), min_px)
    parts, part = _components(mask, 8)
    valleys: tuple[float, ...] = (0.0,) if core is None else (VALLEY,)
    if core is not None and _is_dense(part, mask, gsd_m):
        valleys, min_score = DENSE_VALLEYS, DENSE_SCORE * min_score
    labels = _separated(mask, part, parts, _depth(mask, core, gsd_m), valleys, gsd_m)
    inside = mask.view(np.bool_)
    numbers = labels[inside]
    pixels = np.bincount(numbers, minlength=1)
    sure = probability((building if core is None else core)[inside])
    score = np.bincount(numbers, sure, len(pixels)) / np.maximum(pixels, 1)
    kept = (pixels >= max(min_px, 1.0)) & (score >= min_score)
    kept[0] = False
    labels[inside] = np.where(kept, np.cumsum(kept), 0).astype(np.int32)[numbers]
    gap_m = max(GAP_M, GAP_PX * image_gsd_m)
    between = _between(labels, max(1, round(0.5 * gap_m / gsd_m)))
    return Instances(labels, building, score[kept].astype(np.float32), between, gsd_m)


def _depth(mask: ByteArray, core: FloatImage | None, gsd_m: float) -> FloatImage:
    """(h, w) how deep in its own building a pixel of the mask lies: the logit of being core where the network
    marks cores, metres by which the edge is farther than CORE_INSET_M where it does not."""
    if core is None:
        distance = cv2.distanceTransform(mask, cv2.DIST_L2, 3)
        return np.asarray(distance * np.float32(gsd_m) - np.float32(CORE_INSET_M), dtype=np.float32)
    # What is finer than the inset that defines a core is noise: it would split large roofs.
    return np.asarray(cv2.GaussianBlur(core, (0, 0), CORE_INSET_M / gsd_m), dtype=np.float32)


def _components(mask: ByteArray, connectivity: int) -> tuple[int, LabelImage]:
    """How many connected components, the background among them, and the number of each pixel's."""
    count, labels = cv2.connectedComponents(mask, connectivity=connectivity)
    return count, np.asarray(labels, dtype=np.int32)


def _separated(
    mask: ByteArray, part: LabelImage, parts: int, depth: FloatImage, valleys: tuple[float, ...], gsd_m: float
) -> LabelImage:
    """(h, w) 0 outside of the mask, inside a number above 0 for each building; ``part`` numbers the connected
    parts of the mask, ``parts`` with the background. A valley of ``depth`` below the first level parts two
    cores, one below a further level if it has enough on both sides.

    Only where a connected part of the mask holds several cores has the watershed anything to decide.
    """
    count, core = _components(mask & (depth > valleys[0]).view(np.uint8), 4)
    for level in valleys[1:]:
        count, core = _parted(core, count, mask & (depth > level).view(np.uint8), MIN_PEAK_M2 / gsd_m**2)
    at, seed, shared = _dividing(core, count, part, parts, MIN_CORE_M2 / gsd_m**2)
    if not shared.any():
        return part
    disputed = np.take(shared, part).view(np.uint8)
    seeds = np.zeros_like(part)
    seeds.ravel()[at] = np.where(seed > 0, seed + parts, 0)
    return np.where(disputed > 0, _flooded(disputed, seeds), part)


def _dividing(
    piece: LabelImage, pieces: int, whole: LabelImage, wholes: int, min_px: float
) -> tuple[NDArray[np.intp], NDArray[np.int32], NDArray[np.bool_]]:
    """Pixels of all pieces (K,); at each the number of its piece where that is of at least ``min_px`` and not
    the only such one of its whole, else 0; and whether each whole, by number, holds several of them.

    All of a piece lies in one whole, or in none.
    """
    at = np.flatnonzero(piece)
    numbers = piece.ravel()[at]
    large = np.bincount(numbers, minlength=pieces) >= min_px
    large[0] = False
    home = np.zeros(pieces, np.int32)
    home[numbers] = whole.ravel()[at]
    several = np.bincount(home[large], minlength=wholes) > 1
    several[0] = False
    return at, np.where(large & several[home], np.arange(pieces), 0).astype(np.int32)[numbers], several


def _is_dense(part: LabelImage, mask: ByteArray, gsd_m: float) -> bool:
    """Whether blocks of houses make up enough of the connected parts of a mask."""
    pixels = np.bincount(part[mask.view(np.bool_)], minlength=1)
    blocks = 0
    for number in np.flatnonzero(pixels >= BLOCK_M2 / gsd_m**2):
        hull = cv2.convexHull(cv2.findNonZero((part == number).view(np.uint8)))
        if pixels[number] < BLOCK_SOLIDITY * cv2.contourArea(hull):
            blocks += pixels[number]
    return bool(blocks > DENSE_SHARE * pixels.sum())


def _parted(core: LabelImage, count: int, above: ByteArray, min_px: float) -> tuple[int, LabelImage]:
    """How many cores, the background among them, and the number of each pixel's, after a valley: what lies
    ``above`` it replaces the cores that fall into several pieces there."""
    pieces, piece = _components(above, 4)
    at, seed, several = _dividing(piece, pieces, core, count, min_px)
    left = np.where(np.take(several, core), 0, core).astype(np.int32)
    left.ravel()[at] = np.where(seed > 0, seed + count, left.ravel()[at])
    return count + pieces, left


def _flooded(mask: ByteArray, seeds: LabelImage) -> LabelImage:
    """(h, w) the seeds, above GROUND, grown over the mask; outside of it anything."""
    # OpenCV draws its line around the image and around what it fills: a pixel more is there for that.
    region = cv2.copyMakeBorder(cv2.dilate(mask, SQUARE), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    labels = cv2.copyMakeBorder(seeds, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    labels[region == 0] = GROUND
    # OpenCV floods across small differences first: the seeds share the mask before the ground enters it.
    cv2.watershed(cv2.cvtColor(region * np.uint8(255), cv2.COLOR_GRAY2BGR), labels)
    line = labels < 0
    labels[line] = cv2.dilate(labels.astype(np.float32), SQUARE)[line]  # OpenCV dilates no int32
    return np.asarray(labels[1:-1, 1:-1], dtype=np.int32)


def _between(labels: LabelImage, reach_px: int) -> NDArray[np.bool_]:
    """(h, w) pixels within reach of another building, or of the pixel of ground around it."""
    kernel = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    values = labels.astype(np.float32)  # OpenCV dilates no int32
    values = np.where(labels > 0, values, cv2.dilate(values, SQUARE))
    low = cv2.erode(np.where(values > 0.0, values, np.float32(np.inf)), kernel)
    return cv2.dilate(values, kernel) > low


def fill_holes(mask: ByteArray, max_px: float) -> ByteArray:
    """(h, w) 0 or 1, with the holes below ``max_px`` filled: background that is enclosed by building."""
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return mask
    # A hole's contour runs through the building's pixels around it. Pick: it encloses A - B / 2 + 1 others.
    holes = [
        contour
        for contour, (*_, parent) in zip(contours, hierarchy[0], strict=True)
        if parent >= 0 and cv2.contourArea(contour) - len(contour) / 2 + 1 < max_px
    ]
    return np.asarray(cv2.drawContours(mask.copy(), holes, -1, 1, cv2.FILLED), dtype=np.uint8)


def draw_mask(instances: Instances, size: tuple[int, int]) -> ByteArray:
    """(H, W) uint8, 0 or 255, of ``size`` (width, height); touching buildings have a line between them."""
    inside = (instances.labels > 0) & ~instances.between
    margin = instances.margin()
    field = cv2.resize(np.where(inside, margin, -margin), size, interpolation=cv2.INTER_LINEAR)
    return (field > 0.0).view(np.uint8) * np.uint8(255)


def owned(instances: Instances, window: tuple[float, float, float, float]) -> Instances:
    """Those whose centroid lies in a window (left, top, right, bottom), pixels, keeping their numbers."""
    left, top, right, bottom = window
    rows, columns = np.nonzero(instances.labels)
    numbers = instances.labels[rows, columns]
    areas = np.bincount(numbers, minlength=1)
    x = np.bincount(numbers, columns, len(areas)) / np.maximum(areas, 1)
    y = np.bincount(numbers, rows, len(areas)) / np.maximum(areas, 1)
    mine = (x >= left) & (x < right) & (y >= top) & (y < bottom)
    return replace(instances, labels=np.where(mine[instances.labels], instances.labels, 0))
