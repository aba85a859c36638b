"""One similarity map -> world from every pair of matched stars."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.geometry import wrap
from buildloc_matcher.matching import NOTHING, Matches
from buildloc_matcher.reference.database import ReferenceDatabase


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


def _complex(points_m: FloatArray) -> NDArray[np.complex128]:
    return np.asarray(points_m[..., 0] + 1j * points_m[..., 1])


def _orientation(corners: NDArray[np.complex128]) -> FloatArray:
    """Sign of the signed area of triangles (M, 3) of complex corners."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(np.sign((np.conj(one) * two).imag))


def hypothesize(
    matches: Matches,
    corners: NDArray[np.int64],
    query_centroids_m: FloatArray,
    database: ReferenceDatabase,
    centre_m: FloatArray,
    config: MatcherConfig,
) -> Hypotheses:
    """Similarities from matched central triangles, those of the map's stars at ``corners`` (S, 3); vertices correspond by their sorted angles.

    Mirrored pairs are rejected. The scale is the mean of the three edge ratios weighted by the query
    edges (short edges carry the larger relative error); outside 1 +- scale_gate it is rejected. A vote
    weighs the star score (Eq. 3).
    """
    stars, columns = np.nonzero(matches.reference != NOTHING)
    places = database.star_corners(matches.reference[stars, columns])
    source, target = _complex(query_centroids_m[corners[stars]]), _complex(places)
    direct = _orientation(source) == _orientation(target)
    edges_source, edges_target = np.roll(source, -1, 1) - source, np.roll(target, -1, 1) - target
    scale = np.abs(edges_target).sum(axis=1) / np.maximum(np.abs(edges_source).sum(axis=1), 1e-12)
    yaw = np.angle((np.conj(edges_source) * edges_target).sum(axis=1))
    on_scale = np.abs(scale - 1.0) <= config.scale_gate
    kept = direct & on_scale
    centre = complex(centre_m[0], centre_m[1])
    moved = target.mean(axis=1) + scale * np.exp(1j * yaw) * (centre - source.mean(axis=1))
    return Hypotheses(
        stars[kept],
        places[kept],
        np.column_stack([moved.real, moved.imag])[kept],
        wrap(yaw[kept]),
        scale[kept],
        matches.score[stars, columns][kept].astype(np.float64),
        mirrored=int((~direct).sum()),
        off_scale=int((direct & ~on_scale).sum()),
    )
