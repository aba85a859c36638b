"""`buildloc eval segmentation`: networks on labelled real ground they never saw, building by building."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from buildloc_msgs_py.errors import BuildlocError
from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.network import Network

from buildloc_eval.bars import bar_table
from buildloc_eval.html import write_report
from buildloc_eval.instance_metrics import (
    HALF,
    LEAST_IOU,
    MIN_AREA_M2,
    STRICT_IOU,
    Comparison,
    figures,
    pooled,
)
from buildloc_eval.machine import machine
from buildloc_eval.overlapping import Overlap, flicker, overlaps
from buildloc_eval.overlays import draw_windows, largest
from buildloc_eval.places import Scene, overlap, patches, place
from buildloc_eval.realworld import data_folder
from buildloc_eval.segmentation_bars import case_bars, speed_bars
from buildloc_eval.segmentation_errors import POOLED, SegmentationErrors, measured, summary, write_errors
from buildloc_eval.segmented import MAPPED_AREA_M2, SCORED_GSD_M, Scored, busiest, disturbed, score
from buildloc_eval.speed import frame_jpeg, speed, speed_table
from buildloc_eval.trained_on import runs, trained_on, training_line

Progress = Callable[[str], None]

EXPORT = "export.json"  # beside a network, as training/export.py writes it
KINDS = ("instances", "plain", "wire", "mapped")
ONE_ZOOM = 20  # of web tiles: the zooms of a place show the same ground
DISTURBED_SIDE_M = 250.0
QUICK_SIDE_M = 320.0  # four frames overlap on it
REAL = "imagery: real (orthophotos and drone imagery, outlines drawn by people); nothing is simulated"
RULES = {
    "raster": f"{SCORED_GSD_M:g} m per pixel",
    "matched": f"one to one, best IoU first, at IoU {STRICT_IOU:g} and {LEAST_IOU:g}",
    "merged": f"one found building covers at least {HALF:g} of this true one and of another",
    "split": f"at least {HALF:g} of each of several found buildings lies in this true one",
    "missed, false": f"neither matched at IoU {LEAST_IOU:g} nor merged nor split",
    "not counted": f"below {MIN_AREA_M2:g} m2, cut by the edge of the labelled ground, found on such a one",
    "plain": "connected components of the same pixels, without separation of instances",
    "wire": "connected components of the mask that the mapper receives",
    "mapped": f"the same, buildings of at least {MAPPED_AREA_M2:g} m2 alone, which a map holds",
}


class EvaluationError(BuildlocError):
    """Something cannot be evaluated as asked."""


@dataclass(frozen=True)
class Case:
    """A network and the place that it is scored on. ``model`` empty: the one that is shipped."""

    place: str
    model: str


def parse_case(text: str, option: str = "--case") -> Case:
    """PLACE=MODEL of a command line's option. Raises EvaluationError."""
    name, equals, model = text.partition("=")
    if not (name and equals):
        raise EvaluationError(f"{option} {text}: expected PLACE=MODEL, such as barnarp=network.onnx")
    return Case(name, model)


@dataclass(frozen=True)
class Plan:
    """What is evaluated: the cases, with these parameters of networks without their own contract; the
    networks to be timed; where the error model is to be written, if so."""

    cases: tuple[Case, ...]
    config: SegmenterConfig
    seed: int
    quick: bool
    speed: tuple[str, ...]
    errors: Path | None


DEFAULT = (Case("barnarp", ""),)  # the only place that never trains what is shipped


def refuse_known_ground(case: Case, training: dict[str, Any] | None) -> None:
    """Raise EvaluationError when a network was trained on the ground that it is to be scored on."""
    known = [name for name in (training or {}).get("places", []) if overlap(name, case.place)]
    if known:
        raise EvaluationError(
            f"{case.model or 'the shipped network'}: was trained on {', '.join(known)}, so {case.place} says "
            "nothing of ground it has never seen; score it on another place"
        )


def failures(scored: Scored) -> dict[str, list[dict[str, Any]]]:
    """The largest missed and false buildings: area, and place in the scene's pixels."""
    return {
        name: [
            {
                "area_m2": round(float(side.area_m2[k]), 1),
                "pixel": [round(v / SCORED_GSD_M) for v in side.centroid_m[k].tolist()],
            }
            for k in largest(side)
        ]
        for name, side in (("missed", scored.instances.true), ("false", scored.instances.found))
    }


def scores_of(parts: Sequence[Scored]) -> dict[str, Any]:
    """Figures of the segmenter's instances, of plain components, of the mask on the wire and of what a map
    holds of it; the merged buildings of the first over those of the second, None when plain components merge
    none."""
    scores: dict[str, Any] = {
        name: figures(pooled([getattr(part, name) for part in parts])) for name in KINDS
    }
    merged, plainly = scores["instances"]["merged"], scores["plain"]["merged"]
    return scores | {"merged over plain": merged / plainly if plainly else None}


def parity(path: Path) -> dict[str, float] | None:
    """How far PyTorch and ONNX Runtime agreed when a network was exported; None: its folder does not say."""
    report = path.with_name(EXPORT)
    if path.name != "model.onnx" or not report.is_file():
        return None
    try:
        found: dict[str, float] = json.loads(report.read_text())["torch_against_onnx"]
    except (ValueError, KeyError, TypeError) as error:
        raise EvaluationError(f"{report}: holds no torch_against_onnx; export the network again") from error
    return found


def robustness(network: Network, scene: Scene, progress: Progress) -> dict[str, Any]:
    """IoU of each disturbance on the busiest square of a scene, and how far it falls from that of the
    picture as it comes."""
    square = busiest(scene, DISTURBED_SIDE_M)
    before = figures(score(network, square).instances)["pixel_iou"] or 0.0
    rows: dict[str, Any] = {"as it comes": {"pixel_iou": before}}
    for kind, result in disturbed(network, square):
        progress(f"{scene.name}: {kind.name}")
        found = figures(result)
        iou = found["pixel_iou"] or 0.0
        rows[kind.name] = {
            "pixel_iou": iou, "falls_by": before - iou,
            "recall_0.3": found["recall_0.3"], "precision_0.3": found["precision_0.3"],
        }  # fmt: skip
    return rows


@dataclass(frozen=True)
class CaseResult:
    """What goes into the report, the pictures, and what the error model is made of: the comparison of the
    mask on the wire and, where they were asked for, the overlapping frames."""

    report: dict[str, Any]
    pictures: list[tuple[str, Path]]
    comparison: Comparison
    overlaps: list[Overlap]


def run_case(case: Case, plan: Plan, imagery: Path, out: Path, progress: Progress) -> CaseResult:
    """Score a network on a place. Raises EvaluationError, PlaceError, NetworkError."""
    network = Network(replace(plan.config, model=case.model))
    training = trained_on(network.metadata)
    refuse_known_ground(case, training)
    scenes: dict[str, Any] = {}
    pictures, everything, frames = [], list[Scored](), list[Overlap]()
    widest: Scene | None = None
    for scene in place(imagery, case.place, ONE_ZOOM):
        progress(f"{case.place}: {scene.name}")
        parts = []
        for patch in patches(scene):
            part = busiest(patch, QUICK_SIDE_M) if plan.quick else patch
            parts.append(score(network, part))
            widest = part if widest is None or part.labelled.sum() > widest.labelled.sum() else widest
            if plan.errors is not None:
                progress(f"{part.name}: overlapping frames")
                frames += overlaps(network, part, plan.seed)
        main = max(parts, key=lambda part: len(part.instances.true))
        number = plan.cases.index(case) + 1
        picture = out / f"case{number}_{scene.name.replace('/', '_')}.png"
        draw_windows(picture, main, plan.seed)
        pictures.append((f"{case.place}, {scene.name}: true outlines green, found ones magenta", picture))
        scenes[scene.name] = scores_of(parts) | {"largest failures": failures(main)}
        everything += parts
    assert widest is not None  # no place is empty
    report = {
        "place": case.place,
        "model": case.model or "shipped",
        "trained on": runs(training),
        "all scenes": scores_of(everything),
        "scenes": scenes,
        "disturbed input": robustness(network, widest, progress),
        "torch against onnx": parity(network.path),
    }
    return CaseResult(report, pictures, pooled([part.wire for part in everything]), frames)


def error_model(results: Sequence[CaseResult]) -> dict[str, SegmentationErrors]:
    """The errors of each place that frames overlap over, and of all places together.

    Raises EvaluationError when there is nothing to measure them on.
    """
    groups = [(result.report["place"], result.comparison, result.overlaps) for result in results]
    together = (POOLED, pooled([r.comparison for r in results]), [o for r in results for o in r.overlaps])
    found = {}
    for name, comparison, frames in (together, *groups):
        seen = flicker(frames)
        if seen is not None and len(comparison.pairs.true):
            found[name] = measured(comparison, seen)
    if POOLED not in found:
        raise EvaluationError(
            "no two frames show the same building of these places; add a --case of wider ground"
        )
    return found


def evaluate(out: Path, plan: Plan, progress: Progress) -> str:
    """Score every case, write report.json and report.html, and the error model if asked for; the summary.

    Raises EvaluationError, PlaceError, NetworkError.
    """
    imagery = data_folder() / "imagery"
    out.mkdir(parents=True, exist_ok=True)
    results = [run_case(case, plan, imagery, out, progress) for case in plan.cases]
    reports = [result.report for result in results]
    trained = {f"{r['model']} on {r['place']}": training_line(r["trained on"]) for r in reports}
    errors = {} if plan.errors is None else error_model(results)
    speeds: dict[str, Any] = {}
    if plan.speed:
        progress("speed")
        speeds = speed(frame_jpeg(imagery), plan.speed, plan.config)
    bars = speed_bars(speeds)
    for one in reports:
        bars |= case_bars(one)
    report = {
        "evaluation": "segmentation",
        "what is real": REAL,
        "what trained": trained,
        "command": " ".join(["buildloc", *sys.argv[1:]]),
        "seed": plan.seed,
        "quick": plan.quick,
        "how it is counted": RULES,
        **machine(),
        "bars": bars,
        "speed": speeds,
        "error model": {name: asdict(values) for name, values in errors.items()},
        "cases": {f"{r['place']}, {r['model']}": r for r in reports},
    }
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    pictures = [picture for result in results for picture in result.pictures]
    write_report(out / "report.html", "Segmentation of ground never seen", report, pictures)
    if plan.errors is not None:
        # It ships: files by their names, not by where they lay here.
        names = {f"{Path(r['model']).name}, {r['place']}": r["trained on"] for r in reports}
        about = {key: report[key] for key in ("what is real", "seed", "quick", "date")}
        write_errors(plan.errors, about | {"network, place: what trained it": names}, errors)
    lines = [table(reports), *speed_table(speeds), *summary(errors), bar_table(bars)]
    return "\n".join(lines)


COLUMNS = (
    ("pixel_iou", "IoU"), ("pixel_f1", "F1"), ("recall_0.5", "R.5"), ("precision_0.5", "P.5"),
    ("recall_0.3", "R.3"), ("precision_0.3", "P.3"), ("merged", "merged"), ("split", "split"),
    ("missed", "missed"), ("centroid_median_m", "c50_m"), ("centroid_p90_m", "c90_m"),
    ("outline_m", "line_m"), ("false_per_km2", "f/km2"),
)  # fmt: skip


def table(reports: Sequence[dict[str, Any]]) -> str:
    """For people: a row for each scene and way of counting, then the disturbances."""
    head = " ".join(f"{title:>6}" for _, title in COLUMNS)
    lines = [REAL, "", f"{'place, scene':<28} {'':<9} {head}"]

    def row(name: str, kind: str, values: dict[str, Any]) -> str:
        cells = " ".join(
            f"{'-':>6}" if values[key] is None else f"{values[key]:6.{0 if key == 'false_per_km2' else 3}f}"
            for key, _ in COLUMNS
        )
        return f"{name:<28} {kind:<9} {cells}"

    for report in reports:
        lines.append(f"{report['model']}: {training_line(report['trained on'])}")
        groups = report["scenes"] | ({"all": report["all scenes"]} if len(report["scenes"]) > 1 else {})
        for scene, values in groups.items():
            name = f"{report['place']}, {scene}" if scene != report["place"] else scene
            lines += [row(name, kind, values[kind]) for kind in KINDS]
            if values["merged over plain"] is not None:
                lines.append(f"  merged over plain: {values['merged over plain']:.2f}")
        for kind, values in report["disturbed input"].items():
            fall = "" if "falls_by" not in values else f", falls by {values['falls_by']:.3f}"
            lines.append(f"  {kind}: IoU {values['pixel_iou']:.3f}{fall}")
    return "\n".join(lines)
