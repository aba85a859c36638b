"""Acceptance is calibrated on wrong candidates: the worst kind of ground, upper bounds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from buildloc_eval.integrity.calibrate import (
    AT_RATE,
    START_NATS,
    errors,
    fit_errors,
    fit_tail,
    tails,
    write_calibration,
)
from buildloc_matcher.calibration import PROTECTED, Errors, Tail
from buildloc_msgs_py.errors import BuildlocError

STUDENT = Errors(0.8, 8.0)


def controls(kind: str, scores: np.ndarray, best_error_m: float) -> pd.DataFrame:
    told = {"score": scores, "best_error_m": best_error_m, "fix_error_m": np.nan, "nees": np.nan}
    return pd.DataFrame({"kind": kind, "control": True, "fixed": False, **told})


def wrong(kind: str, scores: np.ndarray) -> pd.DataFrame:
    return controls(kind, scores, np.inf)


def flights(count: int, place: str = "town", student: Errors = STUDENT) -> pd.DataFrame:
    """Right fixes whose errors follow a Student t, of flights whose best candidates all end far off."""
    rng = np.random.default_rng(3)
    chi2 = rng.chisquare(student.dof, count) / student.dof
    nees = student.scale**2 * np.sum(rng.normal(0.0, 1.0, (2, count)) ** 2, axis=0) / chi2
    told = {"score": 90.0, "best_error_m": 500.0, "fix_error_m": 1.0, "nees": nees, "place": place}
    return pd.DataFrame({"kind": "flight", "control": False, "fixed": True, **told})


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
    right = controls("missing", np.full(100, 90.0), 3.0)
    some = [wrong("outside", exponential(1, 500, 2.0)), wrong("grid", exponential(2, 500, 4.0))]
    records = pd.concat([*some, right, flights(300)])
    found = tails(records)
    assert found["worst"] == "grid" and found["kinds"].keys() == {"outside", "grid"}
    assert found["kinds"]["grid"]["wrong"] == 500
    assert Tail(**found["tail"]).quantile(AT_RATE) > 30.0


def test_a_kind_that_seldom_scores_has_the_largest_scale() -> None:
    some = [wrong("outside", exponential(1, 500, 2.0)), wrong("mirrored", np.full(50, -np.inf))]
    assert tails(pd.concat([*some, flights(300)]))["kinds"]["mirrored"]["wrong"] == 50
    assert fit_tail(np.full(50, -np.inf), 3.0) == Tail(START_NATS, pytest.approx(0.058, abs=1e-3), 3.0)


def test_the_tail_of_errors_is_found_again() -> None:
    many = flights(20_000)
    found = fit_errors(many.nees.to_numpy())
    assert found.scale == pytest.approx(STUDENT.scale, rel=0.03)
    assert found.dof == pytest.approx(STUDENT.dof, rel=0.15)
    assert found.radius(PROTECTED) == pytest.approx(STUDENT.radius(PROTECTED), rel=0.05)
    beyond = np.mean(many.nees > found.radius(PROTECTED) ** 2)
    assert beyond == pytest.approx(1.0 - PROTECTED, rel=0.5)


def test_errors_without_a_heavy_tail_are_normal() -> None:
    rng = np.random.default_rng(1)
    normal = fit_errors(np.sum(rng.normal(0.0, 1.0, (2, 5000)) ** 2, axis=0))
    assert normal.radius(PROTECTED) == pytest.approx(3.717, rel=0.05)
    light = fit_errors(rng.uniform(0.0, 4.0, 5000))
    assert light.scale == pytest.approx(1.0, rel=0.02) and light.radius(PROTECTED) < 3.8


def test_the_place_whose_errors_reach_furthest_counts() -> None:
    heavy = Errors(0.8, 4.0)
    found = errors(pd.concat([flights(2000), flights(2000, "streets", heavy)]))
    assert found["widest"] == "streets" and found["places"]["town"]["fixes"] == 2000
    assert Errors(**found["errors"]).radius(PROTECTED) > STUDENT.radius(PROTECTED) * 1.3
    assert found["places"]["streets"]["within it"] > 0.997


def test_too_few_and_the_wrong_plan_are_said(tmp_path: Path) -> None:
    file = tmp_path / "calibration.json"
    with pytest.raises(BuildlocError, match="too few wrong candidates"):
        tails(wrong("outside", np.full(20, -5.0)))
    controls_only = wrong("outside", exponential(1, 500, 2.0))
    with pytest.raises(BuildlocError, match="no fixes"):
        errors(controls_only)
    with pytest.raises(BuildlocError, match="too few fixes"):
        errors(flights(20))
    some = pd.concat([controls_only, flights(4000)])
    with pytest.raises(BuildlocError, match="use --plan calibration"):
        write_calibration(file, some, "test", 1)
    assert not file.exists()
    line = write_calibration(file, some, "calibration", 1)
    assert "nats for a rate of 0.0001 (outside)" in line and "(99.9%), town" in line
    assert Tail(**json.loads(file.read_text())["tail"]).share > 0.1
    kept = Errors(**json.loads(file.read_text())["errors"])
    assert kept.radius(PROTECTED) == pytest.approx(STUDENT.radius(PROTECTED), rel=0.15)
