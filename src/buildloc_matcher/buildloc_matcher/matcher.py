"""From a local map to ranked candidates, and from those to a fix or the reason why there is none."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from buildloc_msgs_py.types import Candidate, Fix, FloatArray, FrameObservation, Keyframe, LocalMap, NoFix
from numpy.typing import NDArray

from buildloc_matcher.acceptance import Outcome, Verdict, judge_candidate, lead, log_odds, score
from buildloc_matcher.acquisition import NotAcquired, acquire
from buildloc_matcher.config import MatcherConfig, check_matcher
from buildloc_matcher.evidence import LEAST_AREA_M2, QueryMap, query_map, seed_evidence
from buildloc_matcher.follow import Followed, follow
from buildloc_matcher.geometry import Similarity, wrap
from buildloc_matcher.growth import grown_nats
from buildloc_matcher.hypotheses import Hypotheses, hypothesize
from buildloc_matcher.local_map import check_map
from buildloc_matcher.match_cache import MakeStarMatcher, MatchCache, StarMatcher
from buildloc_matcher.mesh import Mesh, mesh
from buildloc_matcher.pairs import pair_hypotheses
from buildloc_matcher.pursuit import Agreement, Place
from buildloc_matcher.reference.buildings import OUTLINE_UNIT_M
from buildloc_matcher.reference.database import DatabaseError, ReferenceDatabase, descriptor_hash
from buildloc_matcher.refinement import covariance_enu, refine
from buildloc_matcher.reseeding import reseeded
from buildloc_matcher.selection import Score, local_transform, pieces_of_one, select
from buildloc_matcher.voting import Cluster, vote
from buildloc_matcher.window import start

FEWEST_BUILDINGS = 4
WARM_UP_BUILDINGS = 40
MOST_GROWN = 400_000  # buildings of the matches that grow from hypotheses in a look, and of those laid anew
SPARSE = 100  # buildings; a map of more has stars enough
BEYOND_DOUBT = 600.0
MOST_STARS = 4096  # of one look; those of a map of 100,000 buildings, matched, would fill 30 GB


@dataclass(frozen=True)
class MatchResult:
    """Candidates, best first, with their scores in the same order; those of them that contradict the best;
    the places (C, 2) m of all bins with consistent votes, most votes first; the funnel counts what came of
    the stars, and ``seconds`` tells how long each stage took."""

    candidates: tuple[Candidate, ...]
    scores: tuple[Score, ...]
    rivals: tuple[Candidate, ...]
    voted_m: FloatArray
    query: QueryMap | None
    funnel: dict[str, float]
    seconds: dict[str, float]


@dataclass(frozen=True)
class Answer:
    """A fix or the reason for none, the candidates behind it and the funnel of the solve; what the
    reference agrees to, if it does."""

    result: Fix | NoFix
    candidates: tuple[Candidate, ...]
    funnel: dict[str, float]
    agreement: Agreement | None = None


@dataclass(frozen=True)
class _Look:
    """How a look at the map makes its stars, and the matches it remembers."""

    thinnings: int
    max_stars: int
    places: int
    star_matcher: StarMatcher


def _likelihoods(nats: FloatArray) -> FloatArray:
    """Votes of evidence above 0; what is beyond all doubt ties, since larger numbers overflow."""
    return np.where(nats > 0.0, np.exp(np.minimum(nats, BEYOND_DOUBT)), 0.0)


class _Clock:
    """Adds up the seconds of named stages."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started


class Matcher:
    """Locates local maps in one reference database; ``star_matcher`` makes what finds candidates in it.

    Between calls it keeps the matches of stars only: an answer depends on the map alone.
    """

    def __init__(
        self, database: ReferenceDatabase, config: MatcherConfig, star_matcher: MakeStarMatcher = MatchCache
    ) -> None:
        check_matcher(config)
        if database.descriptor_hash != descriptor_hash(config):
            raise DatabaseError(
                "reference database was built with another descriptor configuration; "
                "build it again with `buildloc refdb build`"
            )
        self.database = database
        self.config = config
        second = replace(config, matches_per_star=config.second_look_matches)
        self._looks = [_Look(0, config.max_stars or MOST_STARS, 0, star_matcher(database.tables, config))]
        if config.second_look:
            self._looks.append(
                _Look(
                    config.second_look,
                    MOST_STARS,
                    config.second_look_places,
                    star_matcher(database.tables, second),
                )
            )

    def warm_up(self) -> None:
        """Locate and refine a piece of the reference itself: compiled code is loaded, and on a new machine
        compiled (a quarter of a minute), before the flight and not in it."""
        buildings = self.database.buildings
        apart = np.sum((buildings.centroids_m - buildings.centroids_m[0]) ** 2, axis=1)
        some = buildings.select(np.argsort(apart)[:WARM_UP_BUILDINGS])
        ids = np.arange(len(some), dtype=np.int64)
        areas, shapes = some.areas_m2.astype(np.float64), some.shapes.astype(np.float64)
        self.locate(LocalMap.whole(0, ids, some.centroids_m, areas, shapes, np.ones_like(ids)))
        if self.config.second_look and len(some) >= FEWEST_BUILDINGS:  # hardly asked for by that first look
            query = query_map(some.centroids_m, areas, self.config)
            pair_hypotheses(query, self.database.ground, self.config.second_look_places, self.config)
        level = some.centroids_m - buildings.centroids_m[0]
        outlines = None if some.outlines is None else level[:, None] + OUTLINE_UNIT_M * some.outlines
        here = Similarity((0.0, 0.0), (buildings.centroids_m[0, 0], buildings.centroids_m[0, 1]), 0.0)
        seen = FrameObservation(0, level, 100.0, outlines)
        begun = start(here, [Keyframe(0, 0.0, 0.0, 0.0)], self.config)
        refine(begun, [seen], self.database.ground, self.config)

    def locate(self, local_map: LocalMap) -> MatchResult:
        """Ranked candidates of a map; their x, y is where the mean of the map's buildings lies.

        Buildings that are cut by the border of the seen area have neither their place nor their shape yet,
        and are left out. Raises MapError for a map that no flight makes.
        """
        check_map(local_map)
        config, clock = self.config, _Clock()
        usable = (local_map.areas_m2 >= max(config.min_area_m2, LEAST_AREA_M2)) & ~local_map.cut
        points, areas, shapes = (
            local_map.centroids_m[usable],
            local_map.areas_m2[usable],
            local_map.shapes[usable],
        )
        if len(points) < FEWEST_BUILDINGS:
            return MatchResult((), (), (), np.empty((0, 2)), None, {"buildings": len(points)}, clock.seconds)
        query = query_map(points, areas, config)
        for number, look in enumerate(self._looks, start=1):
            with clock.stage("describe"):
                found = mesh(points, areas, shapes, look.thinnings, look.max_stars)
            result = self._look(found, look, query, clock)
            result = replace(result, funnel=result.funnel | {"buildings": len(points), "looks": number})
            if self.judge(result).outcome is Outcome.ACCEPTED:
                break
        return result

    def _look(self, found: Mesh, look: _Look, query: QueryMap, clock: _Clock) -> MatchResult:
        """Once from stars to ranked candidates."""
        config, reference, star_matcher = self.config, self.database.ground, look.star_matcher
        centre = query.points_m.mean(axis=0)
        with clock.stage("match"):
            matches = star_matcher.match(found.stars)
        with clock.stage("hypothesize"):
            hypotheses = hypothesize(matches, found.corners, query.points_m, self.database, centre, config)
        with clock.stage("vote"):
            voters, corners = hypotheses, found.corners
            if config.votes == "evidence":
                voters, corners = self._weighed(hypotheses, corners, query, look.places)
            ballot = vote(voters, config)
        with clock.stage("select"):
            selected = select(ballot, voters, corners, query, reference, config)
            candidates = tuple(self._candidate(c, score, centre, query) for c, score in selected)
        funnel: dict[str, float] = {
            "stars": len(found.stars),
            "stars_matched_anew": star_matcher.matched_anew,
            "pairs_tested": matches.tested,
            "pairs_passed": matches.passed,
            "matches": len(matches),
            "mirrored": hypotheses.mirrored,
            "off_scale": hypotheses.off_scale,
            "hypotheses": len(hypotheses),
            "voters": len(voters),
            "bins": ballot.bins,
            "clusters": ballot.consistent,
            "rescored": len(ballot.clusters),
        }
        scores = tuple(found for _, found in selected)
        others = zip(candidates[1:], scores[1:], strict=True)
        rivals = tuple(one for one, found in others if not pieces_of_one(scores[0], found, query, config))
        if candidates:
            funnel["lead"] = lead(candidates[0], rivals, config)
            funnel["log_odds"] = candidates[0].acceptance
            funnel["score"] = score(candidates[0], rivals, config)
        return MatchResult(candidates, scores, rivals, ballot.places_m, query, funnel, clock.seconds)

    def _weighed(
        self, hypotheses: Hypotheses, corners: NDArray[np.int64], query: QueryMap, places: int
    ) -> tuple[Hypotheses, NDArray[np.int64]]:
        """Hypotheses that vote with the likelihood of the match that grows from each, and the map's corners
        that they number: those given with stars (S, 3), those of pairs tried in so many places, and those
        laid anew around the likeliest."""
        config, reference = self.config, self.database.ground
        nats = seed_evidence(query, corners, hypotheses.stars, hypotheses.places_m, reference, config)
        voters = hypotheses.weighted(_likelihoods(nats))
        if places and len(query.points_m) <= SPARSE:
            ends, paired = pair_hypotheses(query, reference, places, config)
            voters, corners = voters.joined(paired, len(corners)), np.concatenate([corners, ends])
        voters = voters.heaviest(max(config.top_k, MOST_GROWN // len(query.points_m)))
        nats = grown_nats(query, corners[voters.stars], voters.places_m, reference, config)
        voters = voters.weighted(_likelihoods(nats))
        ends, anew = reseeded(voters, query, reference, MOST_GROWN // len(query.points_m), config)
        nats = grown_nats(query, ends, anew.places_m, reference, config)
        voters = voters.joined(anew.weighted(_likelihoods(nats)), len(corners))
        return voters, np.concatenate([corners, ends])

    def _candidate(self, cluster: Cluster, score: Score, centre: FloatArray, query: QueryMap) -> Candidate:
        near = local_transform(score, centre, query, self.database.ground, self.config)
        place = near.apply(centre[None])[0]
        odds = log_odds(score.evidence, self.database.area_m2, self.config)
        # Likelihoods are summed as votes and told as a logarithm.
        votes = math.log(cluster.votes) if self.config.votes == "evidence" else cluster.votes
        x, y = float(place[0]), float(place[1])
        return Candidate(x, y, near.yaw_rad, near.scale, votes, score.jaccard, odds)

    def judge(self, found: MatchResult) -> Verdict:
        """Whether the best candidate of a map is convincing, and why not."""
        buildings = found.funnel["buildings"]
        few = f"map has {buildings:.0f} buildings, fewer than {self.config.min_buildings}"
        if buildings < self.config.min_buildings:
            return Verdict(Outcome.UNDECIDED, f"{Outcome.UNDECIDED}: {few}", -math.inf, 1.0)
        if not found.candidates:
            nowhere = "no candidate: no place in the reference gathers enough consistent votes"
            return Verdict(Outcome.REJECTED, f"{Outcome.REJECTED}: {nowhere}", -math.inf, 1.0)
        return judge_candidate(found.candidates[0], found.rivals, found.scores[0], self.config)

    def place(self, found: MatchResult, at_m: FloatArray) -> Similarity:
        """The best candidate's similarity map -> world around a point (2,) of the map."""
        assert found.query is not None
        return local_transform(found.scores[0], at_m, found.query, self.database.ground, self.config)

    def fix(
        self, local_map: LocalMap, keyframes: Sequence[Keyframe], observations: Sequence[FrameObservation]
    ) -> Answer:
        """The position of the camera at the last keyframe, or why there is none."""
        return self.conclude(self.locate(local_map), local_map.stamp_ns, keyframes, observations)

    def conclude(
        self,
        found: MatchResult,
        stamp_ns: int,
        keyframes: Sequence[Keyframe],
        observations: Sequence[FrameObservation],
    ) -> Answer:
        """What a search of the map of this stamp has found comes to: a fix, or the reason for none."""
        funnel = found.funnel | {f"{stage}_seconds": seconds for stage, seconds in found.seconds.items()}

        def none(reason: str) -> Answer:
            return Answer(NoFix(stamp_ns, reason), found.candidates, funnel)

        if not keyframes:
            return none("no keyframes yet")
        verdict = self.judge(found)
        if verdict.reason is not None:
            return none(verdict.reason)
        assert found.query is not None
        acquired = acquire(
            found.scores[0], found.query, keyframes, observations, self.database.ground, self.config
        )
        funnel |= acquired.figures
        if isinstance(acquired, NotAcquired):
            return none(acquired.reason)
        place, agreement = acquired.place, acquired.agreement
        altitude = next((o.altitude_m for o in observations if o.stamp_ns == place.stamp_ns), float("nan"))
        return Answer(self.fix_at(place, altitude), found.candidates, funnel, agreement)

    def fix_at(self, place: Place, altitude_m: float) -> Fix:
        """The fix of a camera at a place."""
        latitude, longitude = self.database.to_wgs84(place.x_m, place.y_m)
        covariance = covariance_enu(place.covariance, self.config)
        return Fix(
            place.stamp_ns, latitude, longitude, altitude_m, place.x_m, place.y_m,
            float(wrap(place.yaw_rad)), covariance, float(place.covariance[2, 2]),
        )  # fmt: skip

    def follow(
        self,
        predicted: Similarity,
        covariance: FloatArray,
        keyframes: Sequence[Keyframe],
        observations: Sequence[FrameObservation],
        unanswered: int = 0,
    ) -> Followed:
        """Whether the reference agrees that the last keyframe lies where ``predicted`` (map -> world) puts
        it, up to a covariance (3, 3) over east, north and yaw, the reference's registration included; after
        so many keyframes without an agreement."""
        reference = self.database.ground
        return follow(predicted, covariance, keyframes, observations, reference, self.config, unanswered)
