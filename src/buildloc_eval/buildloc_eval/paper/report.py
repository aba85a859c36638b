"""The report: the paper's tables with its own figures beside ours, the figures, and what the failures failed
by. Predictions are only read here."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from buildloc_msgs_py.types import FloatArray

from buildloc_eval.bars import holds
from buildloc_eval.html import write_report
from buildloc_eval.machine import machine
from buildloc_eval.paper import figures
from buildloc_eval.paper.flights import Flight, PaperFlight
from buildloc_eval.paper.flown import Maps, true_place
from buildloc_eval.paper.methods import BRM, METHODS, PUBLISHED, Prediction
from buildloc_eval.paper.netvlad import NETVLAD
from buildloc_eval.paper.plan import Models, Plan, Stores, maps_name, outlines_of, prediction_name
from buildloc_eval.paper.published import (
    CORRECT_M,
    FIRST_SUCCESS,
    LARGE_RADII_KM,
    RADII_KM,
    RECALL,
    SECONDS_PER_QUERY,
    STABLE_SUCCESS,
)
from buildloc_eval.paper.scoring import (
    RANKS,
    Score,
    bins_within,
    error_row,
    first_and_stable,
    mean_interval,
    recall_row,
    score,
)
from buildloc_eval.segmentation_errors import Outlines

OURS = "default preset"
# What the report shows of a solve's funnel, in the order of the stages.
FUNNEL = (
    "buildings", "stars", "matches", "hypotheses", "voters", "clusters", "rescored", "looks", "log_odds",
    "lead", "score",
)  # fmt: skip
REAL = [
    "real: the footprints (greater Boston, OpenStreetMap 2021) and the ground's texture (orthophotos of "
    "Barnarp and Banepa, mirrored); registration, mapping, matching and refinement are the system's own",
    "simulated: the flights, the camera, its telemetry, and the masks (true footprints with the "
    "errors that the network which ships was measured to make over Barnarp, a suburb it never saw); the "
    "reference differs from what is flown over as one digitiser from "
    "another and by the errors of automatic mapping that are listed below",
    "the paper's own figures are of seven real flights over Denver with Microsoft's footprints",
]
TIMES = (
    "wall-clock, with as many flights located at once as there are cores; NetVLAD alone, and "
    "without describing the reference's tiles"
)
NOT_DONE = ["NetVLAD has not been run: the paper's figures stand alone in its rows"]


@dataclass(frozen=True)
class Chapter:
    """A part of the report: what it says, its bars and its pictures."""

    title: str
    said: dict[str, Any]
    bars: list[dict[str, Any]]
    pictures: list[tuple[str, Path]]


@dataclass(frozen=True)
class Trial:
    """A scored whole flight."""

    method: str
    radius_km: int
    flight: str
    seed: int
    score: Score
    prediction: Prediction


def trials(stores: Stores, flights: Sequence[Flight], plan: Plan, seed: int) -> list[Trial]:
    """Every whole flight of a plan, scored."""
    found = []
    for flight in flights:
        for s in range(seed, seed + plan.seeds):
            maps: Maps = stores.maps.load(maps_name(flight, s))
            for radius in plan.radii_km:
                for name in plan.methods:
                    prediction = stores.of(name).load(prediction_name(name, radius, flight, s, False))
                    scored = score(prediction, maps, len(maps.snapshots), radius)
                    found.append(Trial(name, radius, flight.name, s, scored, prediction))
    return found


def methods_of(scored: Sequence[Trial]) -> list[str]:
    """Those that were run, in the order of the tables."""
    run = {trial.method for trial in scored}
    return [name for name in (NETVLAD, *METHODS) if name in run]


def recall_table(scored: Sequence[Trial], radii_km: Sequence[int]) -> list[dict[str, Any]]:
    """The paper's Table "comparison with baselines": share of trials, interval, and the paper's of seven."""
    rows = []
    for name in methods_of(scored):
        for k in RANKS:
            row: dict[str, Any] = {"method": name, "metric": f"R@{k}"}
            for radius in radii_km:
                mine = [t.score for t in scored if (t.method, t.radius_km) == (name, radius)]
                row[f"{radius} km"] = _recall_cell(mine, k)
                row[f"paper, {radius} km"] = (
                    f"{RECALL[PUBLISHED.get(name, name)][k][RADII_KM.index(radius)]}/7"
                )
            rows.append(row)
    for k in RANKS if NETVLAD not in methods_of(scored) else ():
        cells = {f"paper, {r} km": f"{RECALL[NETVLAD][k][RADII_KM.index(r)]}/7" for r in radii_km}
        rows.append({"method": f"{NETVLAD} (not run)", "metric": f"R@{k}", **cells})
    return rows


def _recall_cell(scores: Sequence[Score], k: int) -> str:
    if not scores:
        return "not run"
    found = recall_row(scores)
    low, high = found[f"recall@{k}_95%"]
    return f"{found[f'recall@{k}']:.3f} [{low:.2f}, {high:.2f}] of {len(scores)}"


def flight_table(
    flights: Sequence[PaperFlight], maps: dict[int, list[Maps]], counts: dict[int, dict[int, int]]
) -> list[dict[str, Any]]:
    """The paper's Table "flight trajectories" and the sizes of the references."""
    rows = []
    for flight in flights:
        mine = maps[flight.number]
        flown = mine[0].true_m
        lasts = [m.snapshots[-1] for m in mine]
        sizes = [0 if last is None else len(last.local_map) for last in lasts]
        row: dict[str, Any] = {
            "flight": flight.number, "centre (UTM 19N)": "{:.0f}, {:.0f}".format(*flight.centre_m),
            "environment": flight.like.environment + (", snow" if flight.like.snow else ""),
            "length_km": round(float(np.hypot(*np.diff(flown, axis=0).T).sum()) / 1000.0, 2),
            "paper's length": flight.like.length_km, "altitude_m": flight.like.altitude_m,
            "keyframes": len(flown), "paper's keyframes": flight.like.keyframes,
            "buildings mapped": float(np.median(sizes)), "paper's": flight.like.detected,
        }  # fmt: skip
        for radius, count in counts[flight.number].items():
            row[f"reference {radius} km"] = count
            if radius in LARGE_RADII_KM:
                row[f"paper's {radius} km"] = flight.like.reference[LARGE_RADII_KM.index(radius)]
        rows.append(row)
    return rows


def error_table(
    scored: Sequence[Trial], method: str, flights: Sequence[PaperFlight], radii_km: Sequence[int]
) -> list[dict[str, Any]]:
    """The paper's Table of coarse and final errors, of a method and the seeds whose first place is right."""
    rows = []
    for flight in flights:
        row: dict[str, Any] = {"flight": flight.number}
        for radius in (r for r in radii_km if r in LARGE_RADII_KM):
            mine = [
                t.score for t in scored if (t.method, t.radius_km, t.flight) == (method, radius, flight.name)
            ]
            right = sum(s.rank == 1 for s in mine)
            column = LARGE_RADII_KM.index(radius)
            row[f"right, {radius} km"] = f"{right}/{len(mine)}"
            row |= {f"{key}, {radius} km": value for key, value in error_row(mine).items()}
            row[f"paper's coarse, {radius} km"] = flight.like.coarse_m[column]
            row[f"paper's final, {radius} km"] = flight.like.final_m[column]
        rows.append(row)
    return rows


@dataclass(frozen=True)
class Converged:
    """First and stable success of one flight, seed, method and radius, and the trace of the true bin."""

    method: str
    radius_km: int
    seed: int
    flight: str
    first: int | None
    stable: int | None
    ranks: tuple[int, ...]
    stable_rank: int | None
    accepted: int | None = None  # the first prefix that is a fix, right or wrong


def converged(stores: Stores, flights: Sequence[Flight], plan: Plan, seed: int) -> list[Converged]:
    """Every prefix of every flight that the plan asks for, scored."""
    found = []
    wanted = [(name, *one) for name, seeds in plan.prefixes.items() for one in seeds.items()]
    most = max((seeds for *_, seeds in wanted), default=0)
    for flight, s in product(flights, range(seed, seed + most)):
        maps: Maps = stores.maps.load(maps_name(flight, s))
        for name, radius, seeds in wanted:
            if s >= seed + seeds:
                continue
            prefixes = stores.predictions.load(prediction_name(name, radius, flight, s, True))
            scores = [score(p, maps, n, radius) for n, p in enumerate(prefixes, start=1)]
            first, stable = first_and_stable([one.rank == 1 for one in scores])
            ranks = tuple(one.bin_rank for one in scores)
            _, top = first_and_stable([rank == 1 for rank in ranks])
            accepted, _ = first_and_stable([one.fix for one in scores])
            found.append(Converged(name, radius, s, flight.name, first, stable, ranks, top, accepted))
    return found


def convergence_table(all_of: Sequence[Converged]) -> list[dict[str, Any]]:
    """Mean keyframes to the first and the stable success, over the flights of all seeds that have one; its
    95 % interval, from the scatter of the seeds' means; the paper's; by flight the mean and the ends."""
    rows = []
    for name, radius in dict.fromkeys((c.method, c.radius_km) for c in all_of):
        mine = [c for c in all_of if (c.method, c.radius_km) == (name, radius)]
        column = LARGE_RADII_KM.index(radius) if radius in LARGE_RADII_KM else None
        row: dict[str, Any] = {"method": name, "radius_km": radius, "flights": len(mine)}
        by_flight: dict[str, str] = {}
        for kind, published in (("first", FIRST_SUCCESS), ("stable", STABLE_SUCCESS)):
            reached = [(c, getattr(c, kind)) for c in mine if getattr(c, kind) is not None]
            row[f"{kind} success"] = float(np.mean([n for _, n in reached])) if reached else None
            seeds = [[n for c, n in reached if c.seed == seed] for seed in {c.seed for c, _ in reached}]
            row[f"{kind} success_95%"] = mean_interval([float(np.mean(some)) for some in seeds])
            row[f"{kind} success, flights"] = len(reached)
            row[f"{kind} success, paper's"] = None if column is None else published[column]
            by_flight[f"by flight, {kind}"] = _by_flight(mine, kind)
        accepted = [c.accepted for c in mine if c.accepted is not None]
        row["first accepted fix"] = float(np.mean(accepted)) if accepted else None
        row["first accepted fix, flights"] = len(accepted)
        by_flight["by flight, accepted"] = _by_flight(mine, "accepted")
        rows.append(row | by_flight)
    return rows


def _by_flight(some: Sequence[Converged], kind: str) -> str:
    """Of each flight the mean and the ends of the keyframes to ``kind``, over its seeds."""
    parts = []
    for flight in dict.fromkeys(c.flight for c in some):
        found = [getattr(c, kind) for c in some if c.flight == flight and getattr(c, kind) is not None]
        told = f"{np.mean(found):.1f} ({min(found)} to {max(found)})" if found else "never"
        parts.append(f"{flight}: {told}")
    return ", ".join(parts)


def acceptance_table(scored: Sequence[Trial], radii_km: Sequence[int]) -> list[dict[str, Any]]:
    """Shares of trials whose refined place is right, and which are a fix; and the fixes that are wrong."""
    rows = []
    for name in (n for n in methods_of(scored) if n not in (BRM, NETVLAD)):
        for radius in radii_km:
            mine = [t.score for t in scored if (t.method, t.radius_km) == (name, radius)]
            if not mine:
                continue
            found = recall_row(mine)
            kept = {key: found[key] for key in ("trials", "final within 100 m", "fixes", "false fixes")}
            rows.append({"method": name, "radius_km": radius, **kept})
    return rows


def runtime_table(scored: Sequence[Trial], radii_km: Sequence[int]) -> list[dict[str, Any]]:
    """Median milliseconds per stage of a query with a whole flight's map."""
    rows = []
    for name in methods_of(scored):
        for radius in radii_km:
            asked = [t.prediction for t in scored if (t.method, t.radius_km) == (name, radius)]
            mine = [prediction.seconds for prediction in asked if prediction.seconds]
            stages = dict.fromkeys(stage for seconds in mine for stage in seconds)
            row: dict[str, Any] = {"method": name, "radius_km": radius}
            row["total_ms"] = 1e3 * float(np.median([sum(s.values()) for s in mine])) if mine else None
            row |= {f"{g}_ms": 1e3 * float(np.median([s.get(g, 0.0) for s in mine])) for g in stages}
            if radius in LARGE_RADII_KM:
                low, high = SECONDS_PER_QUERY[LARGE_RADII_KM.index(radius)]
                row["paper's (GPU, segmentation too)"] = f"{1e3 * low:.0f} to {1e3 * high:.0f}"
            rows.append(row)
    return rows


def failure_table(scored: Sequence[Trial]) -> list[dict[str, Any]]:
    """What lost the trials whose first place is wrong, which they were, and the median of their funnel."""
    rows = []
    for name in methods_of(scored):
        lost = [t for t in scored if t.method == name and t.score.lost_by]
        for reason, count in Counter(t.score.lost_by for t in lost).most_common():
            mine = [t for t in lost if t.score.lost_by == reason]
            where = Counter(f"{t.flight} at {t.radius_km} km" for t in mine)
            places = ", ".join(f"{place}: {n}" for place, n in where.most_common())
            row = {"method": name, "lost by": reason, "trials": count, "where": places}
            rows.append(row | {stage: _median_of(mine, stage) for stage in FUNNEL})
    return rows


def _median_of(trials: Sequence[Trial], stage: str) -> float | None:
    counts = [t.prediction.funnel[stage] for t in trials if stage in t.prediction.funnel]
    return float(np.median(counts)) if counts else None


def failures_one_by_one(scored: Sequence[Trial], method: str) -> list[dict[str, Any]]:
    """Every trial of a method whose first place is wrong: where it went, why it was or was not refused as a
    fix, and its funnel."""
    return [
        {
            "flight": t.flight, "radius_km": t.radius_km, "seed": t.seed, "lost by": t.score.lost_by,
            "rank": t.score.rank or None, "rank of the true bin": t.score.bin_rank,
            "first place off, m": t.score.coarse_m if math.isfinite(t.score.coarse_m) else None,
            "refused": t.prediction.refused,
            **{stage: t.prediction.funnel.get(stage) for stage in FUNNEL},
        }
        for t in scored
        if t.method == method and t.score.lost_by
    ]  # fmt: skip


def bars(scored: Sequence[Trial], traces: Sequence[Converged]) -> list[dict[str, Any]]:
    """The issue's bars that this run can answer."""

    def recall(method: str, radii: Sequence[int]) -> float | None:
        mine = [t.score.rank == 1 for t in scored if t.method == method and t.radius_km in radii]
        return float(np.mean(mine)) if mine else None

    large = [t.score for t in scored if t.method == OURS and t.radius_km in LARGE_RADII_KM]
    finals = [s.final_m for s in large if s.rank == 1 and math.isfinite(s.final_m)]
    stable = [c.stable for c in traces if c.method == OURS and c.radius_km == 6]
    reached = [s for s in stable if s is not None]
    mean = float(np.mean(reached)) if reached else None
    # What, bar, measured, whether more is better, whether this run can tell.
    rows = [
        ("default preset, recall@1 at 6 and 9 km", 1.0, recall(OURS, (6, 9)), True, None),
        ("default preset, recall@1 at 12 km", 0.97, recall(OURS, (12,)), True, None),
        ("paper preset, recall@1 at 12 km (paper: 5/7)", None, recall("paper preset", (12,)), True, None),
        (
            f"keyframes to stable success at 6 km, mean of the {len(reached)} of {len(stable)} that reach it",
            30.0,
            mean,
            False,
            bool(stable),
        ),
        ("final error, median, m", 10.0, float(np.median(finals)) if finals else None, False, bool(large)),
        ("final error, worst, m", 30.0, max(finals) if finals else None, False, bool(large)),
    ]
    return [
        judged(what, bar, value, more)
        for what, bar, value, more, told in rows
        if told or (told is None and value is not None)
    ]


def judged(what: str, bar: float | None, value: float | None, more: bool) -> dict[str, Any]:
    """A row of the table of bars."""
    return {"what": what, "bar": bar, "measured": value, "held": held(bar, value, more)}


def held(bar: float | None, value: float | None, more: bool) -> bool | None:
    """Whether a bar is reached, by more or by less; never without a value; None without a bar."""
    return None if bar is None else holds(value, bar, more)


def boston(
    out: Path, stores: Stores, flights: Sequence[PaperFlight], plan: Plan, models: Models, seed: int
) -> Chapter:
    """Score all predictions of the paper's flights; draws into ``out``."""
    kept, buildings = stores.ground.load("reference")
    reference = outlines_of(kept)
    scored, traces = trials(stores, flights, plan, seed), converged(stores, flights, plan, seed)
    maps = {
        f.number: [stores.maps.load(maps_name(f, s)) for s in range(seed, seed + plan.seeds)] for f in flights
    }
    counts = {
        f.number: {
            radius: int((np.hypot(*(buildings.centroids_m - f.centre_m).T) <= 1000.0 * radius).sum())
            for radius in plan.radii_km
        }
        for f in flights
    }
    said = {
        "what is real": REAL,
        "not done": [] if NETVLAD in plan.methods else NOT_DONE,
        "seeds": list(range(seed, seed + plan.seeds)),
        "flights and references": flight_table(flights, maps, counts),
        "recall": recall_table(scored, plan.radii_km),
        "errors, default preset": error_table(scored, OURS, flights, plan.radii_km),
        "errors, paper preset": error_table(scored, "paper preset", flights, plan.radii_km),
        "refined places and fixes": acceptance_table(scored, plan.radii_km),
        "convergence": convergence_table(traces),
        "time of a query": runtime_table(scored, plan.radii_km),
        "times": TIMES,
        "failures": failure_table(scored),
        f"failures of the {OURS}, one by one": failures_one_by_one(scored, OURS),
        "error models": asdict(models),
        "plan": asdict(plan),
    }
    pictures = draw(out, stores, flights, plan, seed, reference, scored, traces)
    return Chapter("Seven flights over Boston", said, bars(scored, traces), pictures)


def write(out: Path, chapters: Sequence[Chapter], seed: int, quick: bool, seconds: float) -> str:
    """Write report.json and report.html; the summary."""
    minutes = judged(
        "minutes of this run, of what was not there yet", 5.0 if quick else 60.0, seconds / 60.0, False
    )
    report = {
        "evaluation": "paper",
        "what is real": {chapter.title: chapter.said["what is real"] for chapter in chapters},
        "command": " ".join(["buildloc", *sys.argv[1:]]),
        "seed": seed,
        "quick": quick,
        **machine(),
        "bars": [*(row for chapter in chapters for row in chapter.bars), minutes],
    }
    whole = report | {chapter.title: chapter.said for chapter in chapters}
    (out / "report.json").write_text(json.dumps(whole, indent=2) + "\n")
    told = [(chapter.title, chapter.said, chapter.pictures) for chapter in chapters]
    write_report(out / "report.html", "The paper's experiments on open data", report, [], told)
    return summary(report, chapters)


def draw(
    out: Path, stores: Stores, flights: Sequence[PaperFlight], plan: Plan, seed: int, reference: Outlines,
    scored: Sequence[Trial], traces: Sequence[Converged],
) -> list[tuple[str, Path]]:  # fmt: skip
    """All figures with their captions."""
    centres = shapely.get_coordinates(shapely.centroid(reference))
    around = {f.name: reference[np.hypot(*(centres - f.centre_m).T) < 1500.0] for f in flights}
    first = {f.name: stores.maps.load(maps_name(f, seed)) for f in flights}
    paths = {name: maps.true_m for name, maps in first.items()}
    pictures = [
        (
            "Flights over the reference (simulated flights, real footprints)",
            figures.draw_trajectories(out / "trajectories.png", around, paths),
        )
    ]
    pictures += convergence_pictures(out, traces)
    rows = {name: radius_row(scored, name, plan.radii_km) for name in plan.methods}
    drawn = figures.draw_radius(out / "radius.png", plan.radii_km, rows)
    pictures.append(("Recall, coarse error and time against the search radius", drawn))
    shown = flights[-1]
    radius = 6 if 6 in plan.radii_km else plan.radii_km[-1]
    found: dict[str, Prediction] = {
        name: stores.of(name).load(prediction_name(name, radius, shown, seed, False)) for name in plan.methods
    }
    maps, wide = first[shown.name], 1000.0 * radius + figures.VIEW_M
    last = maps.snapshots[-1]
    map_m = np.empty((0, 2)) if last is None else last.local_map.centroids_m
    within = reference[np.hypot(*(centres - shown.centre_m).T) < wide]
    truths = {name: _truth(maps, prediction) for name, prediction in found.items()}
    path = figures.draw_candidates(out / "candidates.png", within, found, map_m, truths, CORRECT_M)
    pictures.append((f"The first three places of every method: {shown.name}, {radius} km", path))
    return pictures


def convergence_pictures(out: Path, traces: Sequence[Converged]) -> list[tuple[str, Path]]:
    """The rank of the true bin over the keyframes of all seeds, for each method and radius."""
    pictures = []
    for name, radius in dict.fromkeys((c.method, c.radius_km) for c in traces):
        mine = [c for c in traces if (c.method, c.radius_km) == (name, radius)]
        drawn = []
        for flight in dict.fromkeys(c.flight for c in mine):
            of = [c for c in mine if c.flight == flight]
            stable = [c.stable_rank for c in of if c.stable_rank is not None]
            median = float(np.median(stable)) if len(stable) == len(of) else None
            shortest = min(len(c.ranks) for c in of)
            ranks = np.array([c.ranks[:shortest] for c in of])
            drawn.append(figures.Trace(flight, ranks, median))
        path = out / f"convergence_{name.replace(' ', '_')}_{radius}km.png"
        figures.draw_convergence(path, drawn, radius, bins_within(radius))
        pictures.append((f"Rank of the true bin as keyframes accumulate: {name}, {radius} km", path))
    return pictures


def _truth(maps: Maps, prediction: Prediction) -> FloatArray:
    last = maps.snapshots[-1]
    if prediction.centre_m is None or last is None:
        return np.asarray(maps.true_m[-1])
    return true_place(maps, last, prediction.centre_m)


def radius_row(
    scored: Sequence[Trial], method: str, radii_km: Sequence[int]
) -> dict[str, list[float | None]]:
    """What the figure shows of a method."""
    row: dict[str, list[float | None]] = {"recall@1": [], "coarse error, m": [], "seconds per query": []}
    for radius in radii_km:
        mine = [t for t in scored if (t.method, t.radius_km) == (method, radius)]
        times = [sum(t.prediction.seconds.values()) for t in mine if t.prediction.seconds]
        row["recall@1"].append(sum(t.score.rank == 1 for t in mine) / len(mine))
        row["coarse error, m"].append(error_row([t.score for t in mine])["coarse_median_m"])
        row["seconds per query"].append(float(np.median(times)) if times else None)
    return row


def summary(report: dict[str, Any], chapters: Sequence[Chapter]) -> str:
    """For people."""
    lines = []
    for chapter in chapters:
        lines += [chapter.title, *(f"  {text}" for text in chapter.said["what is real"])]
        lines += [f"  {text}" for text in chapter.said["not done"]]
        if "recall" in chapter.said:
            lines += ["  recall@1, ours (the paper's)", *recall_lines(chapter.said)]
    for row in report["bars"]:
        bar = f" (bar {_figure(row['bar'])}: {'held' if row['held'] else 'missed'})"
        lines.append(f"{row['what']}: {_figure(row['measured'])}" + ("" if row["bar"] is None else bar))
    return "\n".join(lines)


def recall_lines(said: dict[str, Any]) -> list[str]:
    """First places right, by method and radius."""
    return [
        f"  {row['method']:<18} "
        + "  ".join(
            f"{radius} km {row.get(f'{radius} km', '-').split(' ')[0]} ({row[f'paper, {radius} km']})"
            for radius in said["plan"]["radii_km"]
        )
        for row in said["recall"]
        if row["metric"] == "R@1"
    ]


def _figure(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}"
