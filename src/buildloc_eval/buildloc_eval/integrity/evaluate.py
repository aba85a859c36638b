"""`buildloc eval integrity`: the trials of a plan, then the report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from buildloc_eval.integrity.calibrate import write_calibration
from buildloc_eval.integrity.grounds import Say
from buildloc_eval.integrity.plan import PLANS, Plan
from buildloc_eval.integrity.report import report_of, write
from buildloc_eval.integrity.run import run_all

TRIALS, QUICK_TRIALS = 30_000, 400


def plan_of(name: str, quick: bool) -> Plan:
    """A plan by name; if quick, two of its places, one of each city."""
    plan = PLANS[name]
    return replace(plan, name=f"{name} quick", places=(plan.places[0], plan.places[-1])) if quick else plan


def evaluate(
    out: Path, plan_name: str, trials: int | None, seed: int, quick: bool, say: Say, calibration: Path | None
) -> str:
    """Run what is not there yet, write report.json and report.html; the summary. ``trials``: how many,
    instead of the plan's. ``calibration``: the file to write what the matcher is calibrated by.

    Raises StaleError when the folder holds results of another configuration or code.
    """
    plan = plan_of(plan_name, quick)
    asked = QUICK_TRIALS if quick else TRIALS
    records = run_all(out, plan, trials or asked, seed, say)
    say("scoring")
    summary = write(out, report_of(records, plan, asked, seed), records)
    if calibration is not None:
        summary += "\n" + write_calibration(calibration, records, plan.name, seed)
    return summary
