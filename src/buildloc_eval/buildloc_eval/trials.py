"""Maps without images located and compared with the truth."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from buildloc_matcher.matcher import Matcher

from buildloc_eval.observation import ObservedMap
from buildloc_eval.paper.methods import ranking
from buildloc_eval.paper.scoring import RANKS, interval, placed


@dataclass(frozen=True)
class Trial:
    """One map located: rank of the first candidate within CORRECT_M of the truth (0: none), error of the
    best, whether it was accepted as a fix, seconds per stage, and the stage that lost it (empty: right)."""

    rank: int
    error_m: float
    accepted: bool
    seconds: dict[str, float]
    lost_by: str = ""


def run_trial(matcher: Matcher, observed: ObservedMap) -> Trial:
    """Locate a map and compare with the truth."""
    found = matcher.locate(observed.local_map)
    radius_km = math.sqrt(matcher.database.area_m2 / math.pi) / 1000.0
    one = placed(ranking(matcher, found), observed.centre_m, radius_km)
    return Trial(one.rank, one.coarse_m, one.fix, found.seconds, one.lost_by)


def summary(trials: Sequence[Trial]) -> dict[str, Any]:
    """Recall at 1, 5, 10 with 95 % intervals; errors; fixes; milliseconds per stage; what lost the others."""
    count, right = len(trials), [t for t in trials if t.rank == 1]
    stages = {
        stage: float(np.median([1e3 * t.seconds.get(stage, 0.0) for t in trials]))
        for stage in trials[0].seconds
    }
    hits = {k: sum(0 < t.rank <= k for t in trials) for k in RANKS}
    return {
        "maps": count,
        **{f"recall@{k}": hits[k] / count for k in RANKS},
        **{f"recall@{k}_95%": list(interval(hits[k], count)) for k in RANKS},
        "median_error_m": float(np.median([t.error_m for t in right])) if right else None,
        "fixes": sum(t.accepted for t in trials) / count,
        "false_fixes": sum(t.accepted and t.rank != 1 for t in trials),
        "ms": stages,
        "ms_total": float(np.median([1e3 * sum(t.seconds.values()) for t in trials])),
        "lost_by": dict(Counter(t.lost_by for t in trials if t.lost_by).most_common()),
    }
