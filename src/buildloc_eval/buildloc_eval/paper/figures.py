"""The figures of the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import shapely
from buildloc_matcher.geometry import rotation
from buildloc_msgs_py.types import FloatArray
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from buildloc_eval.paper.methods import Prediction
from buildloc_eval.segmentation_errors import Outlines

VIEW_M = 450.0
SHOWN = 3


@dataclass(frozen=True)
class Trace:
    """Ranks (S, N) of the true bin after 1 to N keyframes of a flight in S seeds, and the median of where it
    is stably the first; None where one of them never gets there."""

    flight: str
    ranks: NDArray[np.int64]
    stable: float | None


def _save(figure: Figure, path: Path) -> Path:
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _ground(axes: Axes, outlines: Outlines, centre_m: FloatArray, half_m: float) -> None:
    near = np.hypot(*(shapely.get_coordinates(shapely.centroid(outlines)) - centre_m).T) < 1.5 * half_m
    rings = [shapely.get_coordinates(outline.exterior) - centre_m for outline in outlines[near]]
    axes.add_collection(PolyCollection(rings, facecolors="0.8", edgecolors="0.55", linewidths=0.3))
    axes.set(xlim=(-half_m, half_m), ylim=(-half_m, half_m), aspect="equal", xticks=[], yticks=[])


def draw_trajectories(
    path: Path, reference: Mapping[str, Outlines], paths_m: Mapping[str, FloatArray]
) -> Path:
    """Every flight's true path over the reference around it."""
    figure, panels = plt.subplots(1, len(paths_m), figsize=(3.2 * len(paths_m), 3.5), squeeze=False)
    for axes, (name, flown) in zip(panels[0], paths_m.items(), strict=True):
        centre = 0.5 * (flown.min(axis=0) + flown.max(axis=0))
        _ground(axes, reference[name], centre, VIEW_M)
        axes.plot(*(flown - centre).T, "tab:blue", lw=1.5)
        axes.plot(*(flown[0] - centre), "o", color="tab:green")
        axes.set_title(name)
    return _save(figure, path)


def draw_convergence(path: Path, traces: Sequence[Trace], radius_km: int, bins: int) -> Path:
    """Rank against keyframes, median over the seeds and what lies between the quartiles; a star where it is
    stably the first."""
    figure, axes = plt.subplots(figsize=(9, 4.8))
    for trace in traces:
        keyframes = np.arange(1, trace.ranks.shape[1] + 1)
        low, median, high = np.percentile(trace.ranks, (25, 50, 75), axis=0)
        (line,) = axes.plot(keyframes, median, lw=1.2, label=trace.flight)
        axes.fill_between(keyframes, low, high, alpha=0.15, color=line.get_color(), lw=0)
        if trace.stable is not None:
            axes.plot(trace.stable, 1, "*", ms=13, color=line.get_color())
    axes.set(
        yscale="log", ylim=(bins * 1.3, 0.8), xlabel="keyframes",
        ylabel=f"rank of the true bin or a neighbour, of {bins:,}", title=f"search radius {radius_km} km",
    )  # fmt: skip
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return _save(figure, path)


def draw_radius(
    path: Path, radii_km: Sequence[int], rows: Mapping[str, Mapping[str, Sequence[float | None]]]
) -> Path:
    """Recall, coarse error and seconds per query against the radius, one line per method."""
    figure, panels = plt.subplots(1, 3, figsize=(14, 4.2))
    for axes, (value, scale) in zip(
        panels,
        (("recall@1", "linear"), ("coarse error, m", "linear"), ("seconds per query", "log")),
        strict=True,
    ):
        for name, values in rows.items():
            shown = [np.nan if v is None else v for v in values[value]]
            axes.plot(radii_km, shown, "o-", label=name)
        axes.set(xlabel="search radius, km", ylabel=value, yscale=scale)
        axes.grid(alpha=0.3)
    panels[0].set_ylim(-0.03, 1.03)
    panels[0].legend(fontsize=8)
    return _save(figure, path)


def draw_candidates(
    path: Path,
    reference: Outlines,
    found: Mapping[str, Prediction],
    map_m: FloatArray,
    truths_m: Mapping[str, FloatArray],
    correct_m: float,
) -> Path:
    """The first three places of every method: the reference there, the map's buildings (N, 2) laid on it."""
    figure, panels = plt.subplots(len(found), SHOWN, figsize=(3.6 * SHOWN, 3.7 * len(found)), squeeze=False)
    for row, (name, prediction) in zip(panels, found.items(), strict=True):
        for k, axes in enumerate(row):
            if k >= len(prediction.places_m):
                axes.set_axis_off()
                axes.set_title(f"{name}: no place {k + 1}")
                continue
            place, (yaw, scale) = prediction.places_m[k], prediction.turns[k]
            _ground(axes, reference, place, VIEW_M)
            if prediction.centre_m is not None:
                moved = scale * (map_m - prediction.centre_m) @ rotation(float(yaw)).T
                axes.plot(*moved.T, ".", color="tab:orange", ms=4)
            error = float(np.hypot(*(place - truths_m[name])))
            right = error <= correct_m
            axes.plot(0.0, 0.0, "+", color="tab:green" if right else "tab:red", ms=12, mew=2)
            axes.set_title(
                f"{name}, {k + 1}: {error:,.0f} m off", fontsize=9, color="tab:green" if right else "k"
            )
    return _save(figure, path)
