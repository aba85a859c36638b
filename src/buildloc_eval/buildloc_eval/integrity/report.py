"""report.json and report.html of a run."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
from buildloc_matcher.calibration import threshold
from buildloc_matcher.config import matcher_config

from buildloc_eval.html import write_report
from buildloc_eval.integrity import figures, scoring
from buildloc_eval.integrity.plan import Plan
from buildloc_eval.machine import machine
from buildloc_eval.observation import Digitiser, sensing
from buildloc_eval.observed_flight import measured_frame_errors

REAL = (
    "real: footprints of Boston (OpenStreetMap) and Tokyo (PLATEAU and OpenStreetMap, each flown over with "
    "the other as reference). Simulated: flights, what is seen of the buildings, drift, and over Boston how "
    "the ground differs from the reference. Grid suburbs are invented. There are no images. Search, "
    "acceptance, refinement and covariance are the system's own code"
)


def report_of(records: pd.DataFrame, plan: Plan, trials: int, seed: int, real: str = REAL) -> dict[str, Any]:
    """Everything that is told of some trials."""
    config = matcher_config()
    enough = threshold(config.target_false_fix_rate)
    return {
        "evaluation": "integrity",
        "what is real": real,
        "bars": scoring.bars(records, trials),
        "command": " ".join(["buildloc", *sys.argv[1:]]),
        "plan": plan.name,
        "seed": seed,
        "trials": len(records),
        **machine(),
        "threshold": {"target false-fix rate": config.target_false_fix_rate, "score_nats": enough},
        "false fixes": scoring.false_rows(records),
        "controls": scoring.control_rows(records),
        "the paper's argmax on the same trials": scoring.beside_paper(records),
        "availability by level and buildings": scoring.availability(records, ("level", "buildings")),
        "availability by place and level": scoring.availability(records, ("place", "level")),
        "availability by radius and level": scoring.availability(records, ("radius_km", "level")),
        "errors": scoring.error_rows(records),
        "consistency": scoring.consistency(records),
        "probability of a false fix, claimed and observed": scoring.tail_reliability(records),
        "score as log-odds, claimed and observed": scoring.odds_reliability(records),
        "cost of a trial": scoring.cost_rows(records),
        "curve": scoring.our_curve(records, enough),
        "curve on the paper's trials": scoring.our_curve(records[records.paper_answers.notna()], enough),
        "curve of the paper's argmax, over MNN-Jaccard": scoring.paper_curve(records),
        "error model": {
            "digitiser over Boston": asdict(Digitiser()),
            "frames": asdict(measured_frame_errors()),
        }
        | {f"level {level}": asdict(sensing(level)) for level in sorted(set(records.level.tolist()))},
        "matcher": asdict(config),
    }


def write(out: Path, report: dict[str, Any], records: pd.DataFrame) -> str:
    """Write both files; the summary."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "report.json").write_text(json.dumps(_plain(report), indent=1, allow_nan=False) + "\n")
    curves = {
        "ours, all trials": report["curve"],
        "ours, trials of the paper's": report["curve on the paper's trials"],
        "paper's argmax, over MNN-Jaccard": report["curve of the paper's argmax, over MNN-Jaccard"],
    }
    pictures = [
        figures.draw_curves(out, curves),
        figures.draw_availability(out, records),
        figures.draw_reliability(
            out, report["probability of a false fix, claimed and observed"],
            report["score as log-odds, claimed and observed"],
        ),
        figures.draw_consistency(out, records),
        figures.draw_protection(out, records),
    ]  # fmt: skip
    shown = {name: value for name, value in report.items() if "curve" not in name}
    write_report(out / "report.html", "Integrity: fixes that can be trusted", shown, pictures)
    return summary(report)


def _plain(value: Any) -> Any:
    """As JSON can tell it: text for what is infinite, null for what is no number."""
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value


def summary(report: dict[str, Any]) -> str:
    """For people: what is real, the bars, the controls, the paper's argmax, every false fix."""
    lines = [report["what is real"], "", f"{report['trials']} trials, plan {report['plan']}"]
    lines += [
        f"{row['met']:<7} {row['what']}: {_told(row['reached'])} (bar: {row['bar']})"
        for row in report["bars"]
    ]
    lines += ["", "control            trials  fixes  false  highest wrong score"]
    for row in report["controls"]:
        highest = row["highest wrong score_nats"]
        told = "-" if highest is None else f"{highest:.1f}"
        lines.append(
            f"{row['control']:<18} {row['trials']:6d} {row['fixes']:6d} {row['false fixes']:6d}  {told}"
        )
    lines += ["", "beside the paper's argmax, on the same trials"]
    lines += [
        f"{row['trials']:<9} {row['method']:<15} {row['tried']:6d} tried, right {_told(row['right'])}, "
        f"false {row['false']}"
        for row in report["the paper's argmax on the same trials"]
    ]
    lines += [
        f"false fix: trial {row['number']}, {row['place']}, {row['kind']} {row['detail']}: {row['reason']} "
        f"(score {row['score']:.1f}, error {row['fix_error_m']:.0f} m)"
        for row in report["false fixes"]
    ]
    return "\n".join(lines)


def _told(reached: dict[str, Any]) -> str:
    if "m" in reached:
        return f"{reached['m']:.2f} m of {reached['of']}"
    if reached["share"] is None:
        return "no trials"
    low, high = reached["95%"]
    counted = f"{reached['count']}, " if "count" in reached else ""
    return (
        f"{counted}{100 * reached['share']:.3g} % ({100 * low:.3g} to {100 * high:.3g} %) of {reached['of']}"
    )
