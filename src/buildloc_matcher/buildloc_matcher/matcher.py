"""From a local map to ranked candidates, and from those to a fix or the reason why there is none."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from buildloc_msgs_py.config import check
from buildloc_msgs_py.types import Candidate, Fix, FrameObservation, Keyframe, LocalMap, NoFix

from buildloc_matcher.acceptance import (
    acceptance_score,
    lead,
    log10_false_alarm,
    refuse_coarse,
    refuse_refined,
)
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.database import DatabaseError, ReferenceDatabase, descriptor_hash
from buildloc_matcher.descriptors import stars
from buildloc_matcher.geometry import Similarity
from buildloc_matcher.hypotheses import hypothesize
from buildloc_matcher.matching import match_stars
from buildloc_matcher.refinement import covariance_enu, refine
from buildloc_matcher.selection import Score, score_candidate
from buildloc_matcher.voting import vote


@dataclass(frozen=True)
class MatchResult:
    """Candidates, best MNN-Jaccard first, with their scores in the same order, and the funnel."""

    candidates: tuple[Candidate, ...]
    scores: tuple[Score, ...]
    funnel: dict[str, float]


@dataclass(frozen=True)
class Answer:
    """A fix or the reason for none, the candidates behind it and the funnel of the solve."""

    result: Fix | NoFix
    candidates: tuple[Candidate, ...]
    funnel: dict[str, float]


class Matcher:
    """Locates local maps in one reference database; holds no state between calls."""

    def __init__(self, database: ReferenceDatabase, config: MatcherConfig) -> None:
        check(config)
        if database.descriptor_hash != descriptor_hash(config):
            raise DatabaseError(
                "reference database was built with another descriptor configuration; "
                "build it again with `buildloc refdb build`"
            )
        self.database = database
        self.config = config

    def locate(self, local_map: LocalMap) -> MatchResult:
        """Ranked candidates of a map; their x, y is where the mean of the map's buildings lies."""
        config, database = self.config, self.database
        started = time.perf_counter()
        large = local_map.areas_m2 >= config.min_area_m2
        points, shapes = local_map.centroids_m[large], local_map.shapes[large]
        funnel: dict[str, float] = {"buildings": len(points)}
        if len(points) < 4:
            return MatchResult((), (), funnel | {"seconds": time.perf_counter() - started})
        centre = points.mean(axis=0)
        query = stars(points, shapes)
        matches = match_stars(query, database.index, config)
        hypotheses = hypothesize(matches, query, points, database.stars, database.centroids_m, centre, config)
        ballot = vote(hypotheses, config)
        scores = []
        for cluster in ballot.clusters[: config.top_k]:
            start = Similarity(
                (float(centre[0]), float(centre[1])),
                (cluster.x_m, cluster.y_m),
                cluster.yaw_rad,
                cluster.scale,
            )
            scores.append(
                (cluster, score_candidate(start, points, database.centroids_m, database.tree, config))
            )
        scores.sort(key=lambda pair: (-pair[1].jaccard, -pair[0].votes))
        ranked = [self._candidate(score, cluster.votes, centre) for cluster, score in scores]
        if ranked:
            ratio = funnel["lead"] = lead(ranked[0], ranked[1:], config)
            first = acceptance_score(ranked[0].mnn_jaccard, ratio, config)
            funnel["log10_false_alarm"] = log10_false_alarm(scores[0][1], database.area_m2, config)
            ranked[0] = replace(ranked[0], acceptance=first)
        funnel |= {
            "query_stars": len(query),
            "reference_stars": len(database.stars),
            "compatible": matches.compatible,
            "matches": len(matches),
            "mirrored": hypotheses.mirrored,
            "off_scale": hypotheses.off_scale,
            "hypotheses": len(hypotheses),
            "bins": ballot.bins,
            "inconsistent_bins": ballot.inconsistent,
            "clusters": len(ballot.clusters),
            "rescored": len(ranked),
            "seconds": time.perf_counter() - started,
        }
        return MatchResult(tuple(ranked), tuple(score for _, score in scores), funnel)

    def _candidate(self, score: Score, votes: float, centre: np.ndarray) -> Candidate:
        place = score.transform.apply(centre[None])[0]
        return Candidate(
            float(place[0]),
            float(place[1]),
            score.transform.yaw_rad,
            score.transform.scale,
            votes,
            score.jaccard,
            min(1.0, score.jaccard / self.config.min_jaccard) if self.config.min_jaccard > 0.0 else 1.0,
        )

    def refuse(self, found: MatchResult) -> str | None:
        """Why the best candidate of a map is not convincing, or None."""
        buildings = found.funnel["buildings"]
        if buildings < self.config.min_buildings:
            return f"map has {buildings:.0f} buildings, fewer than {self.config.min_buildings}"
        if not found.candidates:
            return "no candidate: no place in the reference gathers enough consistent votes"
        best, funnel = found.scores[0], found.funnel
        return refuse_coarse(best, funnel["lead"], funnel["log10_false_alarm"], self.config)

    def fix(
        self, local_map: LocalMap, keyframes: Sequence[Keyframe], observations: Sequence[FrameObservation]
    ) -> Answer:
        """The position of the camera at the last keyframe, or why there is none."""
        found = self.locate(local_map)
        funnel = dict(found.funnel)

        def none(reason: str) -> Answer:
            return Answer(NoFix(local_map.stamp_ns, reason), found.candidates, funnel)

        if not keyframes:
            return none("no keyframes yet")
        refused = self.refuse(found)
        if refused is not None:
            return none(refused)
        refined = refine(
            found.scores[0].transform,
            keyframes,
            observations,
            self.database.centroids_m,
            self.database.tree,
            self.config,
        )
        refused = refuse_refined(refined, self.config)
        if refined is None or refused is not None:
            return none(refused or "refinement failed")
        funnel |= {"refine_observed": refined.observed, "refine_pairs": refined.pairs}
        funnel |= {"refine_buildings": refined.buildings, "refine_rms_m": refined.rms_m}
        last = max(keyframes, key=lambda k: k.stamp_ns)
        altitude = next((o.altitude_m for o in observations if o.stamp_ns == last.stamp_ns), float("nan"))
        east, north = float(refined.position_m[0]), float(refined.position_m[1])
        latitude, longitude = self.database.to_wgs84(east, north)
        covariance = covariance_enu(refined, self.config)
        fix = Fix(last.stamp_ns, latitude, longitude, altitude, east, north, refined.yaw_rad, covariance)
        return Answer(fix, found.candidates, funnel)
