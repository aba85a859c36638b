"""The gate between a ranked candidate and a fix: accepted, undecided or rejected, and which figure fell
short.

The log-odds that the map lies at the best candidate, and neither at any of the other places that were found
nor anywhere that chance could put it, are its score; those of a map with much evidence count for less, since
by so much more two places that look alike differ by chance. How high the score gets where the map lies
nowhere near was measured (``calibration.json``); the threshold follows from the rate of false fixes wanted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from buildloc_msgs_py.types import Candidate

from buildloc_matcher.calibration import false_fix_probability, threshold
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import GATE_SIGMAS
from buildloc_matcher.geometry import wrap
from buildloc_matcher.refinement import Refined
from buildloc_matcher.selection import Score

ROTATIONS = 36
FACE_VALUE_NATS = 50.0  # of evidence, up to which odds are taken as they are


class Outcome(StrEnum):
    """Accepted: a fix. Rejected: the reference shows no such place. Undecided: it may be there, or at
    another place that looks alike, and more must be seen."""

    ACCEPTED = "accepted"
    UNDECIDED = "undecided"
    REJECTED = "rejected"


@dataclass(frozen=True)
class Verdict:
    """An outcome, why it is no fix (None where it is one), the score in nats, and how often a map that lies
    nowhere near scores as high."""

    outcome: Outcome
    reason: str | None
    score: float
    false_fix_probability: float


def _elsewhere(best: Candidate, others: Sequence[Candidate], config: MatcherConfig) -> list[float]:
    """Log-odds of other poses: further away than ``rival_distance_m`` or turned by more than twice the
    rotation tolerance. Neighbours of the best bin are the same answer."""
    turned = math.radians(2.0 * config.rotation_tolerance_deg)
    return [
        c.acceptance
        for c in others
        if math.hypot(c.x_m - best.x_m, c.y_m - best.y_m) > config.rival_distance_m
        or abs(float(wrap(c.yaw_rad - best.yaw_rad))) > turned
    ]


def lead(best: Candidate, others: Sequence[Candidate], config: MatcherConfig) -> float:
    """Evidence of the best candidate beyond that of the best other pose, nats; infinite without another."""
    return best.acceptance - max(_elsewhere(best, others, config), default=-math.inf)


def odds_against_all(best: Candidate, others: Sequence[Candidate], config: MatcherConfig) -> float:
    """Log-odds of the best candidate against everything else, nats: the other poses together, and chance,
    whose evidence is 0 as log-odds."""
    return best.acceptance - float(np.logaddexp.reduce([0.0, *_elsewhere(best, others, config)]))


def score(best: Candidate, others: Sequence[Candidate], config: MatcherConfig) -> float:
    """What the best candidate is worth, nats: its odds against everything else, per root of its evidence.

    Of two places that look alike, neither of which is right, every building speaks for the one or the other
    by chance. What the one leads by is a random walk: it grows with the root of the number of buildings, as
    evidence grows with the number.
    """
    odds = odds_against_all(best, others, config)
    return odds * math.sqrt(FACE_VALUE_NATS / max(best.acceptance, FACE_VALUE_NATS))


def log_odds(evidence: float, area_m2: float, config: MatcherConfig) -> float:
    """Evidence of a candidate less the logarithm of the number of poses the reference has room for.

    A pose fills a disc as wide as the gate of a match, and a turn of 10 degrees. Nats: above 0 the map
    lies here more likely than such evidence comes up by chance somewhere.
    """
    disc_m2 = math.pi * (GATE_SIGMAS * config.sigma_m) ** 2
    return evidence - math.log(max(1.0, area_m2 / disc_m2) * ROTATIONS)


def judge_candidate(
    best: Candidate, others: Sequence[Candidate], found: Score, config: MatcherConfig
) -> Verdict:
    """Whether the best candidate is convincing. ``found`` is its score in the selection."""
    nats, lead_nats = score(best, others, config), lead(best, others, config)
    chance, enough = false_fix_probability(nats), threshold(config.target_false_fix_rate)

    def not_yet(outcome: Outcome, reason: str) -> Verdict:
        return Verdict(outcome, f"{outcome}: {reason}", nats, chance)

    if best.acceptance < 0.0:
        return not_yet(
            Outcome.REJECTED, f"best candidate is no more than chance: log-odds {best.acceptance:.1f}"
        )
    if nats < enough:
        why = (
            f"score {nats:.1f} nats, below the {enough:.1f} for {config.target_false_fix_rate:g} false fixes"
        )
        if lead_nats < best.acceptance:
            return not_yet(
                Outcome.UNDECIDED, f"best candidate leads another place by {lead_nats:.1f} nats: {why}"
            )
        return not_yet(Outcome.UNDECIDED, f"best candidate could be chance: {why}")
    if found.jaccard < config.min_jaccard:
        share = f"MNN-Jaccard {found.jaccard:.2f}, below {config.min_jaccard:g}"
        return not_yet(Outcome.UNDECIDED, f"best candidate has {share}")
    if len(found.pairs) < config.min_pairs:
        count = f"{len(found.pairs)} buildings, fewer than {config.min_pairs}"
        return not_yet(Outcome.UNDECIDED, f"best candidate matches {count}")
    if found.rms_m > config.max_residual_m:
        residuals = f"residuals of {found.rms_m:.1f} m, above {config.max_residual_m:g} m"
        return not_yet(Outcome.UNDECIDED, f"best candidate has {residuals}")
    return Verdict(Outcome.ACCEPTED, None, nats, chance)


def refuse_refined(refined: Refined, config: MatcherConfig) -> str | None:
    """Why the refined pose is not convincing, or None."""
    if refined.buildings < config.refine_min_buildings:
        few = f"{refined.buildings} buildings, fewer than {config.refine_min_buildings}"
        return f"refinement matched {few}"
    if refined.rms_m > config.max_residual_m:
        return f"refinement left residuals of {refined.rms_m:.1f} m, above {config.max_residual_m:g} m"
    return None
