"""`buildloc eval scale`: the matcher against the size of the reference and the errors of the map.

The reference is real (greater Boston, OpenStreetMap); maps are drawn from it with the errors of
:mod:`buildloc_eval.observation`. There are no images.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from buildloc_matcher import oracle
from buildloc_matcher.config import matcher_config
from buildloc_matcher.match_cache import MatchCache
from buildloc_matcher.matcher import Matcher, MatchResult
from buildloc_matcher.mesh import mesh
from buildloc_matcher.reference.build import build
from buildloc_matcher.reference.database import ReferenceDatabase, open_database
from buildloc_matcher.reference.region import Circle
from buildloc_msgs_py.types import LocalMap
from matplotlib.ticker import NullFormatter
from scipy.spatial import cKDTree

from buildloc_eval.generators import method, reference_stars
from buildloc_eval.html import write_report
from buildloc_eval.machine import machine
from buildloc_eval.memory import peak_memory_mb
from buildloc_eval.observation import Digitiser, Level, ObservedMap, observe_map, sensing
from buildloc_eval.realworld import LEXINGTON_DEG, data_folder
from buildloc_eval.trials import run_trial, summary

Progress = Callable[[str], None]

SOURCE = "footprints/boston_osm.parquet"
OUTSIDE_M = 1000.0
TICKS = (20_000, 50_000, 100_000, 200_000, 500_000)
REAL = "reference: real footprints (OpenStreetMap, greater Boston); maps: simulated; no images"


@dataclass(frozen=True)
class Size:
    """A reference: everything within ``radius_km`` of Lexington, or all of greater Boston."""

    name: str
    radius_km: float | None


SIZES = (
    Size("4.2 km", 4.2), Size("6 km", 6.0), Size("9 km", 9.0), Size("12 km", 12.0), Size("18 km", 18.0),
    Size("all", None),
)  # fmt: skip
TIMED = "12 km"  # where the bars on time are


@dataclass(frozen=True)
class Plan:
    """How much is run: ``maps`` of each kind that a bar is set for (60 buildings or more, levels 1 and 2, the
    default preset, the largest reference), ``maps_elsewhere`` of every other kind."""

    sizes: tuple[Size, ...]
    buildings: tuple[int, ...]
    levels: tuple[Level, ...]
    maps: int
    maps_elsewhere: int
    others: tuple[str, ...]
    oracle_maps: int


FULL = Plan(SIZES, (30, 60, 100, 200), (1, 2, 3), 200, 40, ("paper", "index 32-D", "shape-free 8-D"), 3)
QUICK = Plan((SIZES[1], SIZES[3]), (60, 100), (1, 2), 20, 10, ("paper",), 1)


def draw(database: ReferenceDatabase, tree: cKDTree, count: int, level: Level, seed: int) -> ObservedMap:
    """The map of a seed: the same for every method."""
    rng = np.random.default_rng([seed, count, 0 if level == "measured" else round(level)])
    return observe_map(database.buildings, tree, count, sensing(level), rng)


def built(size: Size, source: Path, path: Path) -> dict[str, Any]:
    """Build the database of a size; its figures."""
    circle = None if size.radius_km is None else Circle(*LEXINGTON_DEG, size.radius_km)
    started = time.perf_counter()
    report = build([source], path, matcher_config(), circle)
    seconds = time.perf_counter() - started
    stored = sum(file.stat().st_size for file in path.iterdir())
    opened = []
    for _ in range(5):
        started = time.perf_counter()
        database = open_database(path, matcher_config())
        opened.append(time.perf_counter() - started)
    area = report.built_up_km2 if size.radius_km is None else math.pi * size.radius_km**2
    return {
        "buildings": len(database), "stars": database.stars, "tiles": len(database.tiles), "km2": area,
        "build_s": seconds, "bytes_per_building": stored / len(database), "kB_per_km2": stored / area / 1e3,
        "open_ms": 1e3 * float(np.median(opened)),
    }  # fmt: skip


def against_oracle(database: ReferenceDatabase, maps: Sequence[LocalMap], name: str) -> dict[str, Any]:
    """Star matching alone, compiled and in plain NumPy, on the same stars; whether they agree."""
    config = matcher_config({"preset": name})
    reference = reference_stars(database)
    fast, plain, equal = [], [], True
    for local_map in maps:
        large = local_map.areas_m2 >= config.min_area_m2
        rows = (local_map.centroids_m[large], local_map.areas_m2[large], local_map.shapes[large])
        stars = mesh(*rows, max_stars=config.max_stars).stars
        matcher = MatchCache(database.tables, config)
        matcher.match(stars)  # compiled code is loaded
        matcher = MatchCache(database.tables, config)
        started = time.perf_counter()
        found = matcher.match(stars)
        fast.append(time.perf_counter() - started)
        started = time.perf_counter()
        expected = oracle.match_stars(stars, reference, config)
        plain.append(time.perf_counter() - started)
        equal &= bool((found.reference == expected.reference).all() and (found.score == expected.score).all())
    ratio = float(np.median(np.array(plain) / np.array(fast)))
    return {
        "fast_ms": 1e3 * float(np.median(fast)), "oracle_ms": 1e3 * float(np.median(plain)),
        "times_faster": ratio, "equal": equal,
    }  # fmt: skip


def incremental(database: ReferenceDatabase, observed: Sequence[ObservedMap]) -> dict[str, Any]:
    """A map that has grown by its last buildings: what is matched anew, and the time of each stage."""
    shares, match, total = [], [], []
    for one in observed:
        matcher = Matcher(database, matcher_config())
        whole = one.local_map
        grown_by = max(1, len(whole) // 40)
        matcher.locate(whole.select(np.arange(len(whole) - grown_by)))
        found: MatchResult = matcher.locate(whole)
        if found.funnel["looks"] > 1:
            continue  # a second look is no step of an incremental search
        shares.append(found.funnel["stars_matched_anew"] / found.funnel["stars"])
        match.append(1e3 * found.seconds["match"])
        total.append(1e3 * sum(found.seconds.values()))
    return {
        "stars_changed": float(np.median(shares)), "match_ms": float(np.median(match)),
        "locate_ms": float(np.median(total)), "maps": len(shares),
    }  # fmt: skip


def exponent(counts: Sequence[float], values: Sequence[float]) -> float:
    """Slope of the logarithm of values against that of counts."""
    return float(np.polyfit(np.log(counts), np.log(values), 1)[0])


def recall(
    plan: Plan, size: Size, database: ReferenceDatabase, tree: cKDTree, seed: int, progress: Progress
) -> list[dict[str, Any]]:
    """Every method on the same maps: all kinds of maps for the default on the largest reference."""
    rows = []
    largest = size == plan.sizes[-1]
    for name in ("default", *(plan.others if largest else ("paper",))):
        matcher = method(name, database)
        matcher.warm_up()
        everything = largest and name == "default"
        for count in plan.buildings if everything else (60, 100):
            for level in plan.levels if everything else (1, 2):
                barred = everything and count >= 60 and level in (1, 2)
                maps = plan.maps if barred else plan.maps_elsewhere
                progress(f"{size.name}, {name}: {maps} maps of {count} buildings, level {level}")
                drawn = (draw(database, tree, count, level, seed + i) for i in range(maps))
                trials = [run_trial(matcher, observed) for observed in drawn]
                kind = {"size": size.name, "method": name, "buildings": count, "level": level}
                rows.append(kind | summary(trials))
    return rows


def controls(
    plan: Plan, database: ReferenceDatabase, reference: ReferenceDatabase, seed: int, progress: Progress
) -> dict[str, Any]:
    """Maps of ground that the reference does not hold: every fix is a false one."""
    west, south, east, north = reference.bounds_m
    x, y = database.centroids_m.T
    reach = OUTSIDE_M
    outside = (x < west - reach) | (x > east + reach) | (y < south - reach) | (y > north + reach)
    away = database.buildings.select(np.flatnonzero(outside))
    tree, matcher, tried, false = cKDTree(away.centroids_m), method("default", reference), 0, 0
    for count in (60, 100):
        for level in (1, 2):
            progress(f"{plan.maps} maps of {count} buildings, level {level}, from outside the reference")
            for i in range(plan.maps):
                rng = np.random.default_rng([seed + i, count, level])
                found = matcher.locate(observe_map(away, tree, count, sensing(level), rng).local_map)
                tried, false = tried + 1, false + (matcher.judge(found).reason is None)
    return {"maps": tried, "false fixes": false, "reference": len(reference)}


def evaluate(
    out: Path, seed: int, quick: bool, progress: Progress, levels: tuple[Level, ...] | None = None
) -> str:
    """Run the benchmark, write report.json and report.html; the summary. ``levels``: of the error model,
    instead of those of the plan, for the default preset on the largest reference."""
    plan = QUICK if quick else FULL
    plan = plan if levels is None else replace(plan, levels=levels)
    source = data_folder() / SOURCE
    out.mkdir(parents=True, exist_ok=True)
    references: dict[str, Any] = {}
    timing: dict[str, Any] = {}
    outside: dict[str, Any] = {}
    rows: list[dict[str, Any]] = []
    for size in plan.sizes:
        path = _path(out, size)
        progress(f"building the reference of {size.name}")
        references[size.name] = built(size, source, path)
        database = open_database(path, matcher_config())
        tree = cKDTree(database.centroids_m)
        if size.name == TIMED:
            maps = [draw(database, tree, 100, 1, seed + i) for i in range(10 * plan.oracle_maps)]
            some = [observed.local_map for observed in maps[: plan.oracle_maps]]
            timing = {name: against_oracle(database, some, name) for name in ("default", "paper")}
            timing["incremental"] = incremental(database, maps)
        rows += recall(plan, size, database, tree, seed, progress)
        if size == plan.sizes[-1]:
            smallest = open_database(_path(out, plan.sizes[0]), matcher_config())
            outside = controls(plan, database, smallest, seed, progress)
        one = draw(database, tree, 100, 1, seed).local_map
        references[size.name]["memory_mb"] = peak_memory_mb(path, one)
    report = {
        "evaluation": "scale",
        "what is real": REAL,
        "command": " ".join(["buildloc", *sys.argv[1:]]),
        "seed": seed,
        "quick": quick,
        **machine(),
        "error model": {"digitiser": asdict(Digitiser())}
        | {f"level {level}": asdict(sensing(level)) for level in dict.fromkeys((1, *plan.levels))},
        "references": references,
        f"timing at {TIMED}": timing,
        "maps from outside the reference": outside,
        "growth of time": growth_of_time(references, rows),
        "trials": rows,
    }
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    pictures = draw_plots(out, references, rows)
    write_report(out / "report.html", "Matching against the size of the reference", report, pictures)
    return table(report)


def _path(out: Path, size: Size) -> Path:
    return out / f"boston_{size.name.replace(' ', '')}.bldb"


def growth_of_time(references: dict[str, Any], rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Exponents of milliseconds against buildings, maps of 100 buildings, level 1, default preset."""
    series = [r for r in rows if (r["method"], r["buildings"], r["level"]) == ("default", 100, 1)]
    counts = [references[r["size"]]["buildings"] for r in series]
    return {
        "exponent of match": exponent(counts, [r["ms"]["match"] for r in series]),
        "exponent of all": exponent(counts, [r["ms_total"] for r in series]),
    }


def table(report: dict[str, Any]) -> str:
    """For people: references, timing, trials."""
    lines = [report["what is real"], "", "reference    buildings  build_s  B/bldg  open_ms  memory_MB"]
    lines += [
        f"{name:<11}  {r['buildings']:>9,}  {r['build_s']:7.1f}  {r['bytes_per_building']:6.0f}  "
        f"{r['open_ms']:7.0f}  {r['memory_mb']:9.0f}"
        for name, r in report["references"].items()
    ]
    lines += ["", json.dumps(report[f"timing at {TIMED}"], indent=1), json.dumps(report["growth of time"])]
    lines += [f"maps from outside the reference: {json.dumps(report['maps from outside the reference'])}"]
    lines += [
        "",
        "reference    method          bldgs     level  maps   R@1    R@5   R@10  error_m  false   ms",
    ]
    for r in report["trials"]:
        error = "-" if r["median_error_m"] is None else f"{r['median_error_m']:.2f}"
        lines.append(
            f"{r['size']:<11}  {r['method']:<14}  {r['buildings']:5d}  {r['level']!s:>8}  {r['maps']:4d}  "
            f"{r['recall@1']:5.3f}  {r['recall@5']:5.3f}  {r['recall@10']:5.3f}  {error:>7}  "
            f"{r['false_fixes']:5d}  {r['ms_total']:5.0f}"
        )
    return "\n".join(lines)


def draw_plots(
    out: Path, references: dict[str, Any], rows: Sequence[dict[str, Any]]
) -> list[tuple[str, Path]]:
    """Recall and time against the number of buildings, one line per method and level."""
    pictures = []
    for caption, value, label, scale in (
        ("Recall at 1 against the size of the reference", "recall@1", "recall at 1", "linear"),
        ("Time of a map against the size of the reference", "ms_total", "milliseconds", "log"),
    ):
        figure, panels = plt.subplots(1, 2, figsize=(12, 4.5), sharey=True)
        for axes, count in zip(panels, (60, 100), strict=True):
            kinds = dict.fromkeys((r["method"], r["level"]) for r in rows if r["buildings"] == count)
            for name, level in kinds:
                mine = [r for r in rows if (r["method"], r["buildings"], r["level"]) == (name, count, level)]
                counts = [references[r["size"]]["buildings"] for r in mine]
                axes.plot(counts, [r[value] for r in mine], "o-", label=f"{name}, level {level}")
            axes.set(
                title=f"maps of {count} buildings", xlabel="reference buildings", xscale="log", yscale=scale
            )
            axes.set_xticks(TICKS, [f"{tick // 1000}k" for tick in TICKS])
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.grid(alpha=0.3)
        panels[0].set_ylabel(label)
        panels[1].legend(fontsize=8)
        figure.tight_layout()
        path = out / f"{value.replace('@', '_')}.png"
        figure.savefig(path, dpi=110)
        plt.close(figure)
        pictures.append((caption, path))
    return pictures
