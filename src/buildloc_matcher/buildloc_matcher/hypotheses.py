"""One similarity map -> world from every pair of matched stars."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numba import njit
from numpy.typing import NDArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.matching import NOTHING, Matches
from buildloc_matcher.reference.database import ReferenceDatabase

KEPT, MIRRORED, OFF_SCALE = 0.0, 1.0, 2.0


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

    def weighted(self, weights: FloatArray) -> Hypotheses:
        """The hypotheses whose new vote is positive."""
        kept = weights > 0.0
        return replace(
            self, stars=self.stars[kept], places_m=self.places_m[kept], positions_m=self.positions_m[kept],
            yaws_rad=self.yaws_rad[kept], scales=self.scales[kept], weights=weights[kept],
        )  # fmt: skip


@njit(nogil=True, cache=True)
def _similarities(stars, places, corners, query, centre, gate, out):  # type: ignore[no-untyped-def]
    """Per match: x, y of the moved centre, yaw, scale, verdict KEPT, MIRRORED or OFF_SCALE."""
    for h in range(len(stars)):
        q = query[corners[stars[h]]]
        r = places[h]
        turned = (q[1, 0] - q[0, 0]) * (q[2, 1] - q[0, 1]) - (q[1, 1] - q[0, 1]) * (q[2, 0] - q[0, 0])
        matched = (r[1, 0] - r[0, 0]) * (r[2, 1] - r[0, 1]) - (r[1, 1] - r[0, 1]) * (r[2, 0] - r[0, 0])
        real, imag, ours, theirs = 0.0, 0.0, 0.0, 0.0
        for k in range(3):
            n = (k + 1) % 3
            x, y, u, v = q[n, 0] - q[k, 0], q[n, 1] - q[k, 1], r[n, 0] - r[k, 0], r[n, 1] - r[k, 1]
            real, imag = real + x * u + y * v, imag + x * v - y * u
            ours, theirs = ours + math.sqrt(x * x + y * y), theirs + math.sqrt(u * u + v * v)
        scale, yaw = theirs / max(ours, 1e-12), math.atan2(imag, real)
        x, y = centre[0] - q[:, 0].mean(), centre[1] - q[:, 1].mean()
        c, s = scale * math.cos(yaw), scale * math.sin(yaw)
        out[h, 0], out[h, 1] = r[:, 0].mean() + c * x - s * y, r[:, 1].mean() + s * x + c * y
        out[h, 2], out[h, 3] = yaw, scale
        out[h, 4] = MIRRORED if turned * matched <= 0.0 else (OFF_SCALE if abs(scale - 1.0) > gate else KEPT)


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
