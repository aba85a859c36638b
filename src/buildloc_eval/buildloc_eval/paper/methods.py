"""The methods compared, each from maps to ranked places. None of them sees the truth."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from buildloc_matcher.acceptance import refuse_refined
from buildloc_matcher.config import matcher_config
from buildloc_matcher.match_start import start_of
from buildloc_matcher.matcher import Matcher, MatchResult
from buildloc_matcher.reference.buildings import Buildings
from buildloc_matcher.reference.database import ReferenceDatabase, assemble
from buildloc_matcher.refinement import Refined, refine
from buildloc_matcher.window import frames_kept
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import Fix, FloatArray, FrameObservation, NoFix
from numpy.typing import NDArray

from buildloc_eval.generators import method
from buildloc_eval.paper import brm
from buildloc_eval.paper.flights import EPSG
from buildloc_eval.paper.flown import Maps, Snapshot

# How the method is called here -> in generators. The second is the paper's "Ours".
STARS = {
    "default preset": "default",
    "paper preset": "paper",
    "without shape": "shape-free 8-D",
}
BRM = "BRM"
METHODS = (BRM, *reversed(STARS))
# What stands in the paper's table where these stand in ours.
PUBLISHED = {
    "default preset": "ours",
    "paper preset": "ours",
    "without shape": "ours without shape",
    BRM: BRM,
}
LISTED = 2000  # bins of a ranking that are kept
KEPT = 10  # places


@dataclass(frozen=True)
class Prediction:
    """A ranking: the first places (K, 2), where ``centre_m`` of the map lies, or the last camera where that
    is None; the yaw and scale (K, 2) of the map there; the voting bins (B, 2) in their order, LISTED at most;
    the refined place of the last camera, or None; why it is no fix, None where it is one; seconds per stage
    and the funnel."""

    places_m: FloatArray
    turns: FloatArray
    centre_m: FloatArray | None
    bins: NDArray[np.int32]
    final_m: FloatArray | None
    refused: str | None
    seconds: Mapping[str, float]
    funnel: Mapping[str, float]


def nothing(reason: str) -> Prediction:
    """No place."""
    none = np.empty((0, 2))
    return Prediction(none, none, None, none.astype(np.int32), None, reason, {}, {})


def reference_within(
    buildings: Buildings, centre_m: FloatArray, radius_km: float, epsg: int = EPSG
) -> ReferenceDatabase:
    """The database of a search radius, in memory."""
    inside = np.hypot(*(buildings.centroids_m - centre_m).T) <= 1000.0 * radius_km
    return assemble(epsg, buildings.select(inside), matcher_config())


def make_matcher(name: str, database: ReferenceDatabase) -> Matcher:
    """A method that matches stars, warm."""
    matcher = method(STARS[name], database)
    matcher.warm_up()
    return matcher


def ranked_bins(found: MatchResult, bin_m: float) -> NDArray[np.int32]:
    """(B, 2) bins as the method ranks them: those of its candidates, then all others by their votes."""
    places = np.concatenate(
        [np.array([[c.x_m, c.y_m] for c in found.candidates]).reshape(-1, 2), found.voted_m]
    )
    bins = np.round(places / bin_m).astype(np.int32)
    _, first = np.unique(bins, axis=0, return_index=True)
    return bins[np.sort(first)[:LISTED]]


def locate(matcher: Matcher, maps: Maps, keyframes: int, final: bool) -> Prediction:
    """The ranking after so many keyframes and whether it is a fix, with the refined place of the last one if
    ``final``."""
    snapshot = maps.snapshots[keyframes - 1]
    if snapshot is None:
        return nothing("no keyframe is mapped yet")
    try:
        found = matcher.locate(snapshot.local_map)
    except BuildlocError as error:
        return nothing(str(error))
    ranked = ranking(matcher, found)
    if not found.candidates:
        return ranked
    seen = maps.observations[:keyframes][-frames_kept(matcher.config) :]
    started = time.perf_counter()
    answer = matcher.conclude(found, snapshot.local_map.stamp_ns, snapshot.keyframes, seen).result
    ranked = replace(ranked, refused=answer.reason if isinstance(answer, NoFix) else None)
    if not final:
        return ranked
    refined = _unaccepted(matcher, found, snapshot, seen) if isinstance(answer, NoFix) else _place_m(answer)
    seconds = {**ranked.seconds, "refine": time.perf_counter() - started}
    return replace(ranked, final_m=refined, seconds=seconds)


def ranking(matcher: Matcher, found: MatchResult) -> Prediction:
    """What a matcher has found, without a refined place."""
    if found.query is None:
        return nothing("map has fewer than four buildings")
    kept = np.array([[c.x_m, c.y_m, c.yaw_rad, c.scale] for c in found.candidates[:KEPT]]).reshape(-1, 4)
    centre, bins = found.query.points_m.mean(axis=0), ranked_bins(found, matcher.config.bin_size_m)
    refused, seconds = matcher.judge(found).reason, dict(found.seconds)
    return Prediction(kept[:, :2], kept[:, 2:], centre, bins, None, refused, seconds, found.funnel)


def _unaccepted(
    matcher: Matcher, found: MatchResult, snapshot: Snapshot, seen: Sequence[FrameObservation]
) -> FloatArray:
    """Where the last camera would be if the best candidate were accepted: refined, or where the match has it
    when the refinement finds too few buildings or no single optimum."""
    assert found.query is not None
    ground, config = matcher.database.ground, matcher.config
    begun = start_of(found.scores[0], found.query, snapshot.keyframes, ground, config)
    refined = refine(begun, seen, ground, config)
    if isinstance(refined, Refined) and refuse_refined(refined, config) is None:
        return refined.position_m
    return begun.state.poses[-1, :2]


def _place_m(fix: Fix) -> FloatArray:
    return np.array([fix.easting_m, fix.northing_m])


def brm_survivors(reference: brm.RatioMap, maps: Maps) -> tuple[brm.Survivors, float]:
    """What BRM makes of a whole flight, and its seconds; the odometry is the mapper's."""
    started = time.perf_counter()
    snapshot = maps.snapshots[-1]
    if snapshot is None:
        return brm.Survivors(np.empty((0, 2)), np.empty(0)), 0.0
    path = np.array([[k.x_m, k.y_m] for k in snapshot.keyframes])
    used = brm.used_keyframes(path)
    ratios = maps.ratios[np.array(snapshot.numbers)[used]]
    return brm.search(reference, ratios, path[used]), time.perf_counter() - started


def brm_prediction(
    found: brm.Survivors, seconds: float, centre_m: FloatArray, radius_km: float
) -> Prediction:
    """Hypotheses of the largest radius are independent: those of a smaller one are those inside."""
    places = found.ranked(centre_m, 1000.0 * radius_km)
    return Prediction(
        places, np.full_like(places, np.nan), None, np.empty((0, 2), np.int32), None,
        "BRM has no measure of acceptance" if len(places) else "no hypothesis survives",
        {"search": seconds}, {"survivors": float(len(found.residuals))},
    )  # fmt: skip
