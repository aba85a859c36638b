"""Real imagery end to end: flights over the Barnarp orthophoto against tens of thousands of footprints.

Two flights of 2 km. East half, with the baseline network that was trained on the west half among others;
and the whole orthophoto, with the network that is shipped, which never saw Barnarp. Both networks are
scored on ground they never saw.
"""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from buildloc.bag import read_frames
from buildloc.settings import MAPPER, REFERENCE_DB, SEGMENTER, Settings, config_of, load, matcher_config_of
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.mapper import Mapper, MapUpdate
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.geometry import Similarity, fit_rigid
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.reference.build import build
from buildloc_matcher.reference.database import ReferenceDatabase, open_database
from buildloc_msgs_py.types import ByteArray, Fix, FloatArray, Frame
from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.segmenter import Segmenter

from buildloc_eval.bars import Bar, bar_table, judge
from buildloc_eval.camera import look
from buildloc_eval.flight import FlightConfig, fly
from buildloc_eval.flights import LiveFlight, evaluate_live
from buildloc_eval.html import write_report
from buildloc_eval.machine import machine
from buildloc_eval.realworld import Ground, data_folder, place_barnarp
from buildloc_eval.sim import write_flight
from buildloc_eval.truth import Truth, read_truth
from buildloc_eval.world import OrthoWorld

RATE = 1.0  # rate and latency of fixes are measured
FLIGHT = FlightConfig(
    length_m=2000.0, leg_m=420.0, spacing_m=80.0, speed_mps=5.0, altitude_swing_m=5.0, rate_hz=8.0
)
EAST_HALF = 4096 / 8704
WIDE = dataclasses.replace(FLIGHT, leg_m=900.0)
QUICK_LENGTH_M = 700.0
BASELINE = "models/baseline_west.onnx"
NEAR_BIN_M = 150.0  # the true 100 m bin and its eight neighbours
FOUND_M = 5.0
WRONG_M = 100.0
BARS = [
    bar
    for flight in ("east_baseline", "all_shipped")
    for bar in (
        Bar(flight, "timing.fixes_per_second", 5.0, at_least=True),
        Bar(flight, "timing.latency_p95_s", 0.3),
        Bar(flight, "wrong_fixes", 0),
        Bar(flight, "median_error_m", 3.0),
    )
]


@dataclass(frozen=True)
class Case:
    """One flight: the part of the orthophoto it crosses, from the west edge, and the network's settings."""

    name: str
    title: str
    west_fraction: float
    flight: FlightConfig
    overrides: tuple[str, ...]


def cases(data: Path) -> tuple[Case, ...]:
    """The two flights of the evaluation."""
    baseline = (f"{SEGMENTER}.model={data / BASELINE}", f"{SEGMENTER}.output=probability")
    return (
        Case(
            "east_baseline", "east half, baseline network (trained on the west half)", EAST_HALF, FLIGHT,
            baseline,
        ),
        Case("all_shipped", "whole orthophoto, shipped network (never saw Barnarp)", 0.0, WIDE, ()),
    )  # fmt: skip


def make_bag(case: Case, ground: Ground, bag: Path, seed: int) -> None:
    """Cut the flight out of the orthophoto."""
    world = OrthoWorld(ground.ortho, ground.georef)
    west, south, east, north = world.bounds_m
    box = (west + case.west_fraction * (east - west), south, east, north)
    write_flight(bag, world, fly(box, case.flight, seed), case.flight, seed, lambda done, total: None)


def _label_mask(labels: OrthoWorld, frame: Frame, truth: Truth) -> ByteArray:
    """True building mask of a frame: the labels photographed from the same place, without noise."""
    pose = truth.poses[frame.stamp_ns]
    place = (pose.x_m, pose.y_m, pose.altitude_m, pose.yaw_rad)
    seen = look(labels, frame.camera, place, frame.attitude_xyzw)
    return np.asarray(seen[:, :, 0] > 127, dtype=np.uint8)


def _map_to_world(update: MapUpdate, truth: Truth) -> Similarity:
    """The rigid transform that truth alone gives the map: its keyframes onto their true positions."""
    places = np.array([(k.x_m, k.y_m) for k in update.keyframes])
    true = np.array([(truth.poses[k.stamp_ns].x_m, truth.poses[k.stamp_ns].y_m) for k in update.keyframes])
    return fit_rigid(places, true)


def offline_scores(
    bag: Path, ground: Ground, data: Path, database: ReferenceDatabase, settings: Settings
) -> dict[str, Any]:
    """How good masks and map are, and where the true place ranks, on the same bag without ROS."""
    truth = read_truth(bag)
    labels = OrthoWorld(data / "imagery" / "barnarp" / "labels.png", ground.georef)
    segmenter = Segmenter(config_of(settings, SEGMENTER, SegmenterConfig))
    mapper = Mapper(config_of(settings, MAPPER, MapperConfig))
    config = matcher_config_of(settings)
    counts = np.zeros(3)
    update: MapUpdate | None = None
    for frame in read_frames(bag):
        if not isinstance(frame, Frame):
            continue
        mask = segmenter.process(frame)
        if mask is None:
            continue
        true, found = _label_mask(labels, frame, truth) > 0, mask.pixels > 0
        counts += ((found & true).sum(), (found & ~true).sum(), (~found & true).sum())
        update = mapper.add(frame, mask) or update
    if update is None:
        return {"keyframes": 0}
    placed = _map_to_world(update, truth)
    seen = update.local_map.select(~update.local_map.cut)
    map_m = placed.apply(seen.centroids_m)
    true_m = _true_buildings(labels, update, seen.centroids_m, placed, config.min_area_m2)
    to_true = np.linalg.norm(map_m[:, None] - true_m[None], axis=2)
    matched = Matcher(database, config).locate(seen)
    centre = placed.apply(seen.centroids_m[seen.areas_m2 >= config.min_area_m2]).mean(axis=0)
    ranks = [
        rank
        for rank, c in enumerate(matched.candidates, start=1)
        if math.hypot(c.x_m - centre[0], c.y_m - centre[1]) <= NEAR_BIN_M
    ]
    tp, fp, fn = counts
    residual = placed.apply(np.array([(k.x_m, k.y_m) for k in update.keyframes])) - np.array(
        [(truth.poses[k.stamp_ns].x_m, truth.poses[k.stamp_ns].y_m) for k in update.keyframes]
    )
    return {
        "keyframes": len(update.keyframes),
        "mask_iou": float(tp / (tp + fp + fn)),
        "mask_precision": float(tp / (tp + fp)),
        "mask_recall": float(tp / (tp + fn)),
        "trajectory_rmse_m": float(np.sqrt((residual**2).sum(axis=1).mean())),
        "map_buildings": len(seen),
        "true_buildings_in_view": len(true_m),
        "buildings_found": int((to_true.min(axis=0) <= FOUND_M).sum()) if to_true.size else 0,
        "map_buildings_true": int((to_true.min(axis=1) <= FOUND_M).sum()) if to_true.size else 0,
        "rank_of_true_bin": ranks[0] if ranks else None,
        "candidates_ranked": len(matched.candidates),
        "best_mnn_jaccard": matched.candidates[0].mnn_jaccard if matched.candidates else None,
        "match_seconds": sum(matched.seconds.values()),
    }


def _true_buildings(
    labels: OrthoWorld, update: MapUpdate, map_m: FloatArray, placed: Similarity, min_area_m2: float
) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(N, 2) centroids of labelled buildings within the hull of the map's keyframes and buildings."""
    window = labels.window(labels.bounds_m)
    mask = (window.image_bgr[:, :, 0] > 127).astype(np.uint8)
    _, _, stats, centroids = cv2.connectedComponentsWithStats(mask, connectivity=8)
    large = stats[1:, cv2.CC_STAT_AREA] * window.gsd_m**2 >= min_area_m2
    pixels = centroids[1:][large]
    metres = np.array([window.left_m, window.top_m]) + (pixels + 0.5) * [window.gsd_m, -window.gsd_m]
    seen = np.vstack([map_m, [(k.x_m, k.y_m) for k in update.keyframes]])
    hull = cv2.convexHull(placed.apply(seen).astype(np.float32))
    inside = [cv2.pointPolygonTest(hull, (float(x), float(y)), False) >= 0 for x, y in metres]
    return np.asarray(metres[np.array(inside, dtype=bool)], dtype=np.float64)


def fly_live(
    case: Case,
    ground: Ground,
    database: ReferenceDatabase,
    database_path: Path,
    folder: Path,
    seed: int,
    rate: float,
) -> LiveFlight:
    """Bag and live nodes of one flight, at a speed relative to the recording; ``folder`` takes what they
    write."""
    folder.mkdir(parents=True, exist_ok=True)
    bag = folder / "bag"
    make_bag(case, ground, bag, seed)
    settings = load(None, case.overrides)
    settings[REFERENCE_DB]["database"] = str(database_path.resolve())
    return evaluate_live(bag, database, settings, rate, folder, f"Barnarp (real imagery): {case.title}")


def run_case(
    case: Case,
    ground: Ground,
    data: Path,
    database: ReferenceDatabase,
    database_path: Path,
    out: Path,
    seed: int,
) -> tuple[dict[str, Any], LiveFlight]:
    """Bag, live nodes, offline scores of one flight."""
    folder = out / case.name
    live = fly_live(case, ground, database, database_path, folder, seed, RATE)
    offline = offline_scores(folder / "bag", ground, data, database, load(None, case.overrides))
    accepted = [r for r in live.results if isinstance(r, Fix)]
    figures = {
        "title": case.title,
        "fixes": len(accepted),
        "last_error_m": live.scored.last_error_m,
        "median_error_m": float(np.median(live.scored.errors_m)) if accepted else None,
        "p95_error_m": float(np.percentile(live.scored.errors_m, 95.0)) if accepted else None,
        "largest_error_m": max(live.scored.errors_m, default=None),
        "wrong_fixes": sum(error > WRONG_M for error in live.scored.errors_m),
        "share_within_95_percent_ellipse": live.scored.covered,
        "timing": None if live.timing is None else dataclasses.asdict(live.timing),
        "replay": dataclasses.asdict(live.report),
        **offline,
    }
    return figures, live


def evaluate(out: Path, seed: int, quick: bool) -> str:
    """Run the flights, write report.json and report.html; the summary."""
    data = data_folder()
    out.mkdir(parents=True, exist_ok=True)
    ground = place_barnarp(data, out)
    database_path = out / "reference.bldb"
    build([ground.footprints], database_path, MatcherConfig())
    database = open_database(database_path, MatcherConfig())
    results: dict[str, Any] = {}
    pictures: list[tuple[str, Path]] = []
    flown = cases(data)
    if quick:
        flight = dataclasses.replace(flown[0].flight, length_m=QUICK_LENGTH_M)
        flown = (dataclasses.replace(flown[0], flight=flight),)
    for case in flown:
        results[case.name], live = run_case(case, ground, data, database, database_path, out, seed)
        pictures.append((case.title, live.picture))
    judged = judge(BARS, results)
    report = {
        "evaluation": "barnarp",
        "imagery": "real (orthophoto), flights simulated over it",
        "bars": judged,
        "reference_buildings": len(database),
        "seed": seed,
        **machine(),
        "flights": results,
    }
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    write_report(out / "report.html", "Barnarp: real imagery through the whole method", report, pictures)
    return f"{json.dumps(results, indent=2)}\n\n{bar_table(judged)}\n{out / 'report.html'}"
