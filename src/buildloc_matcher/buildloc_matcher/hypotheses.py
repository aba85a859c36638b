"""One similarity map -> world from every pair of matched stars."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numba import njit
from numpy.typing import NDArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.matching import NOTHING, Matches
from buildloc_matcher.reference.database import ReferenceDatabase

KEPT, MIRRORED, OFF_SCALE = 0.0, 1.0, 2.0
PER_HYPOTHESIS = ("stars", "places_m", "positions_m", "yaws_rad", "scales", "weights")


@dataclass(frozen=True)
class Hypotheses:
    """H hypotheses: query star (H,), world places of its corners (H, 3, 2) m, world position of the
    query-map centre (H, 2) m, yaw (H,) rad, scale (H,), vote (H,)."""

    stars: NDArray[np.int64]
    places_m: FloatArray
    positions_m: FloatArray
    yaws_rad: FloatArray
    scales: FloatArray
    weights: FloatArray
    mirrored: int
    off_scale: int

    def __len__(self) -> int:
        return len(self.weights)

    def joined(self, other: Hypotheses, stars: int) -> Hypotheses:
        """These and others, whose stars are numbered after so many."""
        ours, theirs = vars(self), vars(other) | {"stars": other.stars + stars}
        both: dict[str, Any] = {n: np.concatenate([ours[n], theirs[n]]) for n in PER_HYPOTHESIS}
        return replace(self, **both)

    def heaviest(self, count: int) -> Hypotheses:
        """So many with the largest votes."""
        if len(self) <= count:
            return self
        least = np.partition(self.weights, -count)[-count]
        return self.weighted(np.where(self.weights >= least, self.weights, 0.0))

    def weighted(self, weights: FloatArray) -> Hypotheses:
        """The hypotheses whose new vote is positive."""
        kept = weights > 0.0
        some: dict[str, Any] = {name: vars(self)[name][kept] for name in PER_HYPOTHESIS}
        return replace(self, **some | {"weights": weights[kept]})


@njit(nogil=True, cache=True)
def _similarities(stars, places, corners, query, centre, gate, out):  # type: ignore[no-untyped-def]
    """Per match: x, y of the moved centre, yaw, scale (none of these if mirrored), verdict KEPT, MIRRORED or
    OFF_SCALE."""
    for h in range(len(stars)):
        i, j, k = corners[stars[h], 0], corners[stars[h], 1], corners[stars[h], 2]
        x0, y0, x1, y1, x2, y2 = query[i, 0], query[i, 1], query[j, 0], query[j, 1], query[k, 0], query[k, 1]
        u0, v0, u1, v1 = places[h, 0, 0], places[h, 0, 1], places[h, 1, 0], places[h, 1, 1]
        u2, v2 = places[h, 2, 0], places[h, 2, 1]
        turned = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
        matched = (u1 - u0) * (v2 - v0) - (v1 - v0) * (u2 - u0)
        if turned * matched <= 0.0:
            out[h, 4] = MIRRORED
            continue
        real, imag, ours, theirs = 0.0, 0.0, 0.0, 0.0
        for x, y, u, v in (
            (x1 - x0, y1 - y0, u1 - u0, v1 - v0),
            (x2 - x1, y2 - y1, u2 - u1, v2 - v1),
            (x0 - x2, y0 - y2, u0 - u2, v0 - v2),
        ):
            real, imag = real + x * u + y * v, imag + x * v - y * u
            ours, theirs = ours + math.sqrt(x * x + y * y), theirs + math.sqrt(u * u + v * v)
        scale, yaw = theirs / max(ours, 1e-12), math.atan2(imag, real)
        x, y = centre[0] - (x0 + x1 + x2) / 3.0, centre[1] - (y0 + y1 + y2) / 3.0
        c, s = scale * math.cos(yaw), scale * math.sin(yaw)
        out[h, 0] = (u0 + u1 + u2) / 3.0 + c * x - s * y
        out[h, 1] = (v0 + v1 + v2) / 3.0 + s * x + c * y
        out[h, 2], out[h, 3] = yaw, scale
        out[h, 4] = OFF_SCALE if abs(scale - 1.0) > gate else KEPT


def hypothesize(
    matches: Matches,
    corners: NDArray[np.int64],
    query_centroids_m: FloatArray,
    database: ReferenceDatabase,
    centre_m: FloatArray,
    config: MatcherConfig,
) -> Hypotheses:
    """Similarities from matched central triangles; vertices correspond by their sorted angles.

    ``corners`` (S, 3) are the map's buildings at the corners of its stars. Mirrored pairs are rejected. The
    scale is the mean of the three edge ratios weighted by the query edges (short edges carry the larger
    relative error); outside 1 +- scale_gate it is rejected. A vote weighs the star score (Eq. 3).
    """
    stars, columns = np.nonzero(matches.reference != NOTHING)
    places = database.star_corners(matches.reference[stars, columns])
    found = np.empty((len(stars), 5))
    _similarities(stars, places, corners, query_centroids_m, centre_m, config.scale_gate, found)
    kept = found[:, 4] == KEPT
    return Hypotheses(
        stars[kept],
        places[kept],
        found[kept, :2],
        found[kept, 2],
        found[kept, 3],
        matches.score[stars, columns][kept].astype(np.float64),
        mirrored=int((found[:, 4] == MIRRORED).sum()),
        off_scale=int((found[:, 4] == OFF_SCALE).sum()),
    )
