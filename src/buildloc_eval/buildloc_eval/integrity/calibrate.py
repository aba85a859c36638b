"""What is calibrated: how high wrong candidates of the controls score, bounded, of the worst kind of ground;
and how far errors of the flights' fixes go beyond their covariance."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from buildloc_matcher.calibration import PROTECTED, Errors, Tail
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import FloatArray
from scipy.stats import beta, chi2, lomax

from buildloc_eval.integrity.plan import CALIBRATION
from buildloc_eval.integrity.scoring import consistent, wrong_best

START_NATS = 5.0  # the tail begins here: most wrong candidates score less, and say nothing of the highest
BOUND = 0.95
FEWEST_ABOVE = 20  # scores of a kind above the start for a scale of its own
AT_RATE = 1e-4  # where the kinds are compared
FEWEST_FIXES = 300  # of a place for a tail of their errors
NORMAL_DOF = 1e4  # hardly told from a normal distribution


def fit_tail(scores: FloatArray, other_scale_nats: float = math.nan) -> Tail:
    """The exponential tail of wrong candidates' scores (N,) above START_NATS: upper bounds of share and
    scale; with few scores there, the other scale: that of all kinds together."""
    excess = scores[scores > START_NATS] - START_NATS
    above = len(excess)
    share = float(beta.ppf(BOUND, above + 1, len(scores) - above)) if above < len(scores) else 1.0
    scale = other_scale_nats
    if above >= FEWEST_ABOVE:
        scale = 2.0 * float(excess.sum()) / float(chi2.ppf(1.0 - BOUND, 2 * above))
    return Tail(START_NATS, share, scale)


def fit_errors(nees: FloatArray) -> Errors:
    """Student's t in the plane that is likeliest for normalised errors squared (N,) of fixes, which follow
    Lomax's distribution then. Raises BuildlocError for fewer than FEWEST_FIXES."""
    if len(nees) < FEWEST_FIXES:
        count = f"{len(nees)} of {FEWEST_FIXES}"
        raise BuildlocError(f"too few fixes ({count}) to calibrate their errors on; ask for more --trials")
    if np.std(nees) <= np.mean(nees):  # no heavier a tail than a normal distribution has
        return Errors(math.sqrt(0.5 * float(np.mean(nees))), NORMAL_DOF)
    half_dof, _, spread = lomax.fit(nees, floc=0.0)
    return Errors(math.sqrt(spread / (2.0 * half_dof)), min(2.0 * half_dof, NORMAL_DOF))


def tails(records: pd.DataFrame) -> dict[str, Any]:
    """The tails of all kinds of controls and the one to be used: where the score for AT_RATE is highest.

    Raises BuildlocError with too few wrong candidates.
    """
    wrong = wrong_best(records[records.control])
    pooled = fit_tail(wrong.score.to_numpy())
    if math.isnan(pooled.scale_nats):
        raise BuildlocError("too few wrong candidates to calibrate acceptance on; ask for more --trials")
    fits = {
        str(kind): fit_tail(some.score.to_numpy(), pooled.scale_nats) for kind, some in wrong.groupby("kind")
    }
    worst = max(fits, key=lambda kind: fits[kind].quantile(AT_RATE))
    kinds = {
        kind: {
            "wrong": int((wrong.kind == kind).sum()),
            "highest_nats": round(float(wrong.score[wrong.kind == kind].max()), 2),
            f"score for {AT_RATE:g}": round(tail.quantile(AT_RATE), 2),
        }
        for kind, tail in fits.items()
    }
    return {"kinds": kinds, "worst": worst, "tail": asdict(fits[worst])}


def errors(records: pd.DataFrame) -> dict[str, Any]:
    """How errors of the flights' fixes are distributed over each place, and the distribution to be used: that
    which reaches furthest.

    Raises BuildlocError with too few fixes.
    """
    right = consistent(records)
    if not len(right):
        raise BuildlocError("no fixes to calibrate their errors on; ask for more --trials")
    fits = {str(place): fit_errors(some.nees.to_numpy()) for place, some in right.groupby("place")}
    widest = max(fits, key=lambda place: fits[place].radius(PROTECTED))
    places = {}
    for place, fit in fits.items():
        nees, radius = right.nees[right.place == place], fit.radius(PROTECTED)
        told = {"fixes": len(nees), f"radius for {PROTECTED:g}": round(radius, 2)}
        places[place] = told | {"within it": float((nees <= radius**2).mean())}
    return {"places": places, "widest": widest, "errors": asdict(fits[widest])}


def write_calibration(path: Path, records: pd.DataFrame, plan: str, seed: int) -> str:
    """Write what the matcher reads; one line about it. Raises BuildlocError for trials of another plan."""
    if plan != CALIBRATION.name:
        raise BuildlocError("nothing is calibrated on the ground that tests it; use --plan calibration")
    found = {"trials": len(records)} | tails(records) | errors(records)
    command = f"buildloc eval integrity --plan {plan} --trials {len(records)} --seed {seed}"
    kept = {"made by": f"{command} --write-calibration FILE", **found}
    path.write_text(json.dumps(kept, indent=2) + "\n")
    tail, widest = Tail(**found["tail"]), Errors(**found["errors"])
    score = f"score {tail.quantile(AT_RATE):.1f} nats for a rate of {AT_RATE:g} ({found['worst']})"
    within = f"{widest.radius(PROTECTED):.2f} standard deviations ({PROTECTED:.1%})"
    return f"{path}: {score}; protection level {within}, {found['widest']}"
