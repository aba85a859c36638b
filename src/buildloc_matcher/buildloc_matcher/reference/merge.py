"""One building where several sources, or one source twice, drew it.

Sources rank by their order on the command line. A building is dropped when it overlaps a building of an
earlier source by at least half of the smaller of the two, whether that one is dropped itself or not; and when
one of its own source, larger or else further west or south, has its centroid within a centimetre. So what
becomes of a building depends on its surroundings alone, not on the order of work or on tiles.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely import STRtree

from buildloc_matcher.reference.buildings import Buildings
from buildloc_matcher.reference.readers import Geometries
from buildloc_matcher.reference.region import Bounds
from buildloc_matcher.reference.spool import Rows, Spool, buildings_of, grown, inside

OVERLAP = 0.5
DUPLICATE_M = 0.01


def overlapping(sources: NDArray[np.uint16], outlines: Geometries) -> NDArray[np.bool_]:
    """Which outlines (N) lie by half over one of an earlier source, or the other way round."""
    dropped = np.zeros(len(outlines), dtype=bool)
    later = np.flatnonzero(sources > sources.min(initial=np.iinfo(np.uint16).max))
    earlier = np.flatnonzero(sources < sources.max(initial=0))
    pairs = STRtree(outlines[earlier]).query(outlines[later], predicate="intersects")
    a, b = later[pairs[0]], earlier[pairs[1]]
    ranked = sources[b] < sources[a]
    a, b = a[ranked], b[ranked]
    areas = shapely.area(outlines)
    common = shapely.area(shapely.intersection(outlines[a], outlines[b]))
    dropped[a[common >= OVERLAP * np.minimum(areas[a], areas[b])]] = True
    return dropped


def overlapping_ids(spool: Spool) -> NDArray[np.int64]:
    """Ids of all buildings of a spool that those of earlier sources replace, sorted.

    Two outlines that overlap share a point, and both are in the cell of that point: no pair is missed.
    """
    found = [np.empty(0, dtype=np.int64)]
    for cell in spool.cells():
        sources, ids, outlines = spool.outlines(cell)
        found.append(ids[overlapping(sources, outlines)])
    return np.unique(np.concatenate(found))


def duplicates(rows: Rows) -> NDArray[np.bool_]:
    """Which buildings lie within a centimetre of one of their own source that comes before them."""
    dropped = np.zeros(len(rows), dtype=bool)
    rank = np.empty(len(rows), dtype=np.int64)
    rank[np.lexsort((rows["id"], rows["y"], rows["x"], -rows["area"]))] = np.arange(len(rows))
    points = np.column_stack([rows["x"], rows["y"]])
    pairs = cKDTree(points).query_pairs(DUPLICATE_M, output_type="ndarray")
    pairs = pairs[rows["source"][pairs[:, 0]] == rows["source"][pairs[:, 1]]]
    dropped[np.where(rank[pairs[:, 0]] > rank[pairs[:, 1]], pairs[:, 0], pairs[:, 1])] = True
    return dropped


def windows(
    spool: Spool,
    replaced: NDArray[np.int64],
    boxes_m: Iterable[Bounds],
    margin_m: float,
    counts: Counter[str],
) -> Iterator[Buildings]:
    """For each box, the buildings of the box grown by a margin, without what is drawn twice.

    They are sorted by x, then y, so that they are the same whatever order they were read in. ``replaced`` is
    of :func:`overlapping_ids`; ``counts`` grows by what became of the buildings of the boxes themselves.
    """
    for box in boxes_m:
        rows = spool.rows(grown(box, margin_m + DUPLICATE_M))
        overlaps = np.isin(rows["id"], replaced)
        counts["overlapping"] += int((overlaps & inside(rows, box)).sum())
        rows = rows[~overlaps]
        doubles = duplicates(rows)
        counts["duplicate"] += int((doubles & inside(rows, box)).sum())
        rows = rows[~doubles]
        counts["used"] += int(inside(rows, box).sum())
        yield buildings_of(_in_order(rows[inside(rows, grown(box, margin_m))]))


def _in_order(rows: Rows) -> Rows:
    # Two buildings may share a centroid, one in the courtyard of the other: the rest decides.
    shape = rows["shape"]
    keys = (*(shape[:, k] for k in range(shape.shape[1])), rows["area"], rows["y"], rows["x"])
    return rows[np.lexsort(keys)]
