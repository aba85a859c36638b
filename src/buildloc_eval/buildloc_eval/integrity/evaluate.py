"""`buildloc eval integrity`: the trials of a plan, then the report."""

from __future__ import annotations

from pathlib import Path

from buildloc_eval.integrity.grounds import Say
from buildloc_eval.integrity.plan import PLANS
from buildloc_eval.integrity.run import run_all

TRIALS, QUICK_TRIALS = 30_000, 400


def evaluate(out: Path, plan: str, trials: int, seed: int, say: Say) -> str:
    """Run what is not there yet; the summary.

    Raises StaleError when the folder holds results of another configuration or code.
    """
    records = run_all(out, PLANS[plan], trials, seed, say)
    false = records.fixed & ~(records.fix_error_m <= 100.0)
    return f"{len(records)} trials, {records.fixed.sum()} fixes, {false.sum()} false"
