"""The same building in two frames of a flight: what a segmenter finds in one and not in the other.

Frames are photographed over labelled ground, segmented, and laid back onto the raster of the truth.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from buildloc_msgs_py.ground import camera_matrix
from buildloc_msgs_py.types import FloatArray
from buildloc_segmenter.network import Network

from buildloc_eval.camera import attitude, camera_model, photograph, world_to_rays
from buildloc_eval.flight import FlightConfig, margin_m
from buildloc_eval.instance_metrics import compare, robust_sigma
from buildloc_eval.places import BoolArray, Labels, Scene
from buildloc_eval.segmented import SCORED_GSD_M, bgr, connected
from buildloc_eval.world import Box, Window

SPACING_M = 80.0
LABELLED = 0.5  # of the ground around a frame's middle, for the frame to be worth its time


class SceneSurface:
    """A labelled scene to be photographed: metres east and north of its top left corner."""

    def __init__(self, scene: Scene) -> None:
        self._image, self._gsd_m = bgr(scene), scene.gsd_m

    @property
    def bounds_m(self) -> Box:
        """The whole picture."""
        height, width = self._image.shape[:2]
        return 0.0, -height * self._gsd_m, width * self._gsd_m, 0.0

    def window(self, box_m: Box) -> Window:
        """All of it: a photograph warps no more than it shows."""
        return Window(self._image, 0.0, 0.0, self._gsd_m)


@dataclass(frozen=True)
class Seen:
    """A frame on the raster of the truth: its window, what was found, and what the frame covers (h, w)."""

    rows: slice
    columns: slice
    found: Labels
    covered: BoolArray

    def at(self, rows: slice, columns: slice) -> tuple[Labels, BoolArray]:
        """The part of a window of the raster."""
        inside = np.s_[
            rows.start - self.rows.start : rows.stop - self.rows.start,
            columns.start - self.columns.start : columns.stop - self.columns.start,
        ]
        return self.found[inside], self.covered[inside]


def frame(
    network: Network, surface: SceneSurface, truth: Scene, centre_m: FloatArray, config: FlightConfig,
    rng: np.random.Generator,
) -> Seen:  # fmt: skip
    """Photograph, compress and segment one frame at any heading; lay it onto the raster."""
    camera = camera_model(config)
    yaw, swing = rng.uniform(-math.pi, math.pi), rng.uniform(-1.0, 1.0)
    roll, pitch = np.radians(config.tilt_deg) * rng.standard_normal(2).clip(-2.0, 2.0)
    pose = (float(centre_m[0]), float(centre_m[1]), config.altitude_m + config.altitude_swing_m * swing, yaw)
    looks = attitude(float(roll), float(pitch), -yaw)
    picture = photograph(surface, camera, pose, looks, config, rng)
    jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality])[1]
    image = np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), dtype=np.uint8)
    mask = network.segment(image, pose[2] / camera.fx)
    gsd, reach = truth.gsd_m, margin_m(config)
    rows, columns = (
        slice(max(0, int((at - reach) / gsd)), min(size, int((at + reach) / gsd)))
        for at, size in zip((-centre_m[1], centre_m[0]), truth.labelled.shape, strict=True)
    )
    # From a pixel of the window to metres, then to a pixel of the frame.
    to_metres = np.array(
        [
            [gsd, 0.0, (columns.start + 0.5) * gsd],
            [0.0, -gsd, -(rows.start + 0.5) * gsd],
            [0.0, 0.0, 1.0],
        ]
    )
    to_image = camera_matrix(camera) @ world_to_rays(pose, looks) @ to_metres
    size = (columns.stop - columns.start, rows.stop - rows.start)
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    found, covered = (
        cv2.warpPerspective(layer, to_image, size, flags=flags) for layer in (mask, np.ones_like(mask))
    )
    return Seen(rows, columns, connected(np.asarray(found, dtype=np.uint8)), covered > 0)


def centres(truth: Scene, config: FlightConfig) -> Iterator[tuple[tuple[int, int], FloatArray]]:
    """Where frames are taken: a grid of SPACING_M inside the scene, over labelled ground; cell and place."""
    gsd, margin = truth.gsd_m, margin_m(config)
    height, width = (side * gsd for side in truth.labelled.shape)
    share = cv2.boxFilter(truth.labelled.astype(np.float32), -1, (round(margin / gsd),) * 2)
    for row, y in enumerate(np.arange(margin, height - margin, SPACING_M)):
        for column, x in enumerate(np.arange(margin, width - margin, SPACING_M)):
            if share[int(y / gsd), int(x / gsd)] >= LABELLED:
                yield (row, column), np.array([x, -y])


@dataclass(frozen=True)
class Overlap:
    """Buildings that two frames show whole: found in both, in one, in neither; their finds' difference in
    place (K, 2), metres. And false ones of one frame: how many, and how many the other frame shows too."""

    both: int
    one: int
    neither: int
    apart_m: FloatArray
    false: int
    false_again: int


def overlap(truth: Scene, first: Seen, second: Seen) -> Overlap | None:
    """Compare two frames where they show the same ground; None: they do not."""
    rows, columns = (
        slice(max(a.start, b.start), min(a.stop, b.stop))
        for a, b in ((first.rows, second.rows), (first.columns, second.columns))
    )
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return None
    (found_a, covered_a), (found_b, covered_b) = first.at(rows, columns), second.at(rows, columns)
    ground = truth.labelled[rows, columns] & covered_a & covered_b
    true, gsd = truth.buildings[rows, columns], truth.gsd_m
    a, b = (compare(true, found, ground, gsd) for found in (found_a, found_b))
    again = compare(found_a, found_b, ground, gsd).true
    lost = np.isin(again.number, a.found.number[a.found.lost])
    _, in_a, in_b = np.intersect1d(a.pairs.true, b.pairs.true, return_indices=True)
    seen_a, seen_b = ~a.true.lost, ~b.true.lost
    return Overlap(
        int((seen_a & seen_b).sum()),
        int((seen_a ^ seen_b).sum()),
        int((~seen_a & ~seen_b).sum()),
        b.pairs.centroid_m[in_b] - a.pairs.centroid_m[in_a],
        int(lost.sum()),
        int((again.matched & lost).sum()),
    )


def overlaps(network: Network, scene: Scene, seed: int) -> list[Overlap]:
    """Every pair of neighbouring frames over a connected piece of ground, on the raster of the truth."""
    config, surface, truth = FlightConfig(), SceneSurface(scene), scene.resampled(SCORED_GSD_M)
    seen = {
        cell: frame(network, surface, truth, centre, config, np.random.default_rng([seed, *cell]))
        for cell, centre in centres(truth, config)
    }
    steps = [((row, column), (row + r, column + c)) for row, column in seen for r, c in ((0, 1), (1, 0))]
    pairs = (overlap(truth, seen[one], seen[other]) for one, other in steps if other in seen)
    return [pair for pair in pairs if pair is not None]


@dataclass(frozen=True)
class Flicker:
    """How frames differ: share of buildings found in one of two frames alone, standard deviation per axis of
    what a find moves from frame to frame, share of the false ones that the next frame shows too."""

    buildings: int
    share: float
    centroid_sigma_m: float
    false: int
    false_again: float


def flicker(found: Sequence[Overlap]) -> Flicker | None:
    """Over all pairs; None when no building was seen twice, or nothing to tell movement from."""
    both, one, neither, false, again = (
        sum(getattr(o, name) for o in found) for name in ("both", "one", "neither", "false", "false_again")
    )
    apart = np.concatenate([o.apart_m for o in found]) if found else np.empty((0, 2))
    if len(apart) == 0:
        return None
    sigma = robust_sigma(apart.ravel()) / math.sqrt(2.0)
    seen = both + one + neither
    return Flicker(seen, one / seen, sigma, false, again / false if false else 0.0)
