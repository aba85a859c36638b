"""Flights: a path, an altitude profile, headings that follow the course, and tilt; one pose per image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.config import param
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import FloatArray

Box = tuple[float, float, float, float]
HORIZON_RAD = math.radians(80.0)
MIN_STATES = 10
TOUR_LEG_M = (200.0, 500.0)
TOUR_TURN_RAD = math.radians(120.0)
TOUR_EXCESS = 1.25
TOUR_TRIES = 1000
START_NS = 1_760_000_000 * 10**9


class FlightError(BuildlocError):
    """A flight does not fit where it should go."""


@dataclass(frozen=True)
class FlightConfig:
    """What is flown, and with which camera."""

    length_m: float = param(1400.0, "length of the path, m", 10.0, 1e5)
    leg_m: float = param(450.0, "length of a leg, m", 20.0, 1e5)
    spacing_m: float = param(80.0, "distance between legs, m", 5.0, 1e4)
    speed_mps: float = param(8.0, "ground speed, m/s", 0.1, 100.0)
    rate_hz: float = param(1.0, "images per second", 0.1, 30.0)
    altitude_m: float = param(105.0, "mean height above ground, m", 5.0, 1000.0)
    altitude_swing_m: float = param(4.0, "amplitude of the altitude profile, m", 0.0, 100.0)
    tilt_deg: float = param(2.0, "standard deviation of roll and pitch, deg", 0.0, 20.0)
    width: int = param(1280, "image width, px", 64, 8192)
    height: int = param(720, "image height, px", 64, 8192)
    hfov_deg: float = param(70.0, "horizontal field of view, deg", 10.0, 150.0)
    exposure: float = param(0.1, "standard deviation of the exposure change, relative", 0.0, 0.8)
    blur_px: float = param(0.6, "standard deviation of the largest blur, px", 0.0, 10.0)
    noise: float = param(3.0, "standard deviation of the sensor noise, grey levels", 0.0, 50.0)
    altitude_noise_m: float = param(0.3, "standard deviation of the altitude telemetry, m", 0.0, 20.0)
    attitude_noise_deg: float = param(0.2, "standard deviation of the attitude telemetry, deg", 0.0, 10.0)
    jpeg_quality: int = param(85, "JPEG quality", 10, 100)


@dataclass(frozen=True)
class Trajectory:
    """True state over time: stamps (N,) ns; xy (N, 2) UTM metres of the camera; height above ground;
    ENU yaw of image-right; roll and pitch of the camera, radians."""

    stamps_ns: np.ndarray
    xy_m: FloatArray
    altitude_m: FloatArray
    yaw_rad: FloatArray
    tilt_rad: FloatArray

    def at(self, stamp_ns: int) -> tuple[float, float, float, float, float, float]:
        """x, y, altitude, yaw, roll, pitch, interpolated."""
        columns = (*self.xy_m.T, self.altitude_m, self.yaw_rad, *self.tilt_rad.T)
        x, y, altitude, yaw, roll, pitch = (float(np.interp(stamp_ns, self.stamps_ns, c)) for c in columns)
        return x, y, altitude, yaw, roll, pitch


def focal_px(config: FlightConfig) -> float:
    """Focal length from the horizontal field of view."""
    return config.width / 2.0 / math.tan(math.radians(config.hfov_deg) / 2.0)


def margin_m(config: FlightConfig) -> float:
    """How far from the camera an image may reach: half its diagonal at the largest height, and tilt.

    Raises FlightError when it would come near the horizon.
    """
    half_diagonal = math.hypot(config.width, config.height) / 2.0
    angle = math.atan(half_diagonal / focal_px(config)) + math.radians(3.0 * config.tilt_deg)
    if angle > HORIZON_RAD:
        raise FlightError(
            f"with hfov_deg = {config.hfov_deg:g} and tilt_deg = {config.tilt_deg:g} images come near the "
            "horizon; narrow the field of view or tilt less"
        )
    return (config.altitude_m + config.altitude_swing_m) * math.tan(angle)


def _inner(box_m: Box, config: FlightConfig) -> tuple[FloatArray, FloatArray]:
    """Corners (2,) of what is left of the box where the camera never sees beyond it."""
    margin = margin_m(config)
    low, high = np.array(box_m[:2]) + margin, np.array(box_m[2:]) - margin
    if high[0] - low[0] < 20.0 or high[1] - low[1] < 1.0:
        raise FlightError(
            f"the region is too small for this camera: an image reaches {margin:.0f} m from the drone; "
            "fly lower, narrow the field of view or enlarge the region"
        )
    return low, high


def legs(box_m: Box, config: FlightConfig) -> FloatArray:
    """(N, 2) corners of back-and-forth legs inside the box, along its longer side, until the length is flown.

    Raises FlightError when the box is too small.
    """
    (west, south), (east, north) = _inner(box_m, config)
    swap = north - south > east - west
    width, height = (north - south, east - west) if swap else (east - west, north - south)
    leg = min(config.leg_m, width)
    count = max(1, math.ceil(config.length_m / (leg + config.spacing_m)))
    spacing = config.spacing_m
    if (count - 1) * spacing > height:
        raise FlightError(
            f"{config.length_m:g} m in legs of {leg:.0f} m every {spacing:g} m do not fit the region; "
            "shorten the flight, lengthen the legs or put them closer"
        )
    u0, v0 = (width - leg) / 2.0, (height - (count - 1) * spacing) / 2.0
    corners = []
    for i in range(count):
        ends = [(u0, v0 + i * spacing), (u0 + leg, v0 + i * spacing)]
        corners += ends if i % 2 == 0 else ends[::-1]
    uv = np.array(corners)
    return np.asarray((uv[:, ::-1] if swap else uv) + (west, south), dtype=np.float64)


def tour(box_m: Box, config: FlightConfig, seed: int) -> FloatArray:
    """(N, 2) corners of a round trip inside the box: legs of ``TOUR_LEG_M`` that turn by ``TOUR_TURN_RAD`` at
    most, drawn until they and the way back to the start make ``length_m``, ``TOUR_EXCESS`` of it at most.

    Raises FlightError when the box is too small.
    """
    low, high = _inner(box_m, config)
    rng = np.random.default_rng([seed, 2])
    for _ in range(TOUR_TRIES):
        corners, flown = [rng.uniform(low, high)], 0.0
        for _ in range(TOUR_TRIES):
            corner = rng.uniform(low, high)
            leg, back = (math.dist(corner, other) for other in (corners[-1], corners[0]))
            if not TOUR_LEG_M[0] <= leg <= TOUR_LEG_M[1] or _turn(*corners[-2:], corner) > TOUR_TURN_RAD:
                continue
            corners.append(corner)
            flown += leg
            if flown + back >= config.length_m:
                break
        closed = np.array([*corners, corners[0]])
        length = flown + math.dist(corners[-1], corners[0])
        wanted = config.length_m <= length <= TOUR_EXCESS * config.length_m
        if wanted and _turn(*closed[-3:]) <= TOUR_TURN_RAD:
            return closed
    raise FlightError(f"no round trip of {config.length_m:g} m fits the region; fly further or nearer")


def _turn(*corners: FloatArray) -> float:
    """Angle between the two legs of three corners, rad; of fewer, none."""
    if len(corners) < 3:
        return 0.0
    (ax, ay), (bx, by) = np.diff(corners, axis=0)
    return abs(math.atan2(ax * by - ay * bx, ax * bx + ay * by))


def fly(box_m: Box, config: FlightConfig, seed: int) -> Trajectory:
    """The flight along :func:`legs`. Raises FlightError when they do not fit, and as :func:`follow`."""
    return follow(legs(box_m, config), config.length_m, config, seed)


def follow(corners: FloatArray, length_m: float, config: FlightConfig, seed: int) -> Trajectory:
    """The flight from corner to corner (N, 2), ``length_m`` of it at most, at ten states per second,
    reproducible by its seed.

    Raises FlightError when it touches the ground or is too short to be one.
    """
    if config.altitude_swing_m >= config.altitude_m:
        raise FlightError(
            f"altitude_swing_m = {config.altitude_swing_m:g} reaches the ground from altitude_m = "
            f"{config.altitude_m:g}; fly higher or swing less"
        )
    rng = np.random.default_rng(seed)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    length = min(length_m, float(along[-1]))
    seconds = np.arange(0.0, length / config.speed_mps, 0.1)
    if len(seconds) < MIN_STATES:
        raise FlightError(
            f"{length:g} m at {config.speed_mps:g} m/s last less than {MIN_STATES / 10:g} s; "
            "fly further or more slowly"
        )
    xy = np.column_stack([np.interp(seconds * config.speed_mps, along, c) for c in corners.T])
    xy = _smooth(xy, 60)
    course = np.unwrap(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
    # Image-up looks along the course, so image-right lies 90 degrees to the right of it.
    yaw = _smooth(course[:, None], 30)[:, 0] - math.pi / 2.0 + math.radians(4.0) * _wave(seconds, 37.0, rng)
    altitude = config.altitude_m + config.altitude_swing_m * _wave(seconds, 61.0, rng)
    tilt = (
        math.radians(config.tilt_deg)
        * math.sqrt(2.0)
        * np.column_stack([_wave(seconds, 7.3, rng), _wave(seconds, 11.9, rng)])
    )
    stamps = START_NS + np.round(seconds * 1e9).astype(np.int64)
    return Trajectory(stamps, xy, altitude, yaw, tilt)


def _wave(seconds: FloatArray, period_s: float, rng: np.random.Generator) -> FloatArray:
    return np.asarray(np.sin(2.0 * math.pi * (seconds / period_s + rng.random())), dtype=np.float64)


def _smooth(values: FloatArray, count: int) -> FloatArray:
    """Moving average over ``count`` states, the ends held."""
    padded = np.pad(values, ((count // 2, count - 1 - count // 2), (0, 0)), mode="edge")
    kernel = np.full(count, 1.0 / count)
    columns = [np.convolve(column, kernel, mode="valid") for column in padded.T]
    return np.asarray(np.column_stack(columns), dtype=np.float64)
