"""Buildings of the fused map: connected components that were seen whole, as outlines in metres."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import footprint
from buildloc_msgs_py.ground import outlines
from buildloc_msgs_py.types import LocalMap
from shapely.affinity import translate
from shapely.geometry import Polygon

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.fusion import FusedMap

LocalOutlines = tuple[Polygon, ...]


@dataclass(frozen=True)
class Extraction:
    """The map, its outlines in the same order, and how many components were left out for what."""

    local_map: LocalMap
    outlines: LocalOutlines
    truncated: int
    unusable: int


def extract_buildings(fused: FusedMap, stamp_ns: int, config: MapperConfig) -> Extraction:
    """Outlines, centroids and shapes of the confirmed buildings, in ``buildloc_map``.

    A component that touches ground seen by fewer than ``min_observations`` keyframes was not seen whole
    and is left out: its centroid and shape would be wrong.
    """
    confirmed = fused.confirmed(config)
    height, width = confirmed.shape
    count, labels = cv2.connectedComponents(confirmed, connectivity=8)
    weak = np.pad((fused.seen < config.min_observations).astype(np.uint8), 1, constant_values=1)
    edge = cv2.dilate(weak, np.ones((3, 3), np.uint8))[1:-1, 1:-1].astype(bool)
    cut = np.unique(labels[edge & (confirmed > 0)])
    whole = np.ones(count, dtype=bool)
    whole[cut] = False
    mask = np.where(whole[labels] & (confirmed > 0), np.uint8(255), np.uint8(0))
    # ``outlines`` has its origin at the image centre.
    shift = (fused.left_m + width * fused.gsd_m / 2.0, fused.top_m - height * fused.gsd_m / 2.0)
    kept, rows, observed, unusable = [], [], [], 0
    for outline in outlines(mask, fused.gsd_m, config.min_area_m2):
        placed = translate(outline, *shift).simplify(config.simplify_m)
        try:
            measured = footprint(placed)
        except BuildlocError:
            unusable += 1
            continue
        column = int((measured.x_m - fused.left_m) / fused.gsd_m)
        row = int((fused.top_m - measured.y_m) / fused.gsd_m)
        kept.append(placed)
        rows.append((measured.x_m, measured.y_m, measured.area_m2, *measured.shape))
        observed.append(int(fused.seen[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]))
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    local_map = LocalMap(
        stamp_ns, np.arange(len(table), dtype=np.int64), table[:, :2], table[:, 2], table[:, 3:],
        np.array(observed, dtype=np.int64),
    )  # fmt: skip
    return Extraction(local_map, tuple(kept), len(cut), unusable)
