"""Flights without images: their maps, keyframes and frames agree with each other and with the truth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_eval.observation import Digitiser, ObservationError, Sensing, sensing
from buildloc_eval.observed_flight import (
    Flown,
    FrameErrors,
    ObservedFlight,
    everywhere,
    measured_frame_errors,
    mirrored,
    observe_flight,
    scaled,
)
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.geometry import Similarity, rotation
from buildloc_matcher.reference.buildings import Buildings
from buildloc_matcher.window import frames_kept
from buildloc_msgs_py.types import FloatArray

SAME = Digitiser(0.0, 0.0, 1e-9, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0))
PERFECT = Sensing(0.0, 0.0, 0.0, 0.0, 0.0)
STEADY = FrameErrors(0.4, 0.0)


def town(count: int = 4000, side_m: float = 2500.0) -> Flown:
    rng = np.random.default_rng(3)
    areas = np.exp(rng.normal(5.0, 0.5, count)).astype(np.float32)
    shapes = rng.uniform(0.5, 1.0, (count, 4)).astype(np.float32)
    points = np.add(rng.uniform(0.0, side_m, (count, 2)), (330_000.0, 4_700_000.0))
    return everywhere(Buildings(points, areas, shapes))


def flown(
    model: Sensing, seed: int, count: int = 60, digitiser: Digitiser = SAME, errors: FrameErrors = STEADY
) -> ObservedFlight:
    return observe_flight(town(), count, model, np.random.default_rng(seed), digitiser, errors)


def in_map(flight: ObservedFlight) -> FloatArray:
    """All that the latest frames saw, put into the map by their keyframes."""
    poses = {k.stamp_ns: k for k in flight.keyframes}
    placed = [
        (poses[o.stamp_ns].x_m, poses[o.stamp_ns].y_m) + o.centroids_m @ rotation(poses[o.stamp_ns].yaw_rad).T
        for o in flight.observations
    ]
    return np.concatenate(placed)


def to_world(flight: ObservedFlight) -> Similarity:
    """Map -> world by the truth of the last keyframe alone."""
    last = flight.keyframes[-1]
    at = (float(flight.camera_m[0]), float(flight.camera_m[1]))
    return Similarity((last.x_m, last.y_m), at, flight.yaw_rad - last.yaw_rad)


@pytest.mark.parametrize("seed", range(3))
def test_the_true_pose_of_the_last_keyframe_puts_an_errorless_map_on_its_buildings(seed: int) -> None:
    flight, tree = flown(PERFECT, seed), town().tree
    distance, row = tree.query(to_world(flight).apply(flight.local_map.centroids_m))
    assert distance.max() < 1e-6 and len(np.unique(row)) == 60
    np.testing.assert_allclose(flight.true_m, to_world(flight).apply(flight.local_map.centroids_m), atol=1e-6)
    seen, _ = tree.query(to_world(flight).apply(in_map(flight)))
    assert seen.max() < 1e-6
    last = flight.observations[-1]
    assert last.stamp_ns == flight.keyframes[-1].stamp_ns == flight.local_map.stamp_ns
    assert len(flight.observations) == min(frames_kept(MatcherConfig()), len(flight.keyframes))
    assert np.hypot(*last.centroids_m.T).max() < math.hypot(70.0, 45.0)  # a swath's half, a frame's half
    places = np.array([(k.x_m, k.y_m) for k in flight.keyframes])
    steps = np.hypot(*np.diff(places, axis=0).T)
    assert max(steps) == pytest.approx(25.0, abs=1e-6)  # less at a turn


def test_a_building_of_the_map_is_where_its_frames_put_it_on_average() -> None:
    model = replace(sensing(1), heading_walk_deg=0.0)
    flight = flown(model, 5, 40)
    put = in_map(flight)
    distance = np.hypot(*(put[:, None] - flight.local_map.centroids_m).transpose(2, 0, 1))
    nearest = np.argmin(distance, axis=1)
    views = np.bincount(nearest, minlength=40)
    whole = np.flatnonzero(views == flight.local_map.observations)  # all of its frames are among the latest
    assert len(whole) > 20
    for building in whole:
        mean = put[nearest == building].mean(axis=0)
        np.testing.assert_allclose(mean, flight.local_map.centroids_m[building], atol=1e-6)


def test_the_map_errs_as_its_level_says_however_the_frames_share_it() -> None:
    model = replace(PERFECT, jitter_m=1.2)
    for own in (0.0, 0.4, 0.9):
        apart = []
        for seed in range(8):
            flight = flown(model, seed, 100, errors=FrameErrors(own, 0.0))
            placed = to_world(flight).apply(flight.local_map.centroids_m)
            _, row = town().tree.query(placed)
            away = placed - town().buildings.centroids_m[row]
            apart.append(away[np.hypot(*away.T) < 4.0])
        # Neighbours closer than the error take some of its tail: 1.2 m of a spacing of 40 m.
        assert np.concatenate(apart).std() == pytest.approx(1.2, rel=0.08)


def test_frames_miss_the_share_that_they_should_and_no_building_goes_unseen() -> None:
    flight = flown(PERFECT, 1, 100, errors=FrameErrors(0.4, 0.3))
    full = flown(PERFECT, 1, 100, errors=FrameErrors(0.4, 0.0))
    assert flight.local_map.observations.min() >= 1
    share = flight.local_map.observations.sum() / full.local_map.observations.sum()
    assert share == pytest.approx(0.7, abs=0.06)
    errors = measured_frame_errors()
    assert 0.0 < errors.own < 1.0 and 0.0 < errors.missed < 0.2


def test_a_mirrored_flight_fits_the_mirror_image_alone() -> None:
    flight = mirrored(flown(PERFECT, 2))
    np.testing.assert_allclose(in_map(flight) * (-1.0, 1.0), in_map(flown(PERFECT, 2)), atol=1e-9)
    distance, _ = town().tree.query(to_world(flight).apply(flight.local_map.centroids_m))
    assert np.median(distance) > 5.0


def test_a_scaled_flight_is_larger_by_the_factor_in_all_that_is_metric() -> None:
    flight, large = flown(PERFECT, 2), scaled(flown(PERFECT, 2), 1.1)
    np.testing.assert_allclose(large.local_map.centroids_m, 1.1 * flight.local_map.centroids_m)
    np.testing.assert_allclose(large.local_map.areas_m2, 1.21 * flight.local_map.areas_m2)
    np.testing.assert_allclose(in_map(large), 1.1 * in_map(flight), atol=1e-9)
    assert large.observations[0].altitude_m == pytest.approx(1.1 * flight.observations[0].altitude_m)
    np.testing.assert_array_equal(large.camera_m, flight.camera_m)


def test_flights_start_where_they_may_and_are_those_of_their_seed() -> None:
    ground = town()
    corner = Flown(ground.buildings, ground.buildings.centroids_m[:1])
    drawn = [
        observe_flight(corner, 20, sensing(1), np.random.default_rng(seed), SAME, STEADY) for seed in (4, 4)
    ]
    np.testing.assert_array_equal(drawn[0].local_map.centroids_m, drawn[1].local_map.centroids_m)
    start = drawn[0].camera_m - corner.starts_m[0]
    assert np.hypot(*start) <= drawn[0].path_m + 5.0
    with pytest.raises(ObservationError, match="ask for fewer"):
        observe_flight(corner, 5000, sensing(1), np.random.default_rng(1), SAME, STEADY)
