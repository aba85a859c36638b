"""Acquire, track, coast: where keyframes are in the world between one agreement with the reference and the
next. Frozen states and pure functions; metres, radians, stamps in ns.

A pose from an agreement is carried on by the map to newer keyframes and by tracking to the frames after
them. The further it is carried, the less certain it is; what gets too uncertain is withdrawn.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from buildloc_msgs_py.types import FloatArray, Keyframe, Tracked

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.geometry import Similarity, rotation, wrap

Pose = tuple[float, float, float]  # x, y, yaw


class Mode(enum.StrEnum):
    """Whether there is a place to go on from, and whether the reference agreed with it the last time."""

    ACQUIRE = "acquire"
    TRACK = "track"
    COAST = "coast"


@dataclass(frozen=True)
class Place:
    """A pose in the world (ENU metres of the database), and its (3, 3) covariance: east, north, yaw."""

    stamp_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    covariance: FloatArray


def drift_covariance(flown_m: float, config: MatcherConfig) -> FloatArray:
    """(3, 3) over east, north and yaw of what a flight adds over which the reference said nothing.

    Drift is an error of scale and heading that stays: it grows with the distance, not with its root.
    """
    place = config.drift_share * flown_m
    turn = math.radians(config.drift_deg_per_km) * flown_m * 1e-3
    return np.diag(np.square([place, place, turn]))


@dataclass(frozen=True)
class Anchor:
    """Where a keyframe is in the world. ``scale``: world metres per metre of its level camera frame.

    ``covariance`` (3, 3) east, north, yaw is that of the last agreement, carried here over ``flown_m``; what
    was added on the way is not in it.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    scale: float
    covariance: FloatArray
    flown_m: float = 0.0

    def uncertainty(self, config: MatcherConfig) -> FloatArray:
        """(3, 3) covariance east, north, yaw, what the flight since the agreement added included."""
        return np.asarray(self.covariance + drift_covariance(self.flown_m, config), dtype=np.float64)

    def place(self, stamp_ns: int, config: MatcherConfig) -> Place:
        """The place of the keyframe, of this stamp."""
        return Place(stamp_ns, self.x_m, self.y_m, self.yaw_rad, self.uncertainty(config))

    def ahead(self, x_m: float, y_m: float, yaw_rad: float, scale: float) -> Anchor:
        """The anchor of a pose in this one's level camera frame; ``scale`` is that between the two."""
        dx, dy = self.scale * rotation(self.yaw_rad) @ (x_m, y_m)
        by_turn = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        return Anchor(
            self.x_m + float(dx), self.y_m + float(dy), float(wrap(self.yaw_rad + yaw_rad)),
            self.scale * scale, by_turn @ self.covariance @ by_turn.T,
            self.flown_m + math.hypot(float(dx), float(dy)),
        )  # fmt: skip


@dataclass(frozen=True)
class Agreement:
    """What the reference agreed to: poses x, y, yaw of keyframes in the world by stamp, their (3, 3)
    covariance (the newest's), and world metres per metre of the map."""

    poses: Mapping[int, Pose]
    covariance: FloatArray
    scale: float


@dataclass(frozen=True)
class Pursuit:
    """``anchors`` by stamp, none while acquiring; the mapper's latest keyframes; why the last track ended."""

    mode: Mode = Mode.ACQUIRE
    anchors: Mapping[int, Anchor] = field(default_factory=lambda: MappingProxyType({}))
    keyframes: tuple[Keyframe, ...] = ()
    withdrawn: str = ""

    @property
    def since_agreement_m(self) -> float:
        """Distance from the last agreement to the newest keyframe, NaN while acquiring."""
        return self.anchors[max(self.anchors)].flown_m if self.anchors else math.nan

    def unanswered(self, stamp_ns: int) -> int:
        """Keyframes since the last agreement, up to one of this stamp."""
        return sum(anchor.flown_m > 0.0 and at <= stamp_ns for at, anchor in self.anchors.items())


def withdraw(pursuit: Pursuit, reason: str) -> Pursuit:
    """Nothing is known any more, and why."""
    return Pursuit(keyframes=pursuit.keyframes, withdrawn=reason)


def coast(pursuit: Pursuit) -> Pursuit:
    """The reference could not tell this time; what is known grows old."""
    return replace(pursuit, mode=Mode.COAST) if pursuit.mode is Mode.TRACK else pursuit


def agree(pursuit: Pursuit, agreement: Agreement, config: MatcherConfig) -> Pursuit:
    """Go on from an agreement about keyframes of which newer ones may be known by now."""
    scales = {k.stamp_ns: agreement.scale * k.scale for k in pursuit.keyframes}
    anchors = {
        stamp: Anchor(*pose, scales[stamp], agreement.covariance)
        for stamp, pose in agreement.poses.items()
        if stamp in scales
    }
    if not anchors:
        return withdraw(pursuit, "the map that the reference agrees with is gone")
    return carry(replace(pursuit, mode=Mode.TRACK, anchors=anchors), pursuit.keyframes, config)


def carry(pursuit: Pursuit, keyframes: Sequence[Keyframe], config: MatcherConfig) -> Pursuit:
    """Carry the anchors to newer keyframes of a map; withdrawn when the map has none of theirs, or the way
    is too long."""
    path = sorted(keyframes, key=lambda k: k.stamp_ns)
    moved = replace(pursuit, keyframes=tuple(path))
    if pursuit.mode is Mode.ACQUIRE or not path:
        return moved
    known = [at for at, keyframe in enumerate(path) if keyframe.stamp_ns in pursuit.anchors]
    if not known:
        return withdraw(moved, "the mapper began another map: tracking was lost")
    anchors = {path[at].stamp_ns: pursuit.anchors[path[at].stamp_ns] for at in known}
    anchor = anchors[path[known[-1]].stamp_ns]
    for here, there in zip(path[known[-1] :], path[known[-1] + 1 :], strict=False):
        dx, dy = rotation(here.yaw_rad).T @ (there.x_m - here.x_m, there.y_m - here.y_m) / here.scale
        anchor = anchor.ahead(dx, dy, there.yaw_rad - here.yaw_rad, there.scale / here.scale)
        anchors[there.stamp_ns] = anchor
    tired = too_far(anchor, config)
    return replace(moved, anchors=anchors) if tired is None else withdraw(moved, tired)


def too_far(anchor: Anchor, config: MatcherConfig) -> str | None:
    """Why a pose is too far from the last agreement to be told, or None."""
    if anchor.flown_m > config.max_coast_m:
        return f"flew {anchor.flown_m:.0f} m without an agreement with the reference"
    sigma = sigma_m(anchor.uncertainty(config))
    if sigma > config.max_track_sigma_m:
        return f"uncertainty grew to {sigma:.0f} m, above {config.max_track_sigma_m:g} m"
    return None


def sigma_m(covariance: FloatArray) -> float:
    """Standard deviation of a place along the axis where it is largest."""
    return math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))


def locate(pursuit: Pursuit, tracked: Tracked, config: MatcherConfig) -> Place | str:
    """Where a tracked frame is in the world, or why that is not known."""
    anchor = pursuit.anchors.get(tracked.keyframe_ns)
    if anchor is None:
        return "the frame is tracked in a keyframe that has no place yet"
    here = anchor.ahead(tracked.x_m, tracked.y_m, tracked.yaw_rad, 1.0)
    tired = too_far(here, config)
    if tired is not None:
        return tired
    # Of the registration itself, from the keyframe's axes and metres into the world's.
    turn = np.eye(3)
    turn[:2, :2] = anchor.scale * rotation(anchor.yaw_rad)
    seen = turn @ tracked.covariance[:3, :3] @ turn.T
    return Place(tracked.stamp_ns, here.x_m, here.y_m, here.yaw_rad, here.uncertainty(config) + seen)


def prediction(anchor: Anchor, keyframe: Keyframe) -> Similarity:
    """The similarity map -> world around a keyframe, as its anchor has it."""
    turn, scale = float(wrap(anchor.yaw_rad - keyframe.yaw_rad)), anchor.scale / keyframe.scale
    return Similarity((keyframe.x_m, keyframe.y_m), (anchor.x_m, anchor.y_m), turn, scale)


def sigmas_apart(offset: FloatArray, one: FloatArray, other: FloatArray, shared: FloatArray) -> float:
    """Mahalanobis length of an offset (3,) east, north, yaw between two places with covariances (3, 3), of
    which ``shared`` is an error that both have and their difference has not."""
    return math.sqrt(float(offset @ np.linalg.solve(one + other - 2.0 * shared, offset)))
