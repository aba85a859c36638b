"""Every frame against the current keyframe: a position at camera rate, at a fraction of a keyframe's cost."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from buildloc_msgs_py.ground import validate_frame
from buildloc_msgs_py.types import FloatArray, Frame

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.level import level_image
from buildloc_mapper.registration import Link, Prepared, Registration, Rejection, link_covariance
from buildloc_mapper.similarity import Similarity

LEVEL_WIDTH_PX = 480
FEATURE_WIDTH_PX = 400
FEATURES = 500
NOWHERE = Similarity(0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Tracked:
    """Pose of a frame in a keyframe, its (4, 4) covariance over x, y, yaw and log scale, and the corners
    that agree."""

    stamp_ns: int
    keyframe: int
    T_keyframe_frame: Similarity
    covariance: FloatArray
    inliers: int


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


class Tracker:
    """Follows the corners of the current keyframe from where a steady motion puts them; where that fails, a
    small SIFT finds them again. It works on images half as wide as those of the map."""

    def __init__(self, config: MapperConfig) -> None:
        self._config = replace(
            config, registration="sift", level_width_px=min(LEVEL_WIDTH_PX, config.level_width_px),
            feature_width_px=FEATURE_WIDTH_PX, features=FEATURES,
        )  # fmt: skip
        self._registration = Registration(self._config)
        self.reset()

    def reset(self) -> None:
        """Forget the flight."""
        self._frame: Frame | None = None
        self._keyframe = -1
        self._prepared: Prepared | None = None
        self._motion: _Motion | None = None

    def rebase(self, keyframe: int, frame: Frame, T_new_old: Similarity | None) -> None:  # noqa: N803
        """Track against another keyframe, in which the one before lies at ``T_new_old``; None: unknown.

        Costs nothing until a frame is tracked.
        """
        self._keyframe, self._frame, self._prepared = keyframe, frame, None
        if self._motion is not None and T_new_old is not None:
            self._motion = replace(self._motion, pose=T_new_old.compose(self._motion.pose))
        else:
            self._motion = None

    def track(self, frame: Frame) -> Tracked | Lost:
        """Where a frame is. Raises WireError for unusable telemetry."""
        validate_frame(frame)
        if self._frame is None:
            return Lost(frame.stamp_ns, "no_keyframe")
        if self._prepared is None:
            self._prepared = self._registration.prepare(self._frame)
        link = self._follow(self._prepared, frame)
        if not isinstance(link, Link):
            link = self._registration.register(self._prepared, self._registration.prepare(frame))
        if not isinstance(link, Link):
            self._motion = None
            return Lost(frame.stamp_ns, link.reason)
        self._moved(frame.stamp_ns, link.transform)
        covariance = link_covariance(link, self._config)
        return Tracked(frame.stamp_ns, self._keyframe, link.transform, covariance, link.inliers)

    def _follow(self, prepared: Prepared, frame: Frame) -> Link | Rejection:
        assert self._frame is not None
        start = self._motion or _Motion(self._frame.stamp_ns, NOWHERE, NOWHERE, 0.0)
        level = level_image(frame, self._config.level_width_px)
        return self._registration.follow(prepared, level, start.at(frame.stamp_ns))

    def _moved(self, stamp_ns: int, pose: Similarity) -> None:
        before, seconds = self._motion, 0.0
        step = NOWHERE
        if before is not None and stamp_ns > before.stamp_ns:
            seconds, step = (stamp_ns - before.stamp_ns) * 1e-9, before.pose.inverse().compose(pose)
            step = step._replace(yaw_rad=math.remainder(step.yaw_rad, math.tau))
        self._motion = _Motion(stamp_ns, pose, step, seconds)
