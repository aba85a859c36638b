"""Flights without images: maps as in :mod:`buildloc_eval.observation`, with the keyframes they were made
from and what the latest frames saw.

A frame sees the buildings of the map that the path passes within HALF_FRAME_M of it. What it says of a
building has an error that all frames share (the segmenter draws the same roof too large on the same side
every time) and one of its own; a building of the map is where its frames put it on average. Keyframes lie on
the bent path: poses err as the map does, and in no other way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.reference.buildings import Buildings
from buildloc_matcher.window import frames_kept
from buildloc_msgs_py.types import FloatArray, FrameObservation, Keyframe, LocalMap
from scipy.spatial import cKDTree

from buildloc_eval.observation import (
    LONGEST_PATH_M,
    STARTS_TRIED,
    STEP_M,
    Digitiser,
    Met,
    ObservationError,
    Sensing,
    bend,
    fly_path,
    measured,
    met_along,
    turned,
)
from buildloc_eval.segmentation_errors import read_errors

KEYFRAME_STEPS = 5  # 25 m
HALF_FRAME_M = 40.0  # along the path
KEYFRAME_PERIOD_NS = 5_000_000_000
ALTITUDE_M = 100.0


@dataclass(frozen=True)
class FrameErrors:
    """How the frames of a flight differ: the share of a building's centroid error that is new in each, as a
    ratio of standard deviations, and the probability that a frame misses a building of the map."""

    own: float
    missed: float


def measured_frame_errors() -> FrameErrors:
    """Those of the segmenter. Raises ErrorModelError."""
    errors = read_errors()
    return FrameErrors(errors.centroid_frame_sigma_m / errors.centroid_sigma_m, errors.frame_missed)


@dataclass(frozen=True)
class Flown:
    """Ground that is flown over: its buildings, and the places (S, 2) where flights may start."""

    buildings: Buildings
    starts_m: FloatArray

    @cached_property
    def tree(self) -> cKDTree:
        """Of the centroids."""
        return cKDTree(self.buildings.centroids_m)


def everywhere(buildings: Buildings) -> Flown:
    """Flights start at any building."""
    return Flown(buildings, buildings.centroids_m)


@dataclass(frozen=True)
class ObservedFlight:
    """What a matcher is given, and the truth in the frame of the ground flown over: places (N, 2) m of the
    map's buildings, that of the camera (2,) at the last keyframe and the heading of image-right; the flight's
    length."""

    local_map: LocalMap
    keyframes: tuple[Keyframe, ...]
    observations: tuple[FrameObservation, ...]
    true_m: FloatArray
    camera_m: FloatArray
    yaw_rad: float
    path_m: float


def observe_flight(
    ground: Flown,
    count: int,
    model: Sensing,
    rng: np.random.Generator,
    digitiser: Digitiser,
    frame_errors: FrameErrors | None = None,
) -> ObservedFlight:
    """A flight until its map has ``count`` buildings.

    ``frame_errors``: as measured where none are given. Raises ObservationError when no start among many leads
    over enough buildings.
    """
    errors = frame_errors or measured_frame_errors()
    for _ in range(STARTS_TRIED):
        path = fly_path(ground.starts_m[rng.integers(len(ground.starts_m))], rng)
        met = met_along(ground.buildings, ground.tree, path, count, model, rng, digitiser)
        if met is not None:
            return _observed(ground.buildings, path, met, model, rng, digitiser, errors)
    raise ObservationError(f"no flight of {LONGEST_PATH_M:g} m meets {count} buildings; ask for fewer")


def _observed(
    buildings: Buildings,
    path: FloatArray,
    met: Met,
    model: Sensing,
    rng: np.random.Generator,
    digitiser: Digitiser,
    errors: FrameErrors,
) -> ObservedFlight:
    count = len(met.true_m)
    bent, drift = bend(path, model, rng)
    map_yaw, scale = rng.uniform(-math.pi, math.pi), 1.0 + rng.normal(0.0, model.scale_sigma)
    steps = np.arange(0, int(met.along.max()) + 1, KEYFRAME_STEPS)
    legs = np.diff(path[: steps[-1] + 2], axis=0)[steps]
    heading = np.arctan2(legs[:, 1], legs[:, 0]) - math.pi / 2.0  # of image-right: the camera looks ahead
    places, yaws = scale * turned(bent[steps], map_yaw), heading + drift[steps] + map_yaw

    in_view = np.abs(steps[:, None] - met.along) * STEP_M <= HALF_FRAME_M
    seen = in_view & (rng.random(in_view.shape) >= errors.missed)
    seen |= in_view & ~seen.any(axis=0)  # a building of the map was seen by some frame
    views = seen.sum(axis=0)
    shared = model.jitter_m * np.sqrt(1.0 - errors.own**2 / views)  # with the frames' mean: jitter_m
    apparent = met.true_m + shared[:, None] * rng.normal(0.0, 1.0, (count, 2))
    frame, building = np.nonzero(seen)
    levels = turned(apparent[building] - path[steps[frame]], -heading[frame])
    levels = scale * (levels + rng.normal(0.0, errors.own * model.jitter_m, levels.shape))
    put = places[frame] + turned(levels, yaws[frame])
    local = np.column_stack([np.bincount(building, put[:, axis], count) for axis in (0, 1)]) / views[:, None]

    areas, shapes = measured(buildings, met.source, scale, model, digitiser, rng)
    stamps = np.arange(len(steps)) * KEYFRAME_PERIOD_NS
    ids = np.arange(count, dtype=np.int64)
    local_map = LocalMap.whole(int(stamps[-1]), ids, local, areas, shapes, views.astype(np.int64))
    keyframes = tuple(
        Keyframe(int(stamp), float(x), float(y), float(yaw))
        for stamp, (x, y), yaw in zip(stamps, places, yaws, strict=True)
    )
    latest = range(max(0, len(steps) - frames_kept(MatcherConfig())), len(steps))
    observations = tuple(
        FrameObservation(int(stamps[k]), levels[frame == k], scale * ALTITUDE_M) for k in latest
    )
    length = float(steps[-1] * STEP_M)
    return ObservedFlight(
        local_map, keyframes, observations, met.true_m, path[steps[-1]], float(heading[-1]), length
    )


def mirrored(flight: ObservedFlight) -> ObservedFlight:
    """The same flight over the mirror image of its ground, which is nowhere: the truth is only formal."""
    flip = np.array([-1.0, 1.0])
    return replace(
        flight,
        local_map=replace(flight.local_map, centroids_m=flight.local_map.centroids_m * flip),
        keyframes=tuple(replace(k, x_m=-k.x_m, yaw_rad=-k.yaw_rad) for k in flight.keyframes),
        observations=tuple(replace(o, centroids_m=o.centroids_m * flip) for o in flight.observations),
    )


def scaled(flight: ObservedFlight, factor: float) -> ObservedFlight:
    """The same flight by an altimeter that is wrong by a factor."""
    mapped = flight.local_map
    return replace(
        flight,
        local_map=replace(
            mapped, centroids_m=factor * mapped.centroids_m, areas_m2=factor**2 * mapped.areas_m2
        ),
        keyframes=tuple(replace(k, x_m=factor * k.x_m, y_m=factor * k.y_m) for k in flight.keyframes),
        observations=tuple(
            replace(o, centroids_m=factor * o.centroids_m, altitude_m=factor * o.altitude_m)
            for o in flight.observations
        ),
    )
