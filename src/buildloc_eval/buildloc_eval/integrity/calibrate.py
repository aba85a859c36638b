"""What is calibrated: how high wrong candidates of the controls score, bounded, of the worst kind of ground;
and how far errors of the flights' fixes go beyond their covariance."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

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
FEWEST_FIXES = 200  # for a tail of their errors


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
    half_dof, _, spread = lomax.fit(nees, floc=0.0)
    return Errors(math.sqrt(spread / (2.0 * half_dof)), 2.0 * half_dof)


def calibrate(records: pd.DataFrame) -> dict[str, Any]:
    """The tails of all kinds of controls and the one to be used: where the score for AT_RATE is highest. And
    the distribution of the errors of the flights' fixes.

    Raises BuildlocError with too few wrong candidates or fixes.
    """
    wrong = wrong_best(records[records.control])
    pooled = fit_tail(wrong.score.to_numpy())
    if math.isnan(pooled.scale_nats):
        raise BuildlocError("too few wrong candidates to calibrate acceptance on; ask for more --trials")
    tails = {
        str(kind): fit_tail(some.score.to_numpy(), pooled.scale_nats) for kind, some in wrong.groupby("kind")
    }
    worst = max(tails, key=lambda kind: tails[kind].quantile(AT_RATE))
    kinds = {
        kind: {
            "wrong": int((wrong.kind == kind).sum()),
            "highest_nats": round(float(wrong.score[wrong.kind == kind].max()), 2),
            f"score for {AT_RATE:g}": round(tail.quantile(AT_RATE), 2),
        }
        for kind, tail in tails.items()
    }
    right = consistent(records)
    return {
        "trials": len(records), "kinds": kinds, "worst": worst, "tail": asdict(tails[worst]),
        "fixes": len(right), "errors": asdict(fit_errors(right.nees.to_numpy())),
    }  # fmt: skip


def write_calibration(path: Path, records: pd.DataFrame, plan: str, seed: int) -> str:
    """Write what the matcher reads; one line about it. Raises BuildlocError for trials of another plan."""
    if plan != CALIBRATION.name:
        raise BuildlocError(
            "acceptance is not calibrated on the ground that tests it; use --plan calibration"
        )
    found = calibrate(records)
    command = f"buildloc eval integrity --plan {plan} --trials {len(records)} --seed {seed}"
    kept = {"made by": f"{command} --write-calibration FILE", **found}
    path.write_text(json.dumps(kept, indent=2) + "\n")
    tail, errors = Tail(**found["tail"]), Errors(**found["errors"])
    score = f"score {tail.quantile(AT_RATE):.1f} nats for a rate of {AT_RATE:g} ({found['worst']})"
    within = f"{errors.radius(PROTECTED):.2f} standard deviations ({PROTECTED:.1%})"
    return f"{path}: {score}; errors of {found['fixes']} fixes stay within {within}"
