"""Acceptance is calibrated on wrong candidates: the worst kind of ground, upper bounds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from buildloc_eval.integrity.calibrate import AT_RATE, START_NATS, calibrate, fit_tail, write_calibration
from buildloc_matcher.calibration import Tail
from buildloc_msgs_py.errors import BuildlocError


def wrong(kind: str, scores: np.ndarray) -> pd.DataFrame:
    return pd.DataFrame({"kind": kind, "score": scores, "best_error_m": np.inf})


def exponential(seed: int, count: int, scale_nats: float) -> np.ndarray:
    """A tenth of the scores is above the start, exponentially."""
    rng = np.random.default_rng(seed)
    tail = START_NATS + rng.exponential(scale_nats, count // 10)
    return np.concatenate([np.full(count - len(tail), -20.0), tail])


def test_the_bounds_hold_in_nineteen_of_twenty_fits() -> None:
    fits = [fit_tail(exponential(seed, 500, 3.0)) for seed in range(200)]
    assert np.mean([fit.scale_nats > 3.0 for fit in fits]) > 0.90
    assert all(0.1 < fit.share < 0.14 for fit in fits)
    assert np.median([fit.scale_nats for fit in fits]) < 4.0  # and are not wide


def test_the_worst_kind_counts_and_right_candidates_do_not() -> None:
    right = pd.DataFrame({"kind": "missing", "score": np.full(100, 90.0), "best_error_m": 3.0})
    records = pd.concat(
        [wrong("outside", exponential(1, 500, 2.0)), wrong("grid", exponential(2, 500, 4.0)), right]
    )
    found = calibrate(records)
    assert found["worst"] == "grid" and found["kinds"].keys() == {"outside", "grid"}
    assert found["kinds"]["grid"]["wrong"] == 500
    assert Tail(**found["tail"]).quantile(AT_RATE) > 30.0


def test_a_kind_that_seldom_scores_has_the_largest_scale() -> None:
    records = pd.concat([wrong("outside", exponential(1, 500, 2.0)), wrong("mirrored", np.full(50, -np.inf))])
    assert calibrate(records)["kinds"]["mirrored"]["wrong"] == 50
    assert fit_tail(np.full(50, -np.inf), 3.0) == Tail(START_NATS, pytest.approx(0.058, abs=1e-3), 3.0)


def test_too_few_and_the_wrong_plan_are_said(tmp_path: Path) -> None:
    file = tmp_path / "calibration.json"
    with pytest.raises(BuildlocError, match="too few wrong candidates"):
        calibrate(wrong("outside", np.full(20, -5.0)))
    some = wrong("outside", exponential(1, 500, 2.0))
    with pytest.raises(BuildlocError, match="use --plan calibration"):
        write_calibration(file, some, "test", 1)
    assert not file.exists()
    line = write_calibration(file, some, "calibration", 1)
    assert "nats for a rate of 0.0001 (outside)" in line
    assert Tail(**json.loads(file.read_text())["tail"]).share > 0.1
