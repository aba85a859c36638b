"""Pictures of the report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import chi2

from buildloc_eval.integrity.scoring import consistent, flights, is_false, share, told_protection_m

Picture = tuple[str, Path]
Rows = Sequence[dict[str, Any]]


def _save(figure: Figure, path: Path, caption: str) -> Picture:
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return caption, path


def _with_bounds(axes: Axes, x: Sequence[float], shares: Rows, label: str) -> None:
    """Points with their intervals; rows without trials are left out."""
    some = [(at, row) for at, row in zip(x, shares, strict=True) if row["share"] is not None]
    value = np.array([row["share"] for _, row in some])
    bounds = np.array([row["95%"] for _, row in some]).reshape(-1, 2).T
    error = np.abs(bounds - value)
    axes.errorbar([at for at, _ in some], value, yerr=error, fmt="o-", capsize=3, markersize=4, label=label)


def draw_curves(out: Path, curves: dict[str, Rows]) -> Picture:
    """Availability against the false-fix rate and its upper bound (dotted): a point for every threshold."""
    figure, axes = plt.subplots(figsize=(8, 5))
    for label, rows in curves.items():
        rate = np.array([row["false-fix rate"]["share"] for row in rows])
        high = np.array([row["false-fix rate"]["95%"][1] for row in rows])
        available = np.array([row["availability"]["share"] for row in rows])
        (line,) = axes.plot(np.maximum(rate, 1e-6), available, "o-", markersize=3, label=label)
        axes.plot(high, available, ":", color=line.get_color())
    axes.set(
        xscale="log", xlabel="false fixes per trial; dotted: upper 95 % bound; at the left edge: none",
        ylabel="availability: flights with a right fix", ylim=(0, 1),
    )  # fmt: skip
    axes.grid(alpha=0.3)
    axes.legend()
    return _save(figure, out / "curves.png", "Availability against false fixes, over the threshold")


def draw_availability(out: Path, records: pd.DataFrame) -> Picture:
    """By buildings of the map, a panel for every radius."""
    some = flights(records)
    radii = sorted(some.radius_km.unique())
    figure, panels = plt.subplots(1, len(radii), figsize=(4 * len(radii), 4), sharey=True, squeeze=False)
    for axes, radius in zip(panels[0], radii, strict=True):
        for level, at_level in some[some.radius_km == radius].groupby("level"):
            counts = sorted(at_level.buildings.unique())
            right = at_level.fixed & ~is_false(at_level)
            rows = [
                share(int((right & (at_level.buildings == n)).sum()), int((at_level.buildings == n).sum()))
                for n in counts
            ]
            _with_bounds(axes, counts, rows, f"level {level}")
        axes.set(title=f"{radius:g} km", xlabel="buildings of the map", ylim=(0, 1))
        axes.grid(alpha=0.3)
    panels[0][0].set_ylabel("availability")
    panels[0][0].legend()
    return _save(figure, out / "availability.png", "Availability by number of buildings and search radius")


def draw_reliability(out: Path, tail: Rows, odds: Rows) -> Picture:
    """The calibrated probability of a false fix, and the score as log-odds, against what is observed."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.5))
    claimed = [row["claimed"] for row in tail]
    _with_bounds(left, claimed, [row["observed"] for row in tail], "observed")
    left.plot(claimed, claimed, "k--", label="as claimed")
    left.set(
        xscale="log", yscale="log", xlabel="claimed: a wrong best candidate scores as high, at most",
        ylabel="share of the wrong best candidates", title="probability of a false fix",
    )  # fmt: skip
    _with_bounds(
        right, [row["claimed right"] for row in odds], [row["observed right"] for row in odds], "observed"
    )
    right.plot([0, 1], [0, 1], "k--", label="as claimed")
    right.set(
        xlabel="claimed by the score as log-odds", ylabel="share of right best candidates", title="score"
    )
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend()
    return _save(figure, out / "reliability.png", "Reliability of the score: below the line left is safe")


def draw_consistency(out: Path, records: pd.DataFrame) -> Picture:
    """Normalised errors squared of right fixes against chi-square with two degrees of freedom."""
    nees = np.sort(consistent(records).nees.to_numpy())
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.5))
    bins = np.linspace(0.0, 15.0, 46)
    left.hist(np.minimum(nees, bins[-1]), bins=bins, density=True, alpha=0.6, label="fixes")
    left.plot(bins, chi2.pdf(bins, 2), "k--", label="chi-square, 2 dof")
    left.axvline(chi2.ppf(0.95, 2), color="r", label="95 % bound")
    left.set(xlabel="normalised error squared (the last bar: all above)", ylabel="density")
    expected = chi2.ppf((np.arange(len(nees)) + 0.5) / max(len(nees), 1), 2)
    right.plot(expected, nees, ".", markersize=3)
    right.plot([0, 20], [0, 20], "k--")
    right.set(xlabel="quantiles of chi-square", ylabel="quantiles of the fixes", xlim=(0, 20), ylim=(0, 30))
    left.legend()
    return _save(figure, out / "consistency.png", "Normalised error squared against chi-square")


def draw_protection(out: Path, records: pd.DataFrame) -> Picture:
    """Stanford plot: errors above the diagonal are misleading."""
    some = consistent(records)
    level, error = told_protection_m(some), some.fix_error_m.to_numpy()
    most = max(30.0, float(np.quantile(level, 0.999)) if len(level) else 0.0)
    figure, axes = plt.subplots(figsize=(6, 5.5))
    axes.plot(np.minimum(error, most), np.minimum(level, most), ".", markersize=3)
    axes.fill_between([0, most], [0, most], color="r", alpha=0.12, label="error beyond the level")
    axes.set(xlabel="error, m", ylabel="99.9 % protection level, m", xlim=(0, most), ylim=(0, most))
    axes.legend()
    return _save(
        figure, out / "protection.png", "Protection level against true error (beyond the edge: there)"
    )
