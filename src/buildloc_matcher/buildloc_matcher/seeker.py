"""From maps and tracked frames to fixes: acquires by the global search, follows, and lets go. No ROS.

The state is a :class:`pursuit.Pursuit`, replaced whole under a lock: maps are solved on one thread while
frames and keyframes come on another.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from buildloc_msgs_py.types import Fix, FloatArray, FrameObservation, Keyframe, LocalMap, NoFix, Tracked

from buildloc_matcher.acceptance import Outcome
from buildloc_matcher.calibration import protection_level_m
from buildloc_matcher.geometry import wrap
from buildloc_matcher.matcher import Answer, Matcher
from buildloc_matcher.pursuit import (
    Anchor,
    Mode,
    Place,
    Pursuit,
    agree,
    carry,
    coast,
    locate,
    prediction,
    sigmas_apart,
    withdraw,
)
from buildloc_matcher.refinement import registration_covariance

WAITING = "waiting for a map"
UNTRACKED = "no frame is tracked in a keyframe that has a place"
Step = Callable[[Pursuit], Pursuit]


class Seeker:
    """One flight in one reference database. ``reason`` says why there is no fix when there is none;
    ``withdrawals`` counts how often a place was given up."""

    def __init__(self, matcher: Matcher) -> None:
        self.matcher = matcher
        self.withdrawals = 0
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        """Forget the flight."""
        with self._lock:
            self.pursuit = Pursuit()
            self._flight = object()
            self._latest: Fix | None = None  # of those given out
            self._unchecked = 0  # maps since the last global search
            self.reason = WAITING

    def carry(self, keyframes: Sequence[Keyframe]) -> None:
        """Take the mapper's latest keyframes."""
        with self._lock:
            self._become(carry(self.pursuit, keyframes, self.matcher.config))

    def locate(self, tracked: Tracked) -> Fix | NoFix:
        """The fix of a tracked frame, or why there is none."""
        with self._lock:
            place = locate(self.pursuit, tracked, self.matcher.config)
            if isinstance(place, Place):
                return self.matcher.fix_at(place, tracked.height_m)
            if self.pursuit.mode is Mode.ACQUIRE:
                return NoFix(tracked.stamp_ns, self.reason)
            if tracked.keyframe_ns in self.pursuit.anchors:
                self._become(withdraw(self.pursuit, place))
            return NoFix(tracked.stamp_ns, place)

    def figures(self) -> dict[str, object]:
        """For /diagnostics: the mode, metres flown since the reference agreed, the protection level of the
        latest fix that was given out (NaN without a place), and what was given up."""
        pursuit, latest, level = self.pursuit, self._latest, math.nan
        if latest is not None and pursuit.mode is not Mode.ACQUIRE:
            level = float(protection_level_m(latest.covariance_enu_m2[:2, :2]))
        return {
            "mode": pursuit.mode.value,
            "since_agreement_m": pursuit.since_agreement_m,
            "protection_level_m": level,
            "withdrawals": self.withdrawals,
            "withdrawn": pursuit.withdrawn,
        }

    def fresh(self, fix: Fix) -> bool:
        """Whether a fix is later than all that were given out; it counts as given out then."""
        with self._lock:
            later = self._latest is None or fix.stamp_ns > self._latest.stamp_ns
            self._latest = fix if later else self._latest
            return later

    def solve(
        self, local_map: LocalMap, keyframes: Sequence[Keyframe], observations: Sequence[FrameObservation]
    ) -> Answer:
        """The position of the camera at a map's last keyframe, or why there is none: by the global search
        until there is a place to go on from, from then on by asking the reference about that place."""
        with self._lock:
            pursuit, flight = self.pursuit, self._flight
        last = max(keyframes, key=lambda k: k.stamp_ns, default=None)
        if last is None or last.stamp_ns not in pursuit.anchors:
            answer, step = self._acquire(local_map, keyframes, observations)
        else:
            answer, step = self._follow(pursuit, last, local_map, keyframes, observations)
        with self._lock:
            if flight is not self._flight:
                return Answer(NoFix(local_map.stamp_ns, "the flight was forgotten meanwhile"), (), {})
            self._become(step(self.pursuit))
            if isinstance(answer.result, Fix) and self.pursuit.mode is Mode.ACQUIRE:
                # The place was withdrawn while it was asked about: what was found has nothing to go on from.
                answer = replace(answer, result=NoFix(answer.result.stamp_ns, self.pursuit.withdrawn))
            self.reason = answer.result.reason if isinstance(answer.result, NoFix) else UNTRACKED
        return answer

    def failed(self, reason: str) -> None:
        """A map had no answer at all, and why: what is known grows old."""
        with self._lock:
            self.reason = reason
            self._become(coast(self.pursuit))

    def _acquire(
        self, local_map: LocalMap, keyframes: Sequence[Keyframe], observations: Sequence[FrameObservation]
    ) -> tuple[Answer, Step]:
        self._unchecked = 0
        answer = self.matcher.fix(local_map, keyframes, observations)
        if answer.agreement is None:
            return answer, lambda pursuit: pursuit
        return answer, partial(agree, agreement=answer.agreement, config=self.matcher.config)

    def _follow(
        self,
        pursuit: Pursuit,
        last: Keyframe,
        local_map: LocalMap,
        keyframes: Sequence[Keyframe],
        observations: Sequence[FrameObservation],
    ) -> tuple[Answer, Step]:
        matcher, config = self.matcher, self.matcher.config
        anchor = pursuit.anchors[last.stamp_ns]
        self._unchecked += 1
        if self._unchecked >= config.check_keyframes:
            self._unchecked = 0
            found = matcher.fix(local_map, keyframes, observations)
            if (elsewhere := self._elsewhere(found, anchor)) is not None:
                none = NoFix(last.stamp_ns, elsewhere)
                return Answer(none, found.candidates, found.funnel), partial(withdraw, reason=elsewhere)
        place, unanswered = anchor.place(last.stamp_ns, config), pursuit.unanswered(last.stamp_ns)
        predicted = prediction(anchor, last)
        followed = matcher.follow(predicted, place.covariance, keyframes, observations, unanswered)
        opinion, agreement = followed.opinion, followed.agreement
        funnel = {"follow_nats": opinion.nats, "follow_lead": opinion.lead}
        if opinion.outcome is Outcome.REJECTED:
            none = NoFix(last.stamp_ns, opinion.reason)
            return Answer(none, (), funnel), partial(withdraw, reason=opinion.reason)
        step: Step = coast
        if agreement is not None:
            place = Place(last.stamp_ns, *agreement.poses[last.stamp_ns], agreement.covariance)
            step = partial(agree, agreement=agreement, config=config)
        altitude = next((o.altitude_m for o in observations if o.stamp_ns == last.stamp_ns), math.nan)
        return Answer(matcher.fix_at(place, altitude), (), funnel, agreement), step

    def _elsewhere(self, found: Answer, anchor: Anchor) -> str | None:
        """What a global search found, if that is another place than the anchor's."""
        if found.agreement is None:
            return None
        fix, config = found.result, self.matcher.config
        assert isinstance(fix, Fix)
        offset = np.array([fix.easting_m - anchor.x_m, fix.northing_m - anchor.y_m, 0.0])
        offset[2] = wrap(fix.yaw_rad - anchor.yaw_rad)
        apart = sigmas_apart(
            offset, anchor.uncertainty(config), _covariance(fix), registration_covariance(config)
        )
        if apart <= config.max_jump_sigmas:
            return None
        away = math.hypot(*offset[:2])
        return f"the global search found another place, {away:.1f} m away, {apart:.1f} standard deviations"

    def _become(self, pursuit: Pursuit) -> None:
        """Change the state; the lock is held."""
        if self.pursuit.mode is not Mode.ACQUIRE and pursuit.mode is Mode.ACQUIRE:
            self.withdrawals += 1
            self.reason = pursuit.withdrawn
        self.pursuit = pursuit


def _covariance(fix: Fix) -> FloatArray:
    """(3, 3) over east, north and yaw."""
    covariance = np.diag([0.0, 0.0, fix.yaw_variance_rad2])
    covariance[:2, :2] = fix.covariance_enu_m2[:2, :2]
    return covariance
