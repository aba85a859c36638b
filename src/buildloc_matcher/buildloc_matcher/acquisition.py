"""From the best candidate of a map to the place of its last keyframe: where the reference agrees, and on from
there.

A match grows from house to house and may end, or leave the true houses, before the flight does. So the
reference is asked at the end of the flight, then where matched buildings lie, from where the flight is
followed to its end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FrameObservation, Keyframe

from buildloc_matcher.acceptance import Outcome, refuse_refined
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import Ground, QueryMap
from buildloc_matcher.follow import SIGMAS, Opinion, ask, follow, seen_in_world
from buildloc_matcher.match_start import ends, start_of
from buildloc_matcher.pursuit import Agreement, Mode, Place, Pursuit, agree, carry, prediction
from buildloc_matcher.refinement import MOST_RIVAL_M, RIVAL_M, Unrefined, refine
from buildloc_matcher.selection import Score
from buildloc_matcher.window import frames_kept, newest


@dataclass(frozen=True)
class Acquired:
    """The place of a flight's last keyframe, the latest agreement on the way there, and the figures of the
    piece of the flight where the reference agreed first."""

    place: Place
    agreement: Agreement
    figures: dict[str, float]


@dataclass(frozen=True)
class NotAcquired:
    """Why no piece of the flight gave a place, and the figures of the whole flight, which was asked first."""

    reason: str
    figures: dict[str, float]


@dataclass(frozen=True)
class _Refusal:
    """Why a piece of the flight gave no place, and whether the reference spoke against it."""

    reason: str
    contradicted: bool = False


def acquire(
    score: Score,
    query: QueryMap,
    keyframes: Sequence[Keyframe],
    observations: Sequence[FrameObservation],
    reference: Ground,
    config: MatcherConfig,
) -> Acquired | NotAcquired:
    """The place of the last of some keyframes, at least one, by the best candidate of their map."""
    path, reasons = newest(keyframes, frames_kept(config)), list[str]()
    first: dict[str, float] = {}
    for end in ends(score, query, path, config):
        agreed, figures = _agree(score, query, path[:end], observations, reference, config)
        first = first if reasons else figures
        if isinstance(agreed, _Refusal):
            reasons.append(agreed.reason)
            continue
        caught = _catch_up(agreed, end, path, observations, reference, config)
        if isinstance(caught, _Refusal):
            reasons.append(caught.reason)
            if caught.contradicted:
                break
            continue
        place, latest = caught
        return Acquired(place, latest, figures | {"refine_tries": len(reasons) + 1.0})
    return NotAcquired("; earlier in the flight: ".join(dict.fromkeys((reasons[0], reasons[-1]))), first)


def _agree(
    score: Score,
    query: QueryMap,
    path: Sequence[Keyframe],
    observations: Sequence[FrameObservation],
    reference: Ground,
    config: MatcherConfig,
) -> tuple[Agreement | _Refusal, dict[str, float]]:
    """What the reference agrees to at the end of a path, by the best candidate, or why it does not; and the
    figures behind it."""
    begun = start_of(score, query, path, reference, config)
    if SIGMAS * begun.sigma_m > MOST_RIVAL_M:
        far = f"the flight has left the matched buildings, its place is open by {begun.sigma_m:.0f} m"
        return _Refusal(f"undecided: {far}"), {}
    refined = refine(begun, observations, reference, config)
    if isinstance(refined, Unrefined):
        return _Refusal(refined.reason), {}
    figures: dict[str, float] = {
        "refine_observed": refined.observed, "refine_pairs": refined.pairs,
        "refine_buildings": refined.buildings, "refine_rms_m": refined.rms_m,
    }  # fmt: skip
    refused = refuse_refined(refined, config)
    if refused is not None:
        return _Refusal(refused), figures
    seen = seen_in_world(refined.poses, observations, len(begun.keyframes), config)
    offset = refined.position_m - begun.state.poses[-1, :2]
    opinion = ask(seen, offset, begun.covariance, reference, config)
    figures |= {"recent_nats": opinion.nats, "recent_lead": opinion.lead, "recent_buildings": len(seen)}
    if opinion.outcome is not Outcome.ACCEPTED:
        return _Refusal(f"undecided: the latest frames do not agree: {opinion.reason}"), figures
    if (told := _loose(opinion, len(seen), config)) is not None:
        return _Refusal(f"undecided: the recent frames fit loosely: {told}"), figures
    # A match may leave the true houses for others on its way, and the window bends along: its end has to fit
    # by itself, and nowhere near by better.
    near = np.diag(np.square([RIVAL_M / SIGMAS, RIVAL_M / SIGMAS, 1.0]))
    last, latest = (
        seen_in_world(refined.poses, observations, n * config.follow_frames, config) for n in (1, 2)
    )
    at_last, at_end = (ask(some, np.zeros(2), near, reference, config) for some in (last, latest))
    figures |= {"end_nats": at_end.nats, "end_lead": at_end.lead, "end_buildings": len(latest)}
    for opinion, some in ((at_last, last), (at_end, latest)):
        if opinion.lead < -config.min_recent_nats * len(some):
            better = f"lead {opinion.lead:.1f} nats over another place near by, for {len(some)} buildings"
            return _Refusal(f"undecided: the latest frames fit elsewhere: {better}"), figures
    # Where the reference has nothing near by, nothing pulls the end aside either.
    if at_end.lead != 0.0 and (told := _loose(at_end, len(latest), config)) is not None:
        return _Refusal(f"undecided: the latest frames fit loosely: {told}"), figures
    return Agreement(refined.poses, refined.covariance, math.exp(begun.state.log_scales[1])), figures


def _loose(opinion: Opinion, buildings: int, config: MatcherConfig) -> str | None:
    """The figures of an opinion that so many buildings support too little; None where they do. Where houses
    stand close, many a place lays most of them near some house."""
    if min(opinion.nats, opinion.lead) >= config.min_recent_nats * buildings:
        return None
    return f"{opinion.nats:.1f} nats, lead {opinion.lead:.1f} over places near by, for {buildings} buildings"


def _catch_up(
    agreement: Agreement,
    known: int,
    path: Sequence[Keyframe],
    observations: Sequence[FrameObservation],
    reference: Ground,
    config: MatcherConfig,
) -> tuple[Place, Agreement] | _Refusal:
    """From an agreement about the first ``known`` keyframes of a path to the place of its last one, by
    following the flight in between, and the latest agreement; or why that is not known."""
    pursuit = agree(Pursuit(keyframes=tuple(path[:known])), agreement, config)
    while known < len(path):
        known = min(known + config.follow_frames, len(path))
        pursuit = carry(pursuit, path[:known], config)
        if pursuit.mode is Mode.ACQUIRE:
            return _Refusal(f"the match ends before the flight: {pursuit.withdrawn}")
        anchor, last = pursuit.anchors[path[known - 1].stamp_ns], path[known - 1]
        predicted, uncertainty = prediction(anchor, last), anchor.uncertainty(config)
        unanswered = pursuit.unanswered(last.stamp_ns)
        followed = follow(predicted, uncertainty, path[:known], observations, reference, config, unanswered)
        if followed.opinion.outcome is Outcome.REJECTED:
            return _Refusal(f"the match ends before the flight: {followed.opinion.reason}", True)
        if followed.agreement is not None:
            agreement = followed.agreement
            pursuit = agree(pursuit, agreement, config)
    last_ns = path[-1].stamp_ns
    return pursuit.anchors[last_ns].place(last_ns, config), agreement
