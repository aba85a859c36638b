"""One trial: a flight, what the matcher answers, and how that compares with the truth."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from buildloc_matcher.acceptance import Verdict
from buildloc_matcher.config import MatcherConfig, matcher_config
from buildloc_matcher.matcher import Matcher, MatchResult
from buildloc_matcher.reference.database import ReferenceDatabase
from buildloc_msgs_py.types import Fix, FloatArray, NoFix

from buildloc_eval.integrity.grounds import Grounds
from buildloc_eval.integrity.plan import TOWN_NONE, Place, Plan, Trial, shift_of, streams, trial
from buildloc_eval.observation import Digitiser, sensing, true_place
from buildloc_eval.observed_flight import Flown, ObservedFlight, mirrored, observe_flight, scaled

Record = dict[str, Any]
# Where world and reference are two real sources, nothing is added to how they differ.
NOTHING = Digitiser(0.0, 0.0, 1e-9, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Attempt:
    """A flight against a reference that is shifted by (2,) m against the ground flown over."""

    flight: ObservedFlight
    database: ReferenceDatabase
    shift_m: FloatArray

    @property
    def camera_m(self) -> FloatArray:
        """(2,) true place of the camera at the last keyframe, as the reference would have it."""
        return self.flight.camera_m + self.shift_m

    def true_place(self, at_m: FloatArray) -> FloatArray:
        """The same of a place of the map."""
        mapped = self.flight.local_map.centroids_m
        return true_place(mapped, self.flight.true_m, at_m) + self.shift_m


def other_city(plan: Plan, place: Place) -> Place:
    """The next place of the plan that is in another city."""
    first = plan.places.index(place)
    around = plan.places[first:] + plan.places[:first]
    return next(other for other in around if other.city != place.city)


def attempt(one: Trial, grounds: Grounds) -> Attempt:
    """Fly a trial. Raises ObservationError where its ground has too few buildings."""
    _, rng = streams(grounds.plan, grounds.seed, one.number)
    flown, over = _ground(one, grounds)
    model = sensing(one.level)
    if one.kind == "snow":
        model = replace(model, false=one.amount)
    digitiser = Digitiser() if over.world == over.reference or one.town != TOWN_NONE else NOTHING
    flight = observe_flight(flown, one.buildings, model, rng, digitiser)
    if one.kind == "mirrored":
        flight = mirrored(flight)
    elif one.kind == "scaled":
        flight = scaled(flight, one.amount)
    reference = grounds.reference(one.place, one.radius_km, one.variant)
    return Attempt(flight, reference, shift_of(one, rng))


def _ground(one: Trial, grounds: Grounds) -> tuple[Flown, Place]:
    """What is flown over, and the place that it is of."""
    if one.kind == "outside":
        return grounds.outside(one.place), one.place
    if one.kind == "another city":
        other = other_city(grounds.plan, one.place)
        return grounds.home(other, other.radii_km[-1]), other
    if one.town != TOWN_NONE:
        return grounds.suburb(one.place, one.town), one.place
    return grounds.home(one.place, one.radius_km), one.place


def config_of(one: Trial) -> MatcherConfig:
    """The default preset, which knows how well the reference is registered."""
    return matcher_config({"sigma_registration_m": math.hypot(one.shift_m, one.place.registration_m)})


def run(number: int, grounds: Grounds) -> Record:
    """The trial of a number and all that is kept of it."""
    one = trial(grounds.plan, grounds.seed, number)
    started = time.perf_counter()
    tried = attempt(one, grounds)
    flown, worked = time.perf_counter(), time.process_time()
    matcher, flight = Matcher(tried.database, config_of(one)), tried.flight
    found = matcher.locate(flight.local_map)
    answer = matcher.conclude(found, flight.local_map.stamp_ns, flight.keyframes, flight.observations)
    answered = time.perf_counter()
    record = _told(one, tried)
    record |= {"observe_s": flown - started, "seconds": answered - flown}
    record["cpu_s"] = time.process_time() - worked
    record |= _judged(matcher.judge(found), answer.result)
    errors = _errors(one, found, tried)
    record |= _candidates(found)
    record |= {"candidate_error_m": errors, "best_error_m": errors[0] if errors else math.nan}
    record["search_camera_error_m"] = _camera_error(one, matcher, found, tried)
    record |= {f"funnel.{name}": value for name, value in answer.funnel.items()}
    record |= _fix(one, answer.result, tried)
    if one.paper:
        record |= _paper(one, tried)
    return record


def _told(one: Trial, tried: Attempt) -> Record:
    """What was tried."""
    return {
        "number": one.number, "place": one.place.name, "city": one.place.city, "kind": one.kind,
        "detail": one.detail, "control": one.control, "absent": one.absent, "radius_km": one.radius_km,
        "variant": one.variant, "buildings": one.buildings, "level": one.level, "shift_m": one.shift_m,
        "reference_buildings": len(tried.database), "reference_km2": tried.database.area_m2 / 1e6,
        "path_m": tried.flight.path_m, "keyframes": len(tried.flight.keyframes),
    }  # fmt: skip


def _judged(verdict: Verdict, result: Fix | NoFix) -> Record:
    """What the search was judged to be worth, and whether that became a fix: refinement may refuse."""
    return {
        "outcome": str(verdict.outcome), "score": verdict.score,
        "false_fix_probability": verdict.false_fix_probability, "fixed": isinstance(result, Fix),
        "reason": result.reason if isinstance(result, NoFix) else "",
    }  # fmt: skip


def _candidates(found: MatchResult) -> Record:
    """Figures of the ranked candidates, best first; lists."""
    listed, scores = found.candidates, found.scores
    return {
        "candidate_x_m": [c.x_m for c in listed],
        "candidate_y_m": [c.y_m for c in listed],
        "candidate_yaw_rad": [c.yaw_rad for c in listed],
        "candidate_scale": [c.scale for c in listed],
        "candidate_votes": [c.votes for c in listed],
        "candidate_jaccard": [c.mnn_jaccard for c in listed],
        "candidate_log_odds": [c.acceptance for c in listed],
        "candidate_pairs": [len(s.pairs) for s in scores],
        "candidate_rms_m": [s.rms_m for s in scores],
    }


def _errors(one: Trial, found: MatchResult, tried: Attempt) -> list[float]:
    """How far from the truth each candidate puts the map's middle, m; infinite where no place is right."""
    if one.absent or found.query is None:
        return [math.inf] * len(found.candidates)
    middle = tried.true_place(found.query.points_m.mean(axis=0))
    return [math.hypot(c.x_m - middle[0], c.y_m - middle[1]) for c in found.candidates]


def _camera_error(one: Trial, matcher: Matcher, found: MatchResult, tried: Attempt) -> float:
    """The same of the best candidate and the last camera, which lies at the end of the map, where it may have
    no matches; NaN without a candidate."""
    if one.absent or not found.candidates:
        return math.inf if found.candidates else math.nan
    last = tried.flight.keyframes[-1]
    at = np.array([last.x_m, last.y_m])
    return math.hypot(*(matcher.place(found, at).apply(at[None])[0] - tried.camera_m))


def _fix(one: Trial, result: Fix | NoFix, tried: Attempt) -> Record:
    """Error of a fix, its covariance and normalised error squared; NaN without one."""
    if isinstance(result, NoFix):
        names = ("fix_error_m", "east_error_m", "north_error_m", "var_east_m2", "var_north_m2",
                 "cov_east_north_m2", "nees", "yaw_error_rad")  # fmt: skip
        return dict.fromkeys(names, math.nan)
    error = np.array([result.easting_m, result.northing_m]) - tried.camera_m
    covariance = result.covariance_enu_m2[:2, :2]
    turn = result.yaw_rad - tried.flight.yaw_rad
    return {
        "fix_error_m": math.inf if one.absent else math.hypot(*error),
        "east_error_m": error[0], "north_error_m": error[1],
        "var_east_m2": covariance[0, 0], "var_north_m2": covariance[1, 1],
        "cov_east_north_m2": covariance[0, 1],
        "nees": float(error @ np.linalg.solve(covariance, error)),
        "yaw_error_rad": math.atan2(math.sin(turn), math.cos(turn)),
    }  # fmt: skip


def paper_config() -> MatcherConfig:
    """The paper's preset."""
    return matcher_config({"preset": "paper"})


def _paper(one: Trial, tried: Attempt) -> Record:
    """The paper's argmax on the same map: its first candidate, whatever it is worth."""
    started = time.perf_counter()
    matcher = Matcher(tried.database, paper_config())
    found = matcher.locate(tried.flight.local_map)
    errors = _errors(one, found, tried)
    return {
        "paper_answers": len(errors) > 0,
        "paper_jaccard": found.candidates[0].mnn_jaccard if errors else math.nan,
        "paper_error_m": errors[0] if errors else math.nan,
        "paper_s": time.perf_counter() - started,
    }
