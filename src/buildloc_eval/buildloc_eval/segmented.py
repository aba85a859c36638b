"""A labelled scene through the segmenter: its buildings on the raster of the truth, and how they score."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from buildloc_mapper.config import MapperConfig
from buildloc_msgs_py.types import ByteArray
from buildloc_segmenter.instances import draw_mask, fill_holes
from buildloc_segmenter.network import Network

from buildloc_eval.instance_metrics import MIN_AREA_M2, Comparison, compare
from buildloc_eval.places import Labels, Scene

MAPPED_AREA_M2 = MapperConfig().min_area_m2
SCORED_GSD_M = 0.2  # truth and finds are compared on this raster, whatever the image's


@dataclass(frozen=True)
class Finds:
    """What was found on a scene, label images (H, W) of the raster of the truth.

    ``instances``: the segmenter's buildings. ``plain``: the connected components of the same pixels, which a
    segmenter without instances would give. ``wire``: those of the mask that the mapper receives.
    """

    instances: Labels
    plain: Labels
    wire: Labels


def connected(mask: ByteArray) -> Labels:
    """The components of a mask (H, W), neighbours across corners connected."""
    return np.asarray(cv2.connectedComponents(mask, connectivity=8)[1], dtype=np.int32)


def find(network: Network, image_bgr: ByteArray, told_gsd_m: float, size: tuple[int, int]) -> Finds:
    """The buildings of an image (H, W, 3) that the network is told to have ``told_gsd_m`` metres per pixel,
    drawn over ``size`` (rows, columns) that cover the same ground."""
    labels, building, wire = (np.zeros(size, dtype=kind) for kind in (np.int32, np.uint8, np.uint8))
    shape = image_bgr.shape[:2]
    count = 0
    for block, found in network.blocks(image_bgr, told_gsd_m):
        window = (block.rows, block.columns)
        mask = draw_mask(found, (window[1].stop - window[1].start, window[0].stop - window[0].start))
        at = [_sampled(span, full, side) for span, full, side in zip(window, shape, size, strict=True)]
        where = np.s_[at[0][0], at[1][0]]
        numbers = found.labels[_pick(at, found.labels.shape)]
        part = labels[where]
        part[numbers > 0] = numbers[numbers > 0] + count
        building[where] |= (found.building[_pick(at, found.labels.shape)] > 0.0).astype(np.uint8)
        wire[where] |= mask[_pick(at, mask.shape)]
        count += len(found)
    filled = fill_holes(building, MIN_AREA_M2 / SCORED_GSD_M**2)
    return Finds(labels, connected(filled), connected(wire))


Sampled = tuple[slice, np.ndarray]


def _sampled(span: slice, full: int, side: int) -> Sampled:
    """The pixels of ``side`` whose centres lie in a span of ``full`` pixels, and where in it (0 to 1)."""
    centres = (np.arange(side) + 0.5) * (full / side)
    first, last = np.searchsorted(centres, (span.start, span.stop))
    return slice(int(first), int(last)), (centres[first:last] - span.start) / (span.stop - span.start)


def _pick(at: list[Sampled], shape: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """Index of the nearest pixels of a block of ``shape``."""
    rows, columns = ((where * side).astype(np.int64) for (_, where), side in zip(at, shape, strict=True))
    return np.ix_(rows, columns)


def bgr(scene: Scene) -> ByteArray:
    """The picture as the segmenter takes it."""
    return np.ascontiguousarray(scene.rgb[:, :, ::-1])


@dataclass(frozen=True)
class Scored:
    """A piece of ground on the raster of the truth, what was found on it, and the comparison of each.

    ``mapped`` is that of ``wire`` without the buildings, found or true, that are too small for a map.
    """

    truth: Scene
    finds: Finds
    instances: Comparison
    plain: Comparison
    wire: Comparison
    mapped: Comparison


def score(network: Network, scene: Scene) -> Scored:
    """A connected piece of ground, its picture as it comes."""
    truth = scene.resampled(SCORED_GSD_M)
    finds = find(network, bgr(scene), scene.gsd_m, truth.labelled.shape)
    instances, plain, wire = (against(truth, side) for side in (finds.instances, finds.plain, finds.wire))
    return Scored(truth, finds, instances, plain, wire, against(truth, finds.wire, MAPPED_AREA_M2))


def against(truth: Scene, found: Labels, min_area_m2: float = MIN_AREA_M2) -> Comparison:
    """Compare with the truth, both on its raster."""
    return compare(truth.buildings, found, truth.labelled, truth.gsd_m, min_area_m2)


def busiest(scene: Scene, side_m: float) -> Scene:
    """The square of the scene with the most building in it."""
    side = max(1, round(side_m / scene.gsd_m))
    built = cv2.integral(((scene.buildings > 0) & scene.labelled).astype(np.uint8))
    height, width = (min(side, n) for n in scene.labelled.shape)
    inside = (
        built[height:, width:] - built[:-height, width:] - built[height:, :-width] + built[:-height, :-width]
    )
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return scene.part(slice(top, top + height), slice(left, left + width), scene.name)


@dataclass(frozen=True)
class Disturbance:
    """An input unlike the best: metres per pixel of the picture, and the factor of the altitude told."""

    name: str
    gsd_m: float
    altitude: float


DISTURBANCES = (
    *(Disturbance(f"{gsd:g} m per pixel", gsd, 1.0) for gsd in (0.1, 0.2, 0.3, 0.5)),
    Disturbance("altitude told 1.3 times too high", SCORED_GSD_M, 1.3),
    Disturbance("altitude told 1.3 times too low", SCORED_GSD_M, 1.0 / 1.3),
)


def disturbed(network: Network, scene: Scene) -> Iterator[tuple[Disturbance, Comparison]]:
    """The comparison of each disturbance, on the same truth."""
    truth = scene.resampled(SCORED_GSD_M)
    for kind in DISTURBANCES:
        picture = bgr(scene.resampled(kind.gsd_m))
        found = find(network, picture, kind.gsd_m * kind.altitude, truth.labelled.shape)
        yield kind, against(truth, found.instances)
