"""The report: a table and a figure for everything that was varied, and what lost the maps that were lost."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from buildloc_eval.beyond.cases import ABLATIONS, EVERYWHERE, PRESETS, Case, Factor
from buildloc_eval.html import write_report
from buildloc_eval.machine import machine
from buildloc_eval.observation import Digitiser, Level, sensing
from buildloc_eval.paper.scoring import RANKS
from buildloc_eval.trials import Trial, summary

Values = Sequence[tuple[Any, Case]]
Curves = Sequence[tuple[Factor, Mapping[str, Values]]]
Ablations = Mapping[tuple[str, Level], Values]
Located = Mapping[Case, tuple[Trial, ...]]

REAL = [
    "real: the footprints (greater Boston, OpenStreetMap 2021), of the reference and of what is flown over",
    "simulated: the maps, drawn from the footprints with the errors listed below (level 1: 12 % missed, 8 % "
    "invented, 1.2 m, heading walk of 0.15 deg per 10 m, 1 % scale; level n: n times that; measured: what a "
    "single view of the segmenter was measured to do); the errors of a digitiser, 21 % of the world that the "
    "reference lacks among them, are in every map; there are no images",
    "times are wall-clock, with as many maps located at once as there are cores",
]
BAR = 0.9  # of recall at 1 in all of greater Boston, default preset, level 1


def row(located: Sequence[Trial]) -> dict[str, Any]:
    """What a table tells of a case."""
    found = summary(located)
    kept = [key for k in RANKS for key in (f"recall@{k}", f"recall@{k}_95%")]
    told = {key: found[key] for key in ("maps", *kept, "median_error_m", "fixes", "false_fixes", "ms_total")}
    lost = Counter(t.lost_by.split(":")[0] for t in located if t.lost_by)
    return told | {"lost by": [f"{stage}: {count}" for stage, count in lost.most_common()]}


def factor_table(by_preset: Mapping[str, Values], located: Located) -> list[dict[str, Any]]:
    """The presets beside each other for every value."""
    return [
        {"value": value, "preset": preset, **row(located[case])}
        for pairs in zip(*by_preset.values(), strict=True)
        for preset, (value, case) in zip(by_preset, pairs, strict=True)
    ]


def ablation_table(ablations: Ablations, located: Located) -> list[dict[str, Any]]:
    """Every preset and level, whole and without each part."""
    return [
        {
            "preset": preset, "level": level, "part": part,
            "parameters": json.dumps(ABLATIONS[preset].get(part, {})), **row(located[case]),
        }
        for (preset, level), values in ablations.items()
        for part, case in values
    ]  # fmt: skip


def failure_table(curves: Curves, located: Located) -> list[dict[str, Any]]:
    """Of every factor and preset, the stages that lost maps: how many, at which values."""
    rows = []
    for factor, by_preset in curves:
        for preset, values in by_preset.items():
            lost = [(t.lost_by, value) for value, case in values for t in located[case] if t.lost_by]
            for reason, count in Counter(reason for reason, _ in lost).most_common():
                at = Counter(str(value) for why, value in lost if why == reason)
                where = ", ".join(f"{value}: {n}" for value, n in at.items())
                rows.append(
                    {"varied": factor.title, "preset": preset, "lost by": reason, "maps": count, "at": where}
                )
    return rows


def draw_factor(path: Path, factor: Factor, by_preset: Mapping[str, Values], located: Located) -> Path:
    """Recall with its 95 % interval, error and time against the values."""
    figure, panels = plt.subplots(1, 3, figsize=(14, 4))
    for preset, values in by_preset.items():
        names = [str(value) for value, _ in values]
        found = [summary(located[case]) for _, case in values]
        recall, tenth = ([f[f"recall@{k}"] for f in found] for k in (1, 10))
        (line,) = panels[0].plot(names, recall, "o-", label=f"{preset}, recall@1 with 95 % interval")
        colour = line.get_color()
        low, high = np.array([f["recall@1_95%"] for f in found]).T
        panels[0].fill_between(names, low, high, alpha=0.2, color=colour)
        panels[0].plot(names, tenth, ":", color=colour, label=f"{preset}, recall@10")
        errors = [math.nan if f["median_error_m"] is None else f["median_error_m"] for f in found]
        panels[1].plot(names, errors, "o-", label=preset)
        panels[2].plot(names, [f["ms_total"] for f in found], "o-", label=preset)
    panels[0].set(ylim=(-0.03, 1.03), ylabel="recall")
    panels[1].set(ylim=(0.0, None), ylabel="median error of the right ones, m")
    panels[2].set(yscale="log", ylabel="median time of a map, ms")
    for axes in panels:
        axes.set_xlabel(factor.axis)
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=8)
    return _save(figure, path)


def draw_ablations(path: Path, preset: str, ablations: Ablations, located: Located) -> Path:
    """Recall at 1 with its 95 % interval of the whole preset and without each part, a panel per level."""
    mine = {level: values for (name, level), values in ablations.items() if name == preset}
    rows = max(len(values) for values in mine.values())
    figure, panels = plt.subplots(1, len(mine), figsize=(14, 1.2 + 0.3 * rows), sharey=True)
    for axes, (level, values) in zip(panels, mine.items(), strict=True):
        found = [summary(located[case]) for _, case in values]
        share, ends = np.array([f["recall@1"] for f in found]), np.array([f["recall@1_95%"] for f in found])
        away = np.clip(np.abs(ends - share[:, None]).T, 0.0, None)
        axes.errorbar(share, [name for name, _ in values], xerr=away, fmt="o", capsize=3)
        axes.axvline(share[0], color="0.6", lw=1.0)
        axes.set(xlim=(-0.03, 1.03), xlabel="recall@1 with 95 % interval", title=f"{preset}, level {level}")
        axes.grid(alpha=0.3)
    panels[0].invert_yaxis()
    return _save(figure, path)


def _save(figure: Figure, path: Path) -> Path:
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    plt.close(figure)
    return path


def write(
    out: Path, curves: Curves, ablations: Ablations, located: Located, sizes: Mapping[float | None, int],
    seed: int, quick: bool, seconds: float,
) -> str:  # fmt: skip
    """Write report.json and report.html; the summary."""
    levels = dict.fromkeys(case.level for case in located)
    report = {
        "evaluation": "beyond",
        "what is real": REAL,
        "command": " ".join(["buildloc", *sys.argv[1:]]),
        "seed": seed,
        "quick": quick,
        "minutes of this run, of what was not there yet": seconds / 60.0,
        **machine(),
        "bars": bars(located),
        "buildings of the references (no footprint missing)": {
            "greater Boston" if radius is None else f"{radius:g} km": count
            for radius, count in sorted(sizes.items(), key=lambda item: item[1])
        },
        **{factor.title: factor_table(by_preset, located) for factor, by_preset in curves},
        "Without one part": ablation_table(ablations, located),
        "What lost the others": failure_table(curves, located),
        "error models": {"digitiser": asdict(Digitiser())}
        | {f"level {level}": asdict(sensing(level)) for level in levels},
    }
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    pictures = [
        (factor.title, draw_factor(out / f"factor_{number}.png", factor, by_preset, located))
        for number, (factor, by_preset) in enumerate(curves, start=1)
    ]
    for preset in PRESETS:
        drawn = draw_ablations(out / f"without_{preset}.png", preset, ablations, located)
        pictures.append((f"Without one part: {preset}", drawn))
    write_report(out / "report.html", "Beyond the paper's experiments", report, pictures)
    return text(report, curves, ablations, located)


def bars(located: Located) -> list[dict[str, Any]]:
    """The bar on all of greater Boston, where it was run."""
    tried = located.get(EVERYWHERE)
    if tried is None:
        return []
    found = summary(tried)
    what = f"all of greater Boston, flights anywhere, default preset, level {EVERYWHERE.level}: recall@1"
    value, interval = found["recall@1"], found["recall@1_95%"]
    return [{"what": what, "bar": BAR, "measured": value, "95 %": str(interval), "held": value >= BAR}]


def text(report: Mapping[str, Any], curves: Curves, ablations: Ablations, located: Located) -> str:
    """For people: recall at 1 of both presets."""
    lines = list(report["what is real"])
    lines += ["", *(f"{b['what']} {b['measured']:.3f} (bar {b['bar']}: {held(b)})" for b in report["bars"])]
    for factor, by_preset in curves:
        lines += ["", f"{factor.title} ({factor.axis}): recall@1"]
        lines += [f"  {preset:<8} {_recalls(values, located)}" for preset, values in by_preset.items()]
    for (preset, level), values in ablations.items():
        lines += [
            "",
            f"{preset}, level {level}, without one part: recall@1",
            f"  {_recalls(values, located)}",
        ]
    return "\n".join(lines)


def held(bar: Mapping[str, Any]) -> str:
    """Whether a bar is reached, as a word."""
    return "held" if bar["held"] else "missed"


def _recalls(values: Values, located: Located) -> str:
    return "  ".join(f"{value}: {summary(located[case])['recall@1']:.2f}" for value, case in values)
