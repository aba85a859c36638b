"""Star matching as it is stated, in plain NumPy: every pair is compared. The fast one must agree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.descriptors import AREA, PERIMETER, SHAPE
from buildloc_matcher.matching import NOTHING, PI, Matches, QueryStars, scoring

F32 = np.float32


def differences(
    query: NDArray[np.float32], reference: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """d_alpha, d_P and d_S (Eq. 1) of one triangle (8,) and triangles (M, 8) -> (M,) each."""
    apart = np.abs(reference - query)
    largest = np.abs((PI - reference[:, 0] - reference[:, 1]) - (PI - query[0] - query[1]))
    d_angle = apart[:, 0] + apart[:, 1] + largest
    d_perimeter = relative(query[PERIMETER], reference[:, PERIMETER])
    shape = apart[:, SHAPE:]
    d_shape = F32(0.25) * (shape[:, 0] + shape[:, 1] + shape[:, 2] + shape[:, 3])
    return d_angle, d_perimeter, d_shape


def relative(one: NDArray[np.float32] | np.float32, other: NDArray[np.float32]) -> NDArray[np.float32]:
    """|a - b| / max(a, b), as in d_P of Eq. 1."""
    return np.asarray(np.abs(other - one) / np.maximum(other, one))


def agreement(
    query: NDArray[np.float32],
    reference: NDArray[np.float32],
    d_area: NDArray[np.float32],
    config: MatcherConfig,
) -> NDArray[np.float32]:
    """Score (Eq. 2, and the areas) of one triangle (8,) with triangles (M, 8) -> (M,) in [0, 1]."""
    _, _, _, angle, perimeter, area, area_weight, _ = scoring(config)
    d_angle, d_perimeter, d_shape = differences(query, reference)
    s_angle = np.maximum(F32(0.0), F32(1.0) - d_angle / angle)
    s_perimeter = np.maximum(F32(0.0), F32(1.0) - d_perimeter / perimeter)
    s_area = np.maximum(F32(0.0), F32(1.0) - d_area / area)
    total = F32(2.0) * s_angle + s_perimeter + (F32(1.0) - d_shape) + area_weight * s_area
    return np.asarray(total / (F32(4.0) + area_weight))


def star_scores(
    star: NDArray[np.float32], areas_m2: NDArray[np.float32], reference: QueryStars, config: MatcherConfig
) -> NDArray[np.float32]:
    """Score of one star (4, 8) with sorted vertex areas (3,) and all reference stars -> (R,)."""
    corners = relative(areas_m2, reference.areas_m2)
    centre_weight = scoring(config)[7]
    d_area = F32(1.0 / 3.0) * (corners[:, 0] + corners[:, 1] + corners[:, 2])
    total = centre_weight * agreement(star[0], reference.features[:, 0], d_area, config)
    for j in range(1, 4):
        theirs = reference.features[:, j]
        total = total + agreement(star[j], theirs, relative(star[j, AREA], theirs[:, AREA]), config)
    return np.asarray(total / (centre_weight + F32(3.0)))


def match_stars(stars: QueryStars, reference: QueryStars, config: MatcherConfig) -> Matches:
    """The best compatible reference stars of every query star; lower rows win ties."""
    tau_angle, tau_perimeter, tau_shape = scoring(config)[:3]
    kept, passed = config.matches_per_star, 0
    best = np.full((len(stars), kept), NOTHING, dtype=np.int64)
    scores = np.zeros((len(stars), kept), dtype=np.float32)
    for i, star in enumerate(stars.features):
        d_angle, d_perimeter, d_shape = differences(star[0], reference.features[:, 0])
        rows = np.flatnonzero((d_angle < tau_angle) & (d_perimeter <= tau_perimeter) & (d_shape <= tau_shape))
        score = star_scores(star, stars.areas_m2[i], reference.select(rows), config)
        order = np.lexsort((rows, -score))[:kept]
        passed += len(rows)
        best[i, : len(order)], scores[i, : len(order)] = rows[order], score[order]
    return Matches(best, scores, len(stars) * len(reference), passed)
