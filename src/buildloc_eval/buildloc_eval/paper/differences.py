"""How the reference differs from what is flown over: both are drawn from the same real footprints.

The reference is what another digitiser would have left out, and what automatic mapping does on top; what is
flown over is what a third one would have drawn. Outlines are (N,) valid polygons in metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from buildloc_eval.observation import Digitiser, digitising_offsets
from buildloc_eval.segmentation_errors import Outlines

STRIPS_AT_ONCE = 500


@dataclass(frozen=True)
class AutomaticMapping:
    """What Microsoft's footprints do beyond a human digitiser.

    ``missed``: share of the buildings in strips that were left out; ``strip_m``: their length and width.
    ``merged``: share of the buildings that are one with a neighbour within ``merge_reach_m``. ``shift_m``:
    least and largest shift of an image of ``image_m`` a side.
    """

    missed: float = 0.03
    strip_m: tuple[float, float] = (200.0, 40.0)
    merged: float = 0.04
    merge_reach_m: float = 2.0
    shift_m: tuple[float, float] = (1.0, 3.0)
    image_m: float = 500.0


def redrawn(outlines: Outlines, digitiser: Digitiser, rng: np.random.Generator) -> Outlines:
    """The buildings as another digitiser draws them: some are left out, all are moved, resized, stretched
    along their walls and bent at the corners."""
    kept = outlines[rng.random(len(outlines)) >= digitiser.reference_only]
    count = len(kept)
    offsets = digitising_offsets(count, digitiser, rng)
    zoom = np.exp(0.5 * rng.normal(0.0, digitiser.log_area_sigma, count))
    # A stretch by e along and 1/e across changes the elongation by twice that, of typically 0.65.
    stretch = np.exp(rng.normal(0.0, digitiser.shape_sigma[1] / (2.0 * 0.65), count))
    along = np.exp(1j * wall_directions(kept))
    points, of = shapely.get_coordinates(kept, return_index=True)
    centres = shapely.get_coordinates(shapely.centroid(kept)) @ (1.0, 1.0j)
    local = (points @ (1.0, 1.0j) - centres[of]) / along[of]
    sized = zoom[of] * (local.real * stretch[of] + 1j * local.imag / stretch[of])
    placed = centres[of] + sized * along[of] + (offsets @ (1.0, 1.0j))[of]
    moved = shapely.set_coordinates(kept.copy(), np.column_stack([placed.real, placed.imag]))
    return np.asarray(moved)


def wall_directions(outlines: Outlines) -> FloatArray:
    """(N,) direction of each polygon's longest wall, radians."""
    points, of = shapely.get_coordinates(outlines, return_index=True)
    walls, same = np.diff(points, axis=0), of[1:] == of[:-1]
    length = np.where(same, np.hypot(*walls.T), -1.0)
    order = np.lexsort((length, of[:-1]))
    longest = order[np.searchsorted(of[:-1][order], np.arange(len(outlines)), side="right") - 1]
    return np.asarray(np.arctan2(walls[longest, 1], walls[longest, 0]))


def reference_outlines(
    outlines: Outlines, digitiser: Digitiser, model: AutomaticMapping, rng: np.random.Generator
) -> Outlines:
    """The buildings as the reference has them."""
    kept = outlines[rng.random(len(outlines)) >= digitiser.world_only]
    kept = kept[~in_strips(shapely.get_coordinates(shapely.centroid(kept)), model, rng)]
    return shifted(merged(kept, model, rng), model, rng)


def in_strips(
    centroids_m: FloatArray, model: AutomaticMapping, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """(N,) which buildings lie in strips at any heading that are added until they hold the share."""
    missed = np.zeros(len(centroids_m), dtype=bool)
    if not len(missed):
        return missed
    tree, (long, wide) = cKDTree(centroids_m), model.strip_m
    while missed.mean() < model.missed:
        for start in rng.integers(0, len(missed), STRIPS_AT_ONCE):
            if missed.mean() >= model.missed:
                break
            near = np.array(tree.query_ball_point(centroids_m[start], math.hypot(long, wide) / 2.0))
            heading = rng.uniform(0.0, math.pi)
            away = (centroids_m[near] - centroids_m[start]) @ (1.0, 1.0j) * np.exp(-1j * heading)
            missed[near[(np.abs(away.real) <= long / 2.0) & (np.abs(away.imag) <= wide / 2.0)]] = True
    return missed


def merged(outlines: Outlines, model: AutomaticMapping, rng: np.random.Generator) -> Outlines:
    """Some buildings joined with their nearest neighbour, where that is near enough."""
    tree = shapely.STRtree(outlines)
    drawn = rng.permutation(len(outlines))
    alone, joined = np.ones(len(outlines), dtype=bool), list[shapely.Polygon]()
    for chunk in np.array_split(drawn, max(1, len(drawn) // 2000)):
        if 2 * len(joined) >= model.merged * len(outlines):
            break
        one, other = tree.query(outlines[chunk], predicate="dwithin", distance=model.merge_reach_m)
        for a, b in zip(chunk[one].tolist(), other.tolist(), strict=True):
            if a == b or not (alone[a] and alone[b]) or 2 * len(joined) >= model.merged * len(outlines):
                continue
            half = 0.5 * model.merge_reach_m + 0.1
            both = shapely.union(outlines[a], outlines[b]).buffer(half, join_style="mitre").buffer(
                -half, join_style="mitre"
            )  # fmt: skip
            if isinstance(both, shapely.Polygon) and both.area > 0.0:
                joined.append(shapely.Polygon(both.exterior))
                alone[[a, b]] = False
    return np.array([*outlines[alone], *joined], dtype=object)


def shifted(outlines: Outlines, model: AutomaticMapping, rng: np.random.Generator) -> Outlines:
    """All buildings of an image moved by its own shift."""
    points, of = shapely.get_coordinates(outlines, return_index=True)
    centres = shapely.get_coordinates(shapely.centroid(outlines))
    column, row = ((centres - centres.min(axis=0)) // model.image_m).astype(np.int64).T
    length = rng.uniform(*model.shift_m, (column.max() + 1, row.max() + 1))
    angle = rng.uniform(-math.pi, math.pi, length.shape)
    shift = np.stack([length * np.cos(angle), length * np.sin(angle)], axis=2)[column, row]
    return np.asarray(shapely.set_coordinates(outlines.copy(), points + shift[of]))
