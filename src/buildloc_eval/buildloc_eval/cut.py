"""Flights cut out of a real orthophoto: keyframes with noisy telemetry, true masks, and the exact truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import ByteArray, CameraModel, FloatArray, Frame, Mask
from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.keyframes import Moment, is_keyframe

from buildloc_eval.camera import attitude, camera_model, look, photograph
from buildloc_eval.flight import FlightConfig, Trajectory
from buildloc_eval.world import World


@dataclass(frozen=True)
class CutFlight:
    """N keyframes over real ground.

    ``poses`` (N, 6): x, y, altitude above ground (m), ENU yaw of image-right, roll, pitch (rad), all true.
    Telemetry has the config's noise; its heading is turned by a constant, its altitude multiplied by
    ``altitude_factor``.
    """

    name: str
    picture: World
    labels: World
    camera: CameraModel
    config: FlightConfig
    stamps_ns: tuple[int, ...]
    poses: FloatArray
    seed: int
    altitude_factor: float = 1.0

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def true_m(self) -> FloatArray:
        """(N, 2) true places below the camera, UTM metres."""
        return np.asarray(self.poses[:, :2], dtype=np.float64)

    @property
    def length_m(self) -> float:
        """Length of the path from keyframe to keyframe."""
        return float(np.hypot(*np.diff(self.true_m, axis=0).T).sum())

    def frame(self, index: int) -> Frame:
        """A keyframe as camera, altimeter and gimbal tell it; the same at every call."""
        x, y, altitude_m, yaw, roll, pitch = self.poses[index].tolist()
        rng = np.random.default_rng([self.seed, 3, index])
        image = photograph(
            self.picture, self.camera, (x, y, altitude_m, yaw), self._attitude(index), self.config, rng
        )
        error = math.radians(self.config.attitude_noise_deg) * rng.standard_normal(3)
        turned = np.random.default_rng([self.seed, 4]).uniform(-math.pi, math.pi)
        told = attitude(roll + error[0], pitch + error[1], -yaw + turned + error[2])
        measured = altitude_m * self.altitude_factor + self.config.altitude_noise_m * rng.standard_normal()
        return Frame(self.stamps_ns[index], "camera", image, self.camera, measured, told)

    def mask(self, index: int) -> Mask:
        """The labels as the camera sees them."""
        x, y, altitude_m, yaw, *_ = self.poses[index].tolist()
        seen = look(self.labels, self.camera, (x, y, altitude_m, yaw), self._attitude(index))
        pixels: ByteArray = np.where(seen > 127, np.uint8(255), np.uint8(0))
        return Mask(self.stamps_ns[index], "camera", pixels)

    def _attitude(self, index: int) -> tuple[float, float, float, float]:
        """The true one. The level frame's z points down: ENU yaw counts the other way round."""
        _, _, _, yaw, roll, pitch = self.poses[index].tolist()
        return attitude(roll, pitch, -yaw)


def cut(
    name: str,
    picture: World,
    labels: World,
    trajectory: Trajectory,
    config: FlightConfig,
    seed: int,
    altitude_factor: float = 1.0,
) -> CutFlight:
    """The keyframes that the segmenter's policy would choose among the images of a trajectory."""
    stamps = keyframe_stamps(trajectory, config.rate_hz)
    poses = np.array([trajectory.at(stamp) for stamp in stamps])
    camera = camera_model(config)
    return CutFlight(name, picture, labels, camera, config, stamps, poses, seed, altitude_factor)


def keyframe_stamps(trajectory: Trajectory, rate_hz: float) -> tuple[int, ...]:
    """Of the images that the segmenter's policy would choose."""
    policy, last, stamps = SegmenterConfig(), None, list[int]()
    for stamp in range(int(trajectory.stamps_ns[0]), int(trajectory.stamps_ns[-1]) + 1, round(1e9 / rate_hz)):
        now = Moment(stamp, -trajectory.at(stamp)[3])
        if is_keyframe(last, now, policy):
            last = now
            stamps.append(stamp)
    return tuple(stamps)
