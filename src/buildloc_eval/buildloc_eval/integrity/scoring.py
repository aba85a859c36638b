"""Figures of trials: one row each, as :mod:`buildloc_eval.integrity.trials` records them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from buildloc_matcher.calibration import protection_level_m
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray
from scipy.stats import binomtest, chi2

CORRECT_M = 100.0
CONFIDENCE = 0.95
SHARES_CHECKED = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001, 1e-4, 1e-5)
SCORE_BINS = (-math.inf, -20.0, -10.0, -5.0, -2.0, 0.0, 2.0, 5.0, 10.0, 20.0, math.inf)
Mask = NDArray[np.bool_]


def share(successes: int, trials: int) -> dict[str, Any]:
    """A share with its exact (Clopper-Pearson) 95 % interval; where nothing happened, up to 3 / trials: the
    rule of three, one-sided."""
    if trials == 0:
        return {"share": None, "of": 0, "95%": None}
    interval = binomtest(successes, trials).proportion_ci(CONFIDENCE, method="exact")
    high = min(1.0, 3.0 / trials) if successes == 0 else float(interval.high)
    return {"share": successes / trials, "of": trials, "95%": [float(interval.low), high]}


def is_false(records: pd.DataFrame) -> Mask:
    """Which trials have a fix that is more than CORRECT_M wrong; all fixes are where no place is right."""
    return np.asarray(records.fixed & ~(records.fix_error_m <= CORRECT_M))


def flights(records: pd.DataFrame) -> pd.DataFrame:
    """Without the controls."""
    return records[~records.control]


def wrong_best(records: pd.DataFrame) -> pd.DataFrame:
    """Trials whose best candidate is more than CORRECT_M wrong."""
    return records[records.best_error_m > CORRECT_M]


def consistent(records: pd.DataFrame) -> pd.DataFrame:
    """Fixes within CORRECT_M whose errors the matcher has been told the size of: no controls."""
    return records[records.fixed & ~records.control & (records.fix_error_m <= CORRECT_M)]


def curve(
    score: FloatArray, right: Mask, flight: Mask, thresholds: Sequence[float] | FloatArray
) -> list[dict[str, Any]]:
    """Availability (right answers of flights) and false fixes (wrong answers of all trials) at thresholds;
    ``score`` (T,) is -inf or NaN where there is no answer at any."""
    rows = []
    for threshold in thresholds:
        answered = score >= threshold
        rows.append(
            {
                "threshold": float(threshold),
                "availability": share(int((answered & right & flight).sum()), int(flight.sum())),
                "false fixes": int((answered & ~right).sum()),
                "false-fix rate": share(int((answered & ~right).sum()), len(score)),
            }
        )
    return rows


def our_curve(records: pd.DataFrame, enough: float) -> list[dict[str, Any]]:
    """Over the score, which stands at ``enough``. What another gate refused has no answer at any threshold;
    below ``enough`` that is not known, nor what refinement would have said: the search's place counts."""
    refused_otherwise = (records.score >= enough) & ~records.fixed
    score = np.where(refused_otherwise, -np.inf, records.score)
    error = np.where(records.fixed, records.fix_error_m, records.best_error_m)
    finite = score[np.isfinite(score)]
    thresholds = np.unique(np.append(np.quantile(finite, np.linspace(0.0, 0.995, 80)), [0.0, enough]))
    return curve(score, error <= CORRECT_M, ~records.control.to_numpy(), thresholds)


def paper_curve(records: pd.DataFrame) -> list[dict[str, Any]]:
    """Over the MNN-Jaccard of the paper's first candidate, on the trials that it was tried on; the threshold
    0 is its argmax, which always answers."""
    tried = records[records.paper_answers.notna()]
    score = tried.paper_jaccard.to_numpy()
    right = (tried.paper_error_m <= CORRECT_M).to_numpy()
    return curve(score, right, ~tried.control.to_numpy(), np.linspace(0.0, 0.9, 46))


def beside_paper(records: pd.DataFrame) -> list[dict[str, Any]]:
    """The paper's argmax and ours on the same trials, flights and controls."""
    tried = records[records.paper_answers.notna()]
    rows = []
    for title, some in (("flights", tried[~tried.control]), ("controls", tried[tried.control])):
        answered = some.paper_answers.astype(bool)
        wrong, ours_wrong = answered & ~(some.paper_error_m <= CORRECT_M), is_false(some)
        for method, answers, false in (
            ("paper's argmax", answered, wrong),
            ("ours", some.fixed, ours_wrong),
        ):
            right = share(int((answers & ~false).sum()), len(some))
            counts = {"tried": len(some), "answers": int(answers.sum()), "false": int(false.sum())}
            rows.append({"trials": title, "method": method} | counts | {"right": right})
    return rows


def availability(records: pd.DataFrame, by: Sequence[str]) -> list[dict[str, Any]]:
    """Share of flights with a right fix, for every combination of some columns, and what refused the rest."""
    rows = []
    for values, some in flights(records).groupby(list(by)):
        right = some.fixed & (some.fix_error_m <= CORRECT_M)
        reasons = some[~some.fixed].reason.map(short_reason).value_counts()
        rows.append(
            dict(zip(by, values, strict=True))
            | {"availability": share(int(right.sum()), len(some))}
            | {"found by the search": float((some.best_error_m <= CORRECT_M).mean())}
            | {"refused": {reason: int(count) for reason, count in reasons.items()}}
        )
    return rows


def short_reason(reason: str) -> str:
    """Without its figures."""
    text = reason.split(": score")[0]
    return " ".join(word for word in text.split() if not any(c.isdigit() for c in word)).rstrip(" ,:")


def error_rows(records: pd.DataFrame) -> list[dict[str, Any]]:
    """Horizontal errors of right fixes by the shift of the reference, and by level."""
    rows = []
    for by in ("shift_m", "level", "place"):
        for value, some in consistent(records).groupby(by):
            error = some.fix_error_m
            rows.append(
                {by: value, "fixes": len(some), "median_m": float(error.median()),
                 "95%_m": float(error.quantile(0.95)), "largest_m": float(error.max())}
            )  # fmt: skip
    return rows


def nees_row(some: pd.DataFrame) -> dict[str, Any]:
    """Consistency of some fixes: share of normalised errors squared within the 95 % bound of chi-square with
    two degrees of freedom, their mean (2 if consistent), and the share of errors within the protection
    level."""
    nees = some.nees.to_numpy()
    return {
        "fixes": len(some),
        "within 95 % bound": share(int((nees <= chi2.ppf(0.95, 2)).sum()), len(some)),
        "mean": float(nees.mean()) if len(some) else None,
        "within protection level": share(
            int((some.fix_error_m.to_numpy() <= told_protection_m(some)).sum()), len(some)
        ),
        "median protection level_m": float(np.median(told_protection_m(some))) if len(some) else None,
    }


def told_protection_m(some: pd.DataFrame) -> FloatArray:
    """(N,) what the matcher says that the errors of some fixes stay within."""
    cross = some.cov_east_north_m2
    rows = np.array([[some.var_east_m2, cross], [cross, some.var_north_m2]])
    return protection_level_m(rows.transpose(2, 0, 1))


def consistency(records: pd.DataFrame) -> list[dict[str, Any]]:
    """Of all right fixes of flights, and of parts of them."""
    right = consistent(records)
    rows = [{"of": "all"} | nees_row(right)]
    for by in ("shift_m", "level", "place"):
        rows += [{"of": f"{by} {value}"} | nees_row(some) for value, some in right.groupby(by)]
    return rows


def tail_reliability(records: pd.DataFrame) -> list[dict[str, Any]]:
    """Of maps whose best candidate is wrong, how many are told to be at most so likely a false fix: what is
    observed must not exceed what is claimed."""
    claimed = wrong_best(records).false_fix_probability.to_numpy()
    return [
        {"claimed": p, "observed": share(int((claimed <= p).sum()), len(claimed))} for p in SHARES_CHECKED
    ]


def odds_reliability(records: pd.DataFrame) -> list[dict[str, Any]]:
    """Of trials by their score, log-odds in nats, how many have the right best candidate."""
    scored = records[np.isfinite(records.score)]
    which = np.digitize(scored.score, SCORE_BINS[1:-1])
    rows = []
    for bin_, some in scored.groupby(which):
        # A score beyond any that a float tells from certainty counts as that.
        claimed = 1.0 / (1.0 + np.exp(-np.clip(some.score, -30.0, 30.0)))
        right = some.best_error_m <= CORRECT_M
        low, high = SCORE_BINS[int(bin_)], SCORE_BINS[int(bin_) + 1]
        rows.append(
            {"nats": f"{low:g} to {high:g}", "claimed right": float(claimed.mean()),
             "observed right": share(int(right.sum()), len(some))}
        )  # fmt: skip
    return rows


def control_rows(records: pd.DataFrame) -> list[dict[str, Any]]:
    """Every kind of control: fixes, false ones, and the highest score of a wrong best candidate."""
    rows = []
    for kind, some in records[records.control].groupby("kind"):
        wrong = wrong_best(some)
        rows.append(
            {"control": kind, "trials": len(some), "fixes": int(some.fixed.sum()),
             "false fixes": int(is_false(some).sum()),
             "false-fix rate": share(int(is_false(some).sum()), len(some)),
             "highest wrong score_nats": float(wrong.score.max()) if len(wrong) else None,
             "largest error of a fix_m": float(some.fix_error_m.max()) if some.fixed.any() else None}
        )  # fmt: skip
    return rows


def why_false(row: pd.Series) -> str:
    """The stage that is to blame for a false fix."""
    if row.absent:
        return f"the ground flown over ({row.kind}) is not in the reference, and was accepted elsewhere"
    if row.best_error_m <= CORRECT_M:
        return "the search was right, and refinement led away"
    near = [rank for rank, error in enumerate(row.candidate_error_m, start=1) if error <= CORRECT_M]
    if near:
        return f"the true place was candidate {near[0]}, and a wrong one scored higher"
    return "the true place was not among the candidates, and a wrong one was accepted"


def false_rows(records: pd.DataFrame) -> list[dict[str, Any]]:
    """Every false fix with its figures."""
    names = (
        "number", "place", "kind", "detail", "radius_km", "buildings", "level", "shift_m", "score",
        "false_fix_probability", "funnel.log_odds", "funnel.lead", "best_error_m", "fix_error_m",
    )  # fmt: skip
    return [
        {name: row[name] for name in names}
        | {"jaccard": row.candidate_jaccard[0], "pairs": row.candidate_pairs[0]}
        | {"rms_m": row.candidate_rms_m[0], "reason": why_false(row)}
        for _, row in records[is_false(records)].iterrows()
    ]


def cost_rows(records: pd.DataFrame) -> list[dict[str, Any]]:
    """Seconds of one core by kind of trial."""
    return [
        {
            "kind": kind, "trials": len(some), "mean_cpu_s": float(some.cpu_s.mean()),
            "95%_cpu_s": float(some.cpu_s.quantile(0.95)),
            "second looks": float((some["funnel.looks"] == 2).mean()),
        }
        for kind, some in records.groupby("kind")
    ]  # fmt: skip


def bars(records: pd.DataFrame, trials_asked: int) -> list[dict[str, Any]]:
    """The bars of this evaluation: what was reached, with its interval, and whether that meets them."""
    false = int(is_false(records).sum())
    met = False if false else True if len(records) >= trials_asked else None  # fewer trials prove nothing
    reached = {"count": false} | share(false, len(records))
    rows = [_bar("false fixes, controls included", f"0 in {trials_asked}", reached, met)]
    usable = flights(records)
    usable = usable[(usable.buildings >= 60) & (usable.radius_km == 12.0)]
    for level, least in ((1, 0.90), (2, None)):
        some = usable[usable.level == level]
        reached = share(int((some.fixed & (some.fix_error_m <= CORRECT_M)).sum()), len(some))
        met = None if least is None or not len(some) else reached["share"] >= least
        said = "reported" if least is None else f">= {least:.0%}"
        rows.append(_bar(f"availability, level {level}, 60 buildings or more, 12 km", said, reached, met))
    right = consistent(records)
    row = nees_row(right)
    within, protected = row["within 95 % bound"], row["within protection level"]
    enough = len(right) > 0
    rows.append(_bar(
        "normalised error squared within its 95 % bound", "93 to 97 %", within,
        0.93 <= within["share"] <= 0.97 if enough else None,
    ))  # fmt: skip
    rows.append(_bar(
        "99.9 % protection level holds", ">= 99.8 %", protected,
        protected["share"] >= 0.998 if enough else None,
    ))  # fmt: skip
    for shift, some in right.groupby("shift_m"):
        for name, quantile, most in (("median", 0.5, 2.0), ("95 %", 0.95, 6.0)):
            error = float(some.fix_error_m.quantile(quantile))
            title = f"horizontal error of fixes, {name}, reference shift {shift:g} m"
            rows.append(_bar(title, f"<= {most:g} m", {"m": error, "of": len(some)}, error <= most))
    return rows


def _bar(what: str, bar: str, reached: dict[str, Any], met: bool | None) -> dict[str, Any]:
    return {
        "what": what,
        "bar": bar,
        "reached": reached,
        "met": "-" if met is None else "met" if met else "missed",
    }
