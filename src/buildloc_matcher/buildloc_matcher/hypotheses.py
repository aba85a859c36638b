"""One similarity map -> world from every pair of matched stars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.descriptors import Stars
from buildloc_matcher.geometry import wrap
from buildloc_matcher.matching import Matches


@dataclass(frozen=True)
class Hypotheses:
    """H hypotheses: world position of the query-map centre (H, 2) m, yaw (H,) rad, scale, weight."""

    positions_m: FloatArray
    yaws_rad: FloatArray
    scales: FloatArray
    weights: FloatArray
    mirrored: int
    off_scale: int

    def __len__(self) -> int:
        return len(self.weights)


def _complex(points_m: FloatArray) -> np.ndarray:
    return np.asarray(points_m[..., 0] + 1j * points_m[..., 1])


def _orientation(corners: np.ndarray) -> np.ndarray:
    """Sign of the signed area of triangles (M, 3) of complex corners."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(np.sign((np.conj(one) * two).imag))


def hypothesize(
    matches: Matches,
    query: Stars,
    query_centroids_m: FloatArray,
    reference: Stars,
    reference_centroids_m: FloatArray,
    centre_m: FloatArray,
    config: MatcherConfig,
) -> Hypotheses:
    """Similarities from matched central triangles; vertices correspond by their sorted angles.

    Mirrored pairs are rejected. The scale is the mean of the three edge ratios weighted by the query
    edges (short edges carry the larger relative error); outside 1 +- scale_gate it is rejected.
    """
    source = _complex(query_centroids_m[query.triangles[matches.query]])
    target = _complex(reference_centroids_m[reference.triangles[matches.reference]])
    direct = _orientation(source) == _orientation(target)
    edges_source, edges_target = np.roll(source, -1, 1) - source, np.roll(target, -1, 1) - target
    scale = np.abs(edges_target).sum(axis=1) / np.maximum(np.abs(edges_source).sum(axis=1), 1e-12)
    yaw = np.angle((np.conj(edges_source) * edges_target).sum(axis=1))
    on_scale = np.abs(scale - 1.0) <= config.scale_gate
    kept = direct & on_scale
    centre = complex(centre_m[0], centre_m[1])
    moved = target.mean(axis=1) + scale * np.exp(1j * yaw) * (centre - source.mean(axis=1))
    return Hypotheses(
        np.column_stack([moved.real, moved.imag])[kept],
        wrap(yaw[kept]),
        scale[kept],
        matches.score[kept],
        mirrored=int((~direct).sum()),
        off_scale=int((direct & ~on_scale).sum()),
    )
