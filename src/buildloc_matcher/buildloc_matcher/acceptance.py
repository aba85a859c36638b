"""The gate between a ranked candidate and a fix: every refusal says which figure fell short."""

from __future__ import annotations

import math
from collections.abc import Sequence

from buildloc_msgs_py.types import Candidate
from scipy.stats import binom

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.geometry import wrap
from buildloc_matcher.refinement import Refined
from buildloc_matcher.selection import Score

ROTATIONS = 36


def lead(best: Candidate, others: Sequence[Candidate], config: MatcherConfig) -> float:
    """Ratio of the best MNN-Jaccard to that of the best other pose; infinite without another.

    Another pose is further away than ``rival_distance_m`` or turned by more than twice the rotation
    tolerance: neighbours of the best bin are the same answer.
    """
    turned = math.radians(2.0 * config.rotation_tolerance_deg)
    rivals = [
        c.mnn_jaccard
        for c in others
        if math.hypot(c.x_m - best.x_m, c.y_m - best.y_m) > config.rival_distance_m
        or abs(float(wrap(c.yaw_rad - best.yaw_rad))) > turned
    ]
    strongest = max(rivals, default=0.0)
    return best.mnn_jaccard / strongest if strongest > 0.0 else math.inf


def acceptance_score(jaccard: float, lead_ratio: float, config: MatcherConfig) -> float:
    """Evidence over threshold, the weaker of the two: 1 or more passes both."""
    by_jaccard = jaccard / config.min_jaccard if config.min_jaccard > 0.0 else math.inf
    return min(by_jaccard, lead_ratio / config.min_lead)


def log10_false_alarm(score: Score, area_m2: float, config: MatcherConfig) -> float:
    """log10 of how many poses of the whole reference would match this well by chance.

    A building dropped at random has a reference building within the MNN distance d with probability
    p = 1 - exp(-density pi d^2); the tail of the binomial over the map's buildings is the chance of one
    pose, and area / (pi d^2) positions times 36 rotations are tried. Buildings along streets are less
    random than that, hence a limit well below 0 (``max_log10_false_alarm``).
    """
    disc_m2 = math.pi * config.mnn_distance_m**2
    chance = -math.expm1(-score.density_per_m2 * disc_m2)
    trials = max(1.0, area_m2 / disc_m2) * ROTATIONS
    tail = float(binom.logsf(score.pairs - 1, score.queries, chance)) / math.log(10.0)
    return tail + math.log10(trials)


def refuse_coarse(score: Score, lead_ratio: float, false_alarm: float, config: MatcherConfig) -> str | None:
    """Why the best candidate is not convincing, or None; ``false_alarm`` is its log10."""
    if score.jaccard < config.min_jaccard:
        return f"best candidate has MNN-Jaccard {score.jaccard:.2f}, below {config.min_jaccard:g}"
    if lead_ratio < config.min_lead:
        return f"best candidate leads another pose only {lead_ratio:.2f} times, below {config.min_lead:g}"
    if score.pairs < config.min_pairs:
        return f"best candidate matches {score.pairs} buildings, fewer than {config.min_pairs}"
    if false_alarm > config.max_log10_false_alarm:
        return f"best candidate could be chance: 1e{false_alarm:+.1f} such poses expected in the reference"
    if score.rms_m > config.max_residual_m:
        return f"best candidate has residuals of {score.rms_m:.1f} m, above {config.max_residual_m:g} m"
    return None


def refuse_refined(refined: Refined | None, config: MatcherConfig) -> str | None:
    """Why the refined pose is not convincing, or None."""
    if refined is None:
        return "refinement found no buildings of the recent frames in the reference"
    if refined.buildings < config.min_pairs:
        return f"refinement matched {refined.buildings} buildings, fewer than {config.min_pairs}"
    if refined.rms_m > config.max_residual_m:
        return f"refinement left residuals of {refined.rms_m:.1f} m, above {config.max_residual_m:g} m"
    return None
