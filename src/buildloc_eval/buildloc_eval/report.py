"""One picture and a table of a flight: map, path, buildings matched, fixes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from buildloc_matcher.reference.database import ReferenceDatabase
from buildloc_msgs_py.types import Fix, FloatArray, NoFix
from matplotlib.collections import LineCollection
from pyproj import Transformer

from buildloc_eval.truth import Truth

VIEW_MARGIN_M = 120.0
CHI2_95 = 5.991  # of two degrees of freedom: 95 % of the normalised squared errors of honest fixes are below
TOLD_NS = 1_000_000_000


@dataclass(frozen=True)
class FlightScore:
    """Fixes with their errors in metres, in order, and the number of answers without a fix. ``normalised``:
    horizontal errors squared, over the fixes' own covariances."""

    fixes: tuple[Fix, ...]
    errors_m: tuple[float, ...]
    normalised: tuple[float, ...]
    no_fix: int

    @property
    def covered(self) -> float | None:
        """Share of the fixes whose 95 % ellipse holds the truth; None when there was none."""
        return float(np.mean(np.array(self.normalised) < CHI2_95)) if self.normalised else None

    @property
    def last_error_m(self) -> float | None:
        """Error of the last fix; None when there was none."""
        return self.errors_m[-1] if self.errors_m else None


def score(results: Sequence[Fix | NoFix], truth: Truth) -> FlightScore:
    """Errors of all fixes against the truth of their own stamps."""
    fixes = tuple(r for r in results if isinstance(r, Fix))
    offsets = [truth.offset_m(f) for f in fixes]
    normalised = tuple(
        float(offset @ np.linalg.solve(f.covariance_enu_m2[:2, :2], offset))
        for f, offset in zip(fixes, offsets, strict=True)
    )
    errors = tuple(float(np.hypot(*offset)) for offset in offsets)
    return FlightScore(fixes, errors, normalised, len(results) - len(fixes))


def fix_table(scored: FlightScore, truth: Truth) -> str:
    """One line per second with a fix: time since the first image, position, sigma, error."""
    start, told = min(truth.poses), -TOLD_NS
    lines = ["  time_s    latitude    longitude  sigma_m  error_m"]
    for fix, error in zip(scored.fixes, scored.errors_m, strict=True):
        if fix.stamp_ns - told < TOLD_NS:
            continue
        told = fix.stamp_ns
        sigma = float(np.sqrt(np.trace(fix.covariance_enu_m2[:2, :2]) / 2.0))
        lines.append(
            f"{(fix.stamp_ns - start) * 1e-9:8.1f}  {fix.latitude_deg:10.6f}  {fix.longitude_deg:11.6f}  "
            f"{sigma:7.1f}  {error:7.2f}"
        )
    return "\n".join(lines)


def picture(
    path: Path,
    database: ReferenceDatabase,
    truth: Truth,
    scored: FlightScore,
    observed_m: FloatArray,
    matched_m: FloatArray,
    title: str,
) -> None:
    """Draw reference, true path, observed buildings ((N, 2) as the last fix places them), those of the
    reference that they match ((M, 2)), and fixes with their errors. UTM metres of the database's zone."""
    to_database = Transformer.from_crs(truth.epsg, database.epsg, always_xy=True)
    flown = np.array([to_database.transform(p.x_m, p.y_m) for _, p in sorted(truth.poses.items())])
    to_utm = Transformer.from_crs(4326, database.epsg, always_xy=True)
    fixes = np.array([to_utm.transform(f.longitude_deg, f.latitude_deg) for f in scored.fixes]).reshape(-1, 2)
    origin = flown.mean(axis=0)
    figure = plt.figure(figsize=(15, 7.5), layout="constrained")
    halves = figure.subfigures(1, 2, squeeze=False)[0]  # each has a shape of its own
    whole, close = (half.subplots() for half in halves)
    for axes, size in ((whole, 1.0), (close, 14.0)):
        axes.scatter(*(database.centroids_m - origin).T, s=size, c="0.72", label="reference buildings")
        axes.plot(*(flown - origin).T, c="tab:blue", lw=1.8, label="true path")
        if len(fixes):
            axes.scatter(*(fixes - origin).T, s=46, c="tab:red", marker="+", label="fixes", zorder=4)
        axes.set_aspect("equal")
        axes.set_xlabel("east, m")
    whole.set_ylabel("north, m")
    whole.set_title(f"{len(database)} reference buildings")
    if len(observed_m):
        close.scatter(*(observed_m - origin).T, s=26, fc="none", ec="tab:orange", label="observed buildings")
    if len(matched_m):
        close.scatter(*(matched_m - origin).T, s=14, c="tab:green", label="matched in the reference")
    truths = {stamp: to_database.transform(p.x_m, p.y_m) for stamp, p in truth.poses.items()}
    pairs = zip(scored.fixes, fixes, strict=True)
    lines = [(np.array(truths[f.stamp_ns]) - origin, place - origin) for f, place in pairs]
    close.add_collection(LineCollection(lines, colors="tab:red", lw=0.8))
    low, high = (flown - origin).min(axis=0) - VIEW_MARGIN_M, (flown - origin).max(axis=0) + VIEW_MARGIN_M
    close.set_xlim(low[0], high[0])
    close.set_ylim(low[1], high[1])
    last = "no fix" if scored.last_error_m is None else f"last fix {scored.last_error_m:.2f} m from the truth"
    close.set_title(f"{len(scored.fixes)} fixes, {last}")
    close.legend(loc="upper right", fontsize=8, framealpha=0.9)
    figure.suptitle(title)
    figure.savefig(path, dpi=110)
    plt.close(figure)
