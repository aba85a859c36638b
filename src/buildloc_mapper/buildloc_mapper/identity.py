"""Which building of the map is which of an earlier one."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

Outlines = NDArray[np.object_]


def _best(pairs: NDArray[np.int64], overlap: NDArray[np.float64], side: int, count: int) -> NDArray[np.int64]:
    """(count,) the pair with the largest overlap of every outline of one side; -1 where there is none."""
    best = np.full(count, -1, dtype=np.int64)
    order = np.argsort(overlap, kind="stable")
    best[pairs[side, order]] = order
    return best


def continued(outlines: Outlines, earlier: Outlines) -> NDArray[np.int64]:
    """(N,) which of ``earlier`` (M,) each outline goes on to be, -1 for none; none is given twice.

    Two outlines are the same building when each overlaps the other most, by intersection over union. So
    of a building that splits the largest part goes on, and where several merge the largest of them.
    """
    pairs = np.asarray(shapely.STRtree(earlier).query(outlines, predicate="intersects"), dtype=np.int64)
    new, old = outlines[pairs[0]], earlier[pairs[1]]
    common = shapely.area(shapely.intersection(new, old))
    overlap = common / (shapely.area(new) + shapely.area(old) - common)
    pairs, overlap = pairs[:, overlap > 0.0], overlap[overlap > 0.0]
    of_new, of_old = _best(pairs, overlap, 0, len(outlines)), _best(pairs, overlap, 1, len(earlier))
    found = np.full(len(outlines), -1, dtype=np.int64)
    rows = np.flatnonzero(of_new >= 0)
    old_rows = pairs[1, of_new[rows]]
    mutual = of_old[old_rows] == of_new[rows]
    found[rows[mutual]] = old_rows[mutual]
    return found
