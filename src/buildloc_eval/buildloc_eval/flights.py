"""A recorded flight through the live nodes, scored against its ground truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from buildloc.records import read_fixes
from buildloc.replay import Replay, ReplayReport, replay
from buildloc.settings import NODES, Settings
from buildloc.timing import Timing
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.reference.database import ReferenceDatabase
from buildloc_matcher.selection import mutual_pairs
from buildloc_msgs_py.types import Fix, FloatArray, NoFix
from pyproj import Transformer

from buildloc_eval.report import FlightScore, fix_table, picture, score
from buildloc_eval.truth import read_truth


@dataclass(frozen=True)
class LiveFlight:
    """What a subscriber of /buildloc/fix received, and how far it was from the truth."""

    results: tuple[Fix | NoFix, ...]
    scored: FlightScore
    report: ReplayReport
    timing: Timing | None
    table: str
    summary: str
    picture: Path


def placed_map(played: Replay, fix: Fix, epsg: int) -> FloatArray:
    """(N, 2) buildings of the latest map, placed in UTM by a fix and the keyframe of its stamp."""
    keyframe = next((k for k in played.keyframes if k.stamp_ns == fix.stamp_ns), None)
    if keyframe is None or played.local_map is None:
        return np.empty((0, 2))
    to_utm = Transformer.from_crs(4326, epsg, always_xy=True)
    east, north = to_utm.transform(fix.longitude_deg, fix.latitude_deg)
    turn = fix.yaw_rad - keyframe.yaw_rad
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    relative = played.local_map.centroids_m - (keyframe.x_m, keyframe.y_m)
    return np.asarray(relative @ rotation.T + (east, north), dtype=np.float64)


def evaluate_live(
    bag: Path, database: ReferenceDatabase, settings: Settings, rate: float, out: Path, title: str
) -> LiveFlight:
    """Replay a bag of `buildloc sim` into the nodes and score what arrived.

    Raises ReplayError, TruthError.
    """
    truth = read_truth(bag)
    for node in NODES:
        settings[node]["use_sim_time"] = True
    received = out / "fixes.jsonl"
    played = replay(bag, settings, rate, out, received)
    results = read_fixes(received)
    scored = score(results, truth)
    observed = matched = np.empty((0, 2))
    if scored.fixes:
        observed = placed_map(played, scored.fixes[-1], database.epsg)
        pairs = mutual_pairs(observed, database.centroids_m, MatcherConfig().mnn_distance_m)
        matched = database.centroids_m[pairs[:, 1]]
    drawn = out / "flight.png"
    picture(drawn, database, truth, scored, observed, matched, title)
    report = played.report
    median = f"{np.median(scored.errors_m):.2f}" if scored.errors_m else "none"
    last = "none" if scored.last_error_m is None else f"{scored.last_error_m:.2f}"
    summary = (
        f"{len(scored.fixes)} fixes received on /buildloc/fix; error in m: median {median}, last {last}, "
        f"largest {max(scored.errors_m, default=math.nan):.2f}; "
        f"{report.images} images, {report.dropped} dropped, "
        f"{report.keyframes} keyframes, {report.maps} maps, {report.maps_skipped} overtaken, "
        f"{report.seconds:.0f} s"
    )
    if played.timing is not None:
        summary += "\n" + played.timing.line()
    table = fix_table(scored, truth)
    return LiveFlight(tuple(results), scored, report, played.timing, table, summary, drawn)
