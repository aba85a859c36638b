"""Does the reference agree where a pursuit says that the drone is? A sequential test, by evidence in nats, of
the place that the latest frames are refined to.

The buildings of the latest frames speak for the predicted place or against it (log-likelihood ratios against
chance, :mod:`evidence`). Much for it: agreement. Much against every place that the prediction's uncertainty
leaves open: disagreement. In between nothing is decided, as over open country.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from buildloc_msgs_py.types import FloatArray, FrameObservation, Keyframe
from scipy.special import logsumexp

from buildloc_matcher.acceptance import Outcome, refuse_refined
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import GATE_SIGMAS, Ground, placed_evidence
from buildloc_matcher.geometry import Similarity, area_around_m2, rotation, wrap
from buildloc_matcher.pursuit import Agreement, Pose, sigma_m, sigmas_apart
from buildloc_matcher.refinement import Refined, Unrefined, refine, registration_covariance
from buildloc_matcher.window import start

SIGMAS = 3.0  # the uncertainty of a prediction reaches this far
ONE_BUILDING_M = 6.0  # buildings of two frames nearer than this are the same


@dataclass(frozen=True)
class Opinion:
    """Accepted, undecided or rejected, why, and the nats behind it: of the pose itself, and its lead over
    others."""

    outcome: Outcome
    reason: str
    nats: float
    lead: float


@dataclass(frozen=True)
class Followed:
    """What the reference says about a prediction, and with an agreement what it agrees to."""

    opinion: Opinion
    agreement: Agreement | None


@dataclass(frozen=True)
class Seen:
    """``points_m`` (N, 2) of buildings in the world, and the ``area_m2`` of the ground that they were seen
    on."""

    points_m: FloatArray
    area_m2: float

    def __len__(self) -> int:
        return len(self.points_m)

    def share(self, config: MatcherConfig) -> float:
        """How many of the buildings the reference should have: a segmenter invents some on every square
        kilometre, and where hardly any are seen, most may be such. Half of ``match_share`` at least."""
        false = config.false_per_km2 * 1e-6 * self.area_m2
        return min(config.match_share, max(0.5 * config.match_share, 1.0 - false / max(len(self), 1)))


def seen_in_world(
    poses: Mapping[int, Pose],
    observations: Sequence[FrameObservation],
    frames: int,
    config: MatcherConfig,
) -> Seen:
    """The buildings that the last frames saw, each once, where frames with ``poses`` (x, y, yaw in the world)
    see them; the newest frame's word goes first."""
    seen = np.empty((0, 2))
    placed = sorted((o for o in observations if o.stamp_ns in poses), key=lambda o: -o.stamp_ns)[:frames]
    for observation in placed:
        x, y, yaw = poses[observation.stamp_ns]
        points = observation.centroids_m @ rotation(yaw).T + (x, y)
        apart = np.linalg.norm(points[:, None] - seen[None], axis=2)
        seen = np.concatenate([seen, points[(apart > ONE_BUILDING_M).all(axis=1)]])
    path = np.array([poses[o.stamp_ns][:2] for o in placed]).reshape(-1, 2)
    return Seen(seen, area_around_m2(path, config.observable_radius_m))


def _shifts(sigma: float, config: MatcherConfig) -> FloatArray:
    """(S, 2) moves about the prediction that its uncertainty leaves open, one error of a building apart."""
    reach = SIGMAS * math.hypot(sigma, config.sigma_m)
    line = np.arange(-reach, reach + config.sigma_m, config.sigma_m)
    moves = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    return np.asarray(moves[np.linalg.norm(moves, axis=1) <= reach])


def ask(
    seen: Seen, offset_m: FloatArray, covariance: FloatArray, reference: Ground, config: MatcherConfig
) -> Opinion:
    """What buildings say of the pose that puts them there, ``offset_m`` (2,) away from the prediction,
    whose covariance (3, 3) tells which other places it has to lead."""
    # Where the pose has gone far, so may others have.
    sigma, gate_m = max(sigma_m(covariance), math.hypot(*offset_m) / 2.0), GATE_SIGMAS * config.sigma_m
    shifts = _shifts(sigma, config)
    moves = shifts - offset_m
    shares = np.full(len(seen), seen.share(config))
    nats = placed_evidence(seen.points_m, shares, reference, config)
    others = np.array([placed_evidence(seen.points_m + move, shares, reference, config) for move in moves])
    # Of all places that the prediction leaves open, each as likely beforehand as the prediction has it.
    prior = np.exp(-0.5 * np.sum(shifts**2, axis=1) / (sigma**2 + config.sigma_m**2))
    somewhere = float(logsumexp(others, b=prior / prior.sum()))
    rival = float(others[np.linalg.norm(moves, axis=1) > gate_m].max(initial=-math.inf))
    lead, chances = nats - rival, math.log(max(1.0, (SIGMAS * sigma / gate_m) ** 2))
    told = f"{len(seen)} buildings, {nats:.1f} nats"

    def opinion(outcome: Outcome, reason: str) -> Opinion:
        return Opinion(outcome, reason, nats, lead)

    if somewhere <= -config.follow_nats:
        return opinion(Outcome.REJECTED, f"the reference has not what was seen: {told}")
    if lead <= -config.follow_nats and rival - chances >= config.follow_nats:
        return opinion(Outcome.REJECTED, f"another place near by fits better: {told}, lead {lead:.1f}")
    if lead >= config.follow_nats and nats - chances >= config.follow_nats:
        return opinion(Outcome.ACCEPTED, told)
    return opinion(Outcome.UNDECIDED, f"the reference could not tell: {told}, lead {lead:.1f}")


def follow(
    predicted: Similarity,
    covariance: FloatArray,
    keyframes: Sequence[Keyframe],
    observations: Sequence[FrameObservation],
    reference: Ground,
    config: MatcherConfig,
    unanswered: int = 0,
) -> Followed:
    """Whether the reference agrees that the last keyframe lies where ``predicted`` (map -> world) puts it, up
    to a covariance (3, 3) over east, north and yaw, the reference's registration included; after so many
    keyframes without an agreement."""
    last = max(keyframes, key=lambda k: k.stamp_ns)
    begun = start(predicted, keyframes, config, sigma_m(covariance))
    refined = refine(begun, observations, reference, config)
    poses = refined.poses if isinstance(refined, Refined) else _placed(predicted, keyframes)
    offset = np.array(poses[last.stamp_ns]) - np.array(_placed(predicted, [last])[last.stamp_ns])
    offset[2] = wrap(offset[2])
    frames = config.follow_frames
    if isinstance(refined, Refined):  # else older frames lie where no fit has bent the path to
        frames = min(max(frames, unanswered), config.refine_frames)
    seen = seen_in_world(poses, observations, frames, config)
    opinion = ask(seen, offset[:2], covariance, reference, config)
    if opinion.outcome is not Outcome.ACCEPTED:
        return Followed(opinion, None)
    refused = refined.reason if isinstance(refined, Unrefined) else refuse_refined(refined, config)
    if isinstance(refined, Unrefined) or refused is not None:
        return Followed(replace(opinion, outcome=Outcome.UNDECIDED, reason=refused or ""), None)
    apart = sigmas_apart(offset, covariance, refined.covariance, registration_covariance(config))
    if apart > config.max_jump_sigmas:
        jump = f"the place jumped by {math.hypot(*offset[:2]):.1f} m, {apart:.1f} standard deviations"
        return Followed(replace(opinion, outcome=Outcome.REJECTED, reason=jump), None)
    return Followed(opinion, Agreement(refined.poses, refined.covariance, predicted.scale))


def _placed(similarity: Similarity, keyframes: Sequence[Keyframe]) -> dict[int, Pose]:
    """x, y and yaw of keyframes in the world, by stamp."""
    places = similarity.apply(np.array([(k.x_m, k.y_m) for k in keyframes])).tolist()
    return {
        k.stamp_ns: (x, y, k.yaw_rad + similarity.yaw_rad)
        for k, (x, y) in zip(keyframes, places, strict=True)
    }
