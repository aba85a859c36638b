"""Does the reference agree with a prediction? Frames over a made-up town, and over a street grid."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_matcher.acceptance import Outcome
from buildloc_matcher.follow import Followed, Seen, ask, seen_in_world
from buildloc_matcher.geometry import Similarity, rotation, wrap
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.refinement import registration_covariance
from buildloc_msgs_py.types import FloatArray, FrameObservation, Keyframe
from towns import DEFAULT, ORIGIN_M, Buildings, alike, lattice, town, whole

TOWN = town(101, 6000, 2400.0)  # a building every 31 m
MATCHER = Matcher(whole(TOWN), DEFAULT)
START = np.array(ORIGIN_M) + 1200.0
TURN = 0.8  # of the map in the world
YAW = 0.3  # of the images in the map
STEPS = 8
# A keyframe of 150 x 90 m every 40 m.
KEYFRAMES = [Keyframe(i, 40.0 * i, 0.0, YAW) for i in range(STEPS)]
TRUE = Similarity((0.0, 0.0), (float(START[0]), float(START[1])), TURN)
SURE = np.diag([4.0, 4.0, math.radians(1.0) ** 2])


def frames(seen: Buildings, noise_m: float = 0.5) -> list[FrameObservation]:
    """What the keyframes see of buildings, every centroid with an error of its own."""
    rng = np.random.default_rng(7)
    observations = []
    for keyframe, place in zip(
        KEYFRAMES, TRUE.apply(np.array([(k.x_m, k.y_m) for k in KEYFRAMES])), strict=True
    ):
        level = (seen.centroids_m - place) @ rotation(YAW + TURN)
        level = level[(np.abs(level) < (75.0, 45.0)).all(axis=1)]
        level = level + rng.normal(0.0, noise_m, level.shape)
        observations.append(FrameObservation(keyframe.stamp_ns, level, 100.0))
    return observations


def dense(points_m: FloatArray) -> Seen:
    """Buildings as close as in a town."""
    return Seen(np.asarray(points_m), 1000.0 * len(points_m))


def predicted(east_m: float, north_m: float) -> Similarity:
    """A prediction that is wrong by this."""
    x, y = TRUE.world_m
    return Similarity(TRUE.anchor_m, (x + east_m, y + north_m), TURN)


def follow(seen: Buildings, east_m: float = 0.0, north_m: float = 0.0, spread: FloatArray = SURE) -> Followed:
    return MATCHER.follow(predicted(east_m, north_m), spread, KEYFRAMES, frames(seen))


def test_the_reference_agrees_with_what_is_there_and_corrects_it() -> None:
    followed = follow(TOWN, 2.0, -1.5)
    assert followed.opinion.outcome is Outcome.ACCEPTED and followed.agreement is not None
    assert followed.opinion.nats > 20.0 and followed.opinion.lead > 20.0
    x, y, yaw = followed.agreement.poses[STEPS - 1]
    # Errors of 0.5 m in some twenty buildings, and lever arms.
    assert math.dist((x, y), TRUE.apply(np.array([[40.0 * (STEPS - 1), 0.0]]))[0]) < 0.6
    assert float(wrap(yaw - YAW - TURN)) == pytest.approx(0.0, abs=0.01)
    assert followed.agreement.scale == 1.0


def test_without_buildings_nothing_is_decided() -> None:
    followed = follow(TOWN.select(np.zeros(len(TOWN), dtype=bool)))
    assert followed.opinion.outcome is Outcome.UNDECIDED and followed.agreement is None
    assert "could not tell: 0 buildings" in followed.opinion.reason


def test_buildings_that_the_reference_does_not_have_disagree() -> None:
    followed = follow(town(102, 6000, 2400.0))
    assert followed.opinion.outcome is Outcome.REJECTED and followed.agreement is None
    assert "has not what was seen" in followed.opinion.reason


def test_a_correction_beyond_the_uncertainty_is_a_jump() -> None:
    strict = Matcher(MATCHER.database, replace(DEFAULT, max_jump_sigmas=2.0))
    spread = np.diag([0.01, 0.01, 1e-6]) + registration_covariance(DEFAULT)
    followed = strict.follow(predicted(9.0, 0.0), spread, KEYFRAMES, frames(TOWN))
    assert followed.opinion.outcome is Outcome.REJECTED and followed.agreement is None
    assert "the place jumped by" in followed.opinion.reason


def test_the_registration_of_the_reference_excuses_no_jump() -> None:
    """It moves prediction and correction alike: with 1.5 m of it counted twice, 9 m would be 4.2 sigma."""
    spread = np.diag([0.04, 0.04, 1e-6]) + registration_covariance(DEFAULT)
    assert follow(TOWN, 1.0, 0.0, spread).opinion.outcome is Outcome.ACCEPTED
    followed = follow(TOWN, 9.0, 0.0, spread)
    assert followed.opinion.outcome is Outcome.REJECTED and "jumped by 9" in followed.opinion.reason


def test_a_street_grid_that_fits_next_door_decides_nothing_once_the_next_door_is_possible() -> None:
    grid = lattice(30, 30, 24.0)
    reference = alike(grid.centroids_m)
    middle = grid.centroids_m.mean(axis=0)
    near = grid.centroids_m[np.abs(grid.centroids_m - middle).max(axis=1) < 60.0]
    here, none = dense(near), np.zeros(2)
    assert ask(here, none, SURE, reference, DEFAULT).outcome is Outcome.ACCEPTED
    wide = np.diag([100.0, 100.0, 1e-4])  # 30 m at three sigma: the neighbour is 24 m away
    opinion = ask(here, none, wide, reference, DEFAULT)
    assert opinion.outcome is Outcome.UNDECIDED and opinion.lead < 2.0


def test_a_better_place_within_the_uncertainty_is_a_disagreement() -> None:
    seen = seen_in_world({k.stamp_ns: _pose(k) for k in KEYFRAMES}, frames(TOWN), 8, DEFAULT)
    wide, away = np.diag([100.0, 100.0, 1e-4]), np.array([15.0, 0.0])
    opinion = ask(replace(seen, points_m=seen.points_m + away), away, wide, MATCHER.database.ground, DEFAULT)
    assert opinion.outcome is Outcome.REJECTED and "near by fits better" in opinion.reason


def test_a_pose_that_went_far_has_to_lead_places_as_far_again() -> None:
    """A start that was sure of itself, and wrong by two houses, is no reason against the right place; but
    places around are asked then that such a start would not have left open."""
    seen = seen_in_world({k.stamp_ns: _pose(k) for k in KEYFRAMES}, frames(TOWN), 8, DEFAULT)
    opinion = ask(seen, np.array([40.0, 0.0]), SURE, MATCHER.database.ground, DEFAULT)
    assert opinion.outcome is Outcome.ACCEPTED
    grid = lattice(30, 30, 24.0)
    middle = grid.centroids_m.mean(axis=0)
    near = dense(grid.centroids_m[np.abs(grid.centroids_m - middle).max(axis=1) < 60.0])
    street = alike(grid.centroids_m)
    assert ask(near, np.zeros(2), SURE, street, DEFAULT).outcome is Outcome.ACCEPTED
    assert ask(near, np.array([24.0, 0.0]), SURE, street, DEFAULT).outcome is Outcome.UNDECIDED


def test_after_a_silence_all_that_was_seen_in_it_counts() -> None:
    """One building in the latest four frames says nothing; those before them do."""
    sparse = [
        replace(seen, centroids_m=seen.centroids_m[: 6 if at < STEPS - 4 else 0])
        for at, seen in enumerate(frames(TOWN))
    ]
    arguments = predicted(1.0, 0.0), SURE, KEYFRAMES, sparse
    assert MATCHER.follow(*arguments).opinion.outcome is Outcome.UNDECIDED
    assert MATCHER.follow(*arguments, unanswered=STEPS).opinion.outcome is Outcome.ACCEPTED


def _pose(keyframe: Keyframe) -> tuple[float, float, float]:
    x, y = TRUE.apply(np.array([[keyframe.x_m, keyframe.y_m]]))[0].tolist()
    return x, y, YAW + TURN


def test_what_several_frames_saw_counts_once_and_only_the_latest_count() -> None:
    level = np.array([[10.0, 0.0], [-10.0, 5.0]])
    observations = [FrameObservation(i, level, 100.0) for i in range(4)]
    poses = {i: (20.0 * i, 0.0, 0.0) for i in range(3)}  # the fourth has no place
    # Frames 2 and 1: (50, 0), (30, 5) and (30, 0), which is (30, 5) again, (10, 5).
    seen = seen_in_world(poses, observations, 2, DEFAULT)
    assert seen.points_m.tolist() == [[50.0, 0.0], [30.0, 5.0], [10.0, 5.0]]
    # Two discs, 20 m apart, by cells of 10 m.
    radius = DEFAULT.observable_radius_m
    assert seen.area_m2 == pytest.approx(math.pi * radius**2 + 2.0 * radius * 20.0, rel=0.05)
    nothing = seen_in_world({}, observations, 2, DEFAULT)
    assert nothing.points_m.shape == (0, 2) and nothing.area_m2 == 0.0


def test_where_hardly_any_buildings_are_seen_most_may_be_invented() -> None:
    """Of 130 on a square kilometre, half of match_share at least is still taken for real."""
    ten = np.zeros((10, 2))
    assert Seen(ten, 1e4).share(DEFAULT) == DEFAULT.match_share  # 1000 on a square kilometre
    assert Seen(ten, 4e4).share(DEFAULT) == pytest.approx(1.0 - 130.0 / 250.0)
    assert Seen(ten, 2e5).share(DEFAULT) == DEFAULT.match_share / 2.0
    # Seven sheds along three kilometres that the reference has not are no reason to give a place up.
    far = Seen(TOWN.centroids_m[:7] + 1e5, 3e5)
    ground = MATCHER.database.ground
    assert ask(far, np.zeros(2), SURE, ground, DEFAULT).outcome is Outcome.UNDECIDED
    assert ask(replace(far, area_m2=1e4), np.zeros(2), SURE, ground, DEFAULT).outcome is Outcome.REJECTED
