"""The gate between a ranked candidate and a fix: every refusal says which figure fell short."""

from __future__ import annotations

import math
from collections.abc import Sequence

from buildloc_msgs_py.types import Candidate

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import GATE_SIGMAS
from buildloc_matcher.geometry import wrap
from buildloc_matcher.refinement import Refined
from buildloc_matcher.selection import Score

ROTATIONS = 36


def lead(best: Candidate, others: Sequence[Candidate], config: MatcherConfig) -> float:
    """Evidence of the best candidate beyond that of the best other pose, nats; infinite without another.

    Another pose is further away than ``rival_distance_m`` or turned by more than twice the rotation
    tolerance: neighbours of the best bin are the same answer.
    """
    turned = math.radians(2.0 * config.rotation_tolerance_deg)
    rivals = [
        c.acceptance
        for c in others
        if math.hypot(c.x_m - best.x_m, c.y_m - best.y_m) > config.rival_distance_m
        or abs(float(wrap(c.yaw_rad - best.yaw_rad))) > turned
    ]
    return best.acceptance - max(rivals, default=-math.inf)


def log_odds(evidence: float, area_m2: float, config: MatcherConfig) -> float:
    """Evidence of a candidate less the logarithm of the number of poses the reference has room for.

    A pose fills a disc as wide as the gate of a match, and a turn of 10 degrees. Nats: above 0 the map
    lies here more likely than such evidence comes up by chance somewhere.
    """
    disc_m2 = math.pi * (GATE_SIGMAS * config.sigma_m) ** 2
    return evidence - math.log(max(1.0, area_m2 / disc_m2) * ROTATIONS)


def refuse_coarse(score: Score, lead_nats: float, odds: float, config: MatcherConfig) -> str | None:
    """Why the best candidate is not convincing, or None; ``odds`` are its log-odds."""
    if odds < config.min_log_odds:
        return f"best candidate could be chance: log-odds {odds:.1f}, below {config.min_log_odds:g}"
    if score.jaccard < config.min_jaccard:
        return f"best candidate has MNN-Jaccard {score.jaccard:.2f}, below {config.min_jaccard:g}"
    if lead_nats < config.min_lead:
        return f"best candidate leads another place by {lead_nats:.1f} nats, below {config.min_lead:g}"
    if len(score.pairs) < config.min_pairs:
        return f"best candidate matches {len(score.pairs)} buildings, fewer than {config.min_pairs}"
    if score.rms_m > config.max_residual_m:
        return f"best candidate has residuals of {score.rms_m:.1f} m, above {config.max_residual_m:g} m"
    return None


def refuse_refined(refined: Refined, config: MatcherConfig) -> str | None:
    """Why the refined pose is not convincing, or None."""
    if refined.buildings < config.min_pairs:
        return f"refinement matched {refined.buildings} buildings, fewer than {config.min_pairs}"
    if refined.rms_m > config.max_residual_m:
        return f"refinement left residuals of {refined.rms_m:.1f} m, above {config.max_residual_m:g} m"
    return None
