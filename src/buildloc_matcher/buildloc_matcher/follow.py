"""Does the reference agree where a pursuit says that the drone is? A sequential test, by evidence in nats.

The buildings of the latest frames speak for the predicted place or against it (log-likelihood ratios against
chance, :mod:`evidence`). Much for it: agreement. Much against every place that the prediction's uncertainty
leaves open: disagreement. In between nothing is decided, as over open country.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray, FrameObservation
from scipy.special import logsumexp

from buildloc_matcher.acceptance import Outcome
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import GATE_SIGMAS, Ground, placed_evidence
from buildloc_matcher.geometry import rotation
from buildloc_matcher.pursuit import Pose, sigma_m

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


def seen_in_world(
    poses: Mapping[int, Pose], observations: Sequence[FrameObservation], frames: int
) -> FloatArray:
    """(N, 2) the buildings that the last frames saw, each once, where frames with ``poses`` (x, y, yaw in
    the world) see them; the newest frame's word goes first."""
    seen = np.empty((0, 2))
    placed = sorted((o for o in observations if o.stamp_ns in poses), key=lambda o: -o.stamp_ns)
    for observation in placed[:frames]:
        x, y, yaw = poses[observation.stamp_ns]
        points = observation.centroids_m @ rotation(yaw).T + (x, y)
        apart = np.linalg.norm(points[:, None] - seen[None], axis=2)
        seen = np.concatenate([seen, points[(apart > ONE_BUILDING_M).all(axis=1)]])
    return seen


def _shifts(sigma: float, config: MatcherConfig) -> FloatArray:
    """(S, 2) moves about the prediction that its uncertainty leaves open, one error of a building apart."""
    reach = SIGMAS * math.hypot(sigma, config.sigma_m)
    line = np.arange(-reach, reach + config.sigma_m, config.sigma_m)
    moves = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    return np.asarray(moves[np.linalg.norm(moves, axis=1) <= reach])


def ask(
    seen_m: FloatArray, offset_m: FloatArray, covariance: FloatArray, reference: Ground, config: MatcherConfig
) -> Opinion:
    """What buildings (N, 2) say of the pose that puts them there, ``offset_m`` (2,) away from the prediction,
    whose covariance (3, 3) tells which other places it has to lead."""
    # Where the pose has gone far, so may others have.
    sigma, gate_m = max(sigma_m(covariance), math.hypot(*offset_m) / 2.0), GATE_SIGMAS * config.sigma_m
    shifts = _shifts(sigma, config)
    moves = shifts - offset_m
    nats = placed_evidence(seen_m, reference, config)
    others = np.array([placed_evidence(seen_m + move, reference, config) for move in moves])
    # Of all places that the prediction leaves open, each as likely beforehand as the prediction has it.
    prior = np.exp(-0.5 * np.sum(shifts**2, axis=1) / (sigma**2 + config.sigma_m**2))
    somewhere = float(logsumexp(others, b=prior / prior.sum()))
    rival = float(others[np.linalg.norm(moves, axis=1) > gate_m].max(initial=-math.inf))
    lead, chances = nats - rival, math.log(max(1.0, (SIGMAS * sigma / gate_m) ** 2))
    told = f"{len(seen_m)} buildings, {nats:.1f} nats"

    def opinion(outcome: Outcome, reason: str) -> Opinion:
        return Opinion(outcome, reason, nats, lead)

    if somewhere <= -config.follow_nats:
        return opinion(Outcome.REJECTED, f"the reference has not what was seen: {told}")
    if lead <= -config.follow_nats and rival - chances >= config.follow_nats:
        return opinion(Outcome.REJECTED, f"another place near by fits better: {told}, lead {lead:.1f}")
    if lead >= config.follow_nats and nats - chances >= config.follow_nats:
        return opinion(Outcome.ACCEPTED, told)
    return opinion(Outcome.UNDECIDED, f"the reference could not tell: {told}, lead {lead:.1f}")
