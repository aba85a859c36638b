"""Predictions against the truth: recall, errors, convergence, and which stage lost a failure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from buildloc_msgs_py.types import FloatArray
from scipy.stats import binomtest
from scipy.stats import t as student

from buildloc_eval.paper.flown import Maps, true_place
from buildloc_eval.paper.methods import Prediction
from buildloc_eval.paper.published import CORRECT_M

RANKS = (1, 5, 10)
BIN_M = 100.0
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Score:
    """One prediction: rank of the first place within 100 m of the truth (0: none), errors in metres of the
    first place and of the refined one (infinite without one), rank of the true bin or a neighbour of it among
    all bins (bins that have no vote tie for the last rank), whether it was a fix, and what lost it."""

    rank: int
    coarse_m: float
    final_m: float
    bin_rank: int
    fix: bool
    lost_by: str


def score(found: Prediction, maps: Maps, keyframes: int, radius_km: float) -> Score:
    """Compare a prediction after so many keyframes with the truth: places of a camera with that of the last
    keyframe of the map."""
    snapshot = maps.snapshots[keyframes - 1]
    last = maps.true_m[keyframes - 1 if snapshot is None else max(snapshot.numbers)]
    truth = last
    if found.centre_m is not None and snapshot is not None:
        truth = true_place(maps, snapshot, found.centre_m)
    final = math.inf if found.final_m is None else float(np.hypot(*(found.final_m - last)))
    return replace(placed(found, truth, radius_km), final_m=final)


def placed(found: Prediction, truth_m: FloatArray, radius_km: float) -> Score:
    """Compare the places of a prediction with the true one (2,); nothing of a refined place."""
    errors = np.hypot(*(found.places_m - truth_m).T)
    right = np.flatnonzero(errors <= CORRECT_M)
    rank = int(right[0]) + 1 if len(right) else 0
    bin_rank = rank_of_bin(found, truth_m, radius_km)
    lost = "" if rank == 1 else lost_by(found, rank, bin_rank, radius_km)
    coarse = float(errors[0]) if len(errors) else math.inf
    return Score(rank, coarse, math.inf, bin_rank, found.refused is None, lost)


def bins_within(radius_km: float) -> int:
    """Number of bins of a search area."""
    return round(math.pi * (1000.0 * radius_km / BIN_M) ** 2)


def rank_of_bin(found: Prediction, truth_m: FloatArray, radius_km: float) -> int:
    """Best rank among the true bin and its eight neighbours."""
    apart = np.abs(found.bins - np.round(truth_m / BIN_M)).max(axis=1, initial=0)
    hits = np.flatnonzero(apart <= 1)
    return int(hits[0]) + 1 if len(hits) else bins_within(radius_km)


def lost_by(found: Prediction, rank: int, bin_rank: int, radius_km: float) -> str:
    """The stage that lost a prediction whose first place is wrong."""
    if not len(found.places_m):
        no_map = found.refused or "no place"
        return no_map if found.centre_m is None else "voting: no place gathers enough consistent votes"
    if rank > 1:
        return "ranking: a wrong candidate scored higher"
    if not len(found.bins):
        return "propagation: the true place does not survive"
    if bin_rank < bins_within(radius_km):
        return "selection: the true bin had votes, but was not among the first candidates"
    return "matching: the true bin had no vote worth listing"


def first_and_stable(right: Sequence[bool]) -> tuple[int | None, int | None]:
    """The first prefix (from 1) that succeeds, and the first from which all do; None where there is none."""
    first = next((n for n, ok in enumerate(right, start=1) if ok), None)
    failures = [n for n, ok in enumerate(right, start=1) if not ok]
    stable = (failures[-1] if failures else 0) + 1
    return first, stable if stable <= len(right) else None


def interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % interval of a share, Wilson's."""
    found = binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return round(float(found.low), 4), round(float(found.high), 4)


def mean_interval(values: Sequence[float]) -> list[float] | None:
    """95 % interval of a mean, Student's; None for fewer than two values."""
    if len(values) < 2:
        return None
    half = float(
        student.ppf(0.5 + 0.5 * CONFIDENCE, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values))
    )
    mean = float(np.mean(values))
    return [round(mean - half, 2), round(mean + half, 2)]


def recall_row(scores: Sequence[Score]) -> dict[str, Any]:
    """Recall at 1, 5, 10 with intervals, share with a refined place within 100 m, fixes and false ones."""
    trials = len(scores)
    row: dict[str, Any] = {"trials": trials}
    for k in RANKS:
        right = sum(0 < s.rank <= k for s in scores)
        row[f"recall@{k}"], row[f"recall@{k}_95%"] = right / trials, interval(right, trials)
    finals = [s.final_m for s in scores if s.final_m <= CORRECT_M]
    row["final within 100 m"] = len(finals) / trials
    row["fixes"] = sum(s.fix for s in scores) / trials
    row["false fixes"] = sum(s.fix and s.rank != 1 for s in scores)
    return row


def error_row(scores: Sequence[Score]) -> dict[str, float | None]:
    """Median and largest coarse and final error, m, of the predictions whose first place is right, and how
    many of them have a refined place at all."""
    right = [s for s in scores if s.rank == 1]
    finals = [s.final_m for s in right if math.isfinite(s.final_m)]
    return {
        "coarse_median_m": _median(s.coarse_m for s in right),
        "coarse_worst_m": max((s.coarse_m for s in right), default=None),
        "final_median_m": _median(finals),
        "final_worst_m": max(finals, default=None),
        "refined": len(finals),
    }


def _median(values: Iterable[float]) -> float | None:
    listed = list(values)
    return float(np.median(listed)) if listed else None
