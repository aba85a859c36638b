"""Every frame against the current keyframe: a position at camera rate, at a fraction of a keyframe's cost."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

from buildloc_msgs_py.ground import validate_frame
from buildloc_msgs_py.types import Frame, Tracked

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.level import level_image
from buildloc_mapper.registration import Guide, Link, Prepared, Registration, Rejection, link_covariance
from buildloc_mapper.similarity import Similarity

NOWHERE = Similarity(0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Lost:
    """A frame that is not tracked, and why: ``no_keyframe``, or as a :class:`Rejection` says."""

    stamp_ns: int
    reason: str


@dataclass(frozen=True)
class _Motion:
    """The last two tracked poses, in the current keyframe."""

    stamp_ns: int
    pose: Similarity
    step: Similarity  # from the one before to this one
    seconds: float

    def at(self, stamp_ns: int) -> Similarity:
        """The pose at a time, at the velocity of the last step."""
        share = (stamp_ns - self.stamp_ns) * 1e-9 / self.seconds if self.seconds > 0.0 else 0.0
        x, y, yaw, scale = self.step
        return self.pose.compose(Similarity(share * x, share * y, share * yaw, scale**share))


@dataclass(frozen=True)
class _Base:
    """The keyframe that frames are tracked against."""

    stamp_ns: int
    guide: Guide
    prepared: Prepared


class Tracker:
    """Follows the corners of the current keyframe from where a steady motion puts them; where that fails,
    the frame is registered as a keyframe would be."""

    def __init__(self, config: MapperConfig, registration: Registration) -> None:
        self._config, self._registration = config, registration
        self.reset()

    def reset(self) -> None:
        """Forget the flight."""
        self._rebases: deque[tuple[_Base, Similarity | None]] = deque()
        self._base: _Base | None = None
        self._motion: _Motion | None = None

    def rebase(self, keyframe: Frame, prepared: Prepared, T_new_old: Similarity | None) -> None:  # noqa: N803
        """Track against another keyframe from the next frame on, in which the one before lies at
        ``T_new_old``; None: unknown. It may come from another thread than :meth:`track`."""
        guide = self._registration.prepare_to_follow(keyframe)
        self._rebases.append((_Base(keyframe.stamp_ns, guide, prepared), T_new_old))

    def _take_over(self) -> None:
        while self._rebases:
            self._base, T_new_old = self._rebases.popleft()  # noqa: N806
            if self._motion is not None and T_new_old is not None:
                self._motion = replace(self._motion, pose=T_new_old.compose(self._motion.pose))
            else:
                self._motion = None

    def track(self, frame: Frame) -> Tracked | Lost:
        """Where a frame is. Raises WireError for unusable telemetry."""
        validate_frame(frame)
        self._take_over()
        if (base := self._base) is None:
            return Lost(frame.stamp_ns, "no_keyframe")
        link = self._follow(base, frame)
        if not isinstance(link, Link):
            link = self._registration.register(base.prepared, self._registration.prepare(frame))
        if not isinstance(link, Link):
            self._motion = None
            return Lost(frame.stamp_ns, link.reason)
        self._moved(frame.stamp_ns, link.transform)
        x, y, yaw, scale = link.transform
        covariance = link_covariance(link, self._config)
        return Tracked(frame.stamp_ns, base.stamp_ns, x, y, yaw, scale * frame.altitude_m, covariance)

    def _follow(self, base: _Base, frame: Frame) -> Link | Rejection:
        start = self._motion or _Motion(base.stamp_ns, NOWHERE, NOWHERE, 0.0)
        level = level_image(frame, self._config.track_width_px)
        return self._registration.follow(base.guide, level, start.at(frame.stamp_ns))

    def _moved(self, stamp_ns: int, pose: Similarity) -> None:
        before, seconds = self._motion, 0.0
        step = NOWHERE
        if before is not None and stamp_ns > before.stamp_ns:
            seconds, step = (stamp_ns - before.stamp_ns) * 1e-9, before.pose.inverse().compose(pose)
            step = step._replace(yaw_rad=math.remainder(step.yaw_rad, math.tau))
        self._motion = _Motion(stamp_ns, pose, step, seconds)
