"""Descriptors, Eq. 1 to 4, hypotheses and refinement, against plain oracles and known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.database import assemble
from buildloc_matcher.descriptors import Stars, stars
from buildloc_matcher.geometry import Similarity, fit_rigid, fit_similarity, rotation
from buildloc_matcher.hypotheses import hypothesize
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.matching import Matches, index_stars, match_stars
from buildloc_matcher.refinement import covariance_enu, refine
from buildloc_matcher.selection import mnn_jaccard, mutual_pairs, observable
from buildloc_matcher.voting import consistent
from buildloc_msgs_py.footprint import footprint
from buildloc_msgs_py.types import Fix, FrameObservation, Keyframe, LocalMap, NoFix
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from shapely import affinity
from shapely.geometry import box

CONFIG = MatcherConfig()
EPSG = 32619


def buildings(seed: int, count: int, side_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random rectangles: centroids (N, 2), areas (N,), shapes (N, 4); no two closer than 12 m."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, side_m, (2 * count, 2))
    clash = cKDTree(points).query_pairs(12.0, output_type="ndarray")
    points = np.delete(points, np.unique(clash[:, 1]), axis=0)[:count]
    rows = []
    for x, y in points:
        width, length = rng.uniform(7.0, 14.0), rng.uniform(9.0, 28.0)
        outline = affinity.rotate(
            box(x - width / 2, y - length / 2, x + width / 2, y + length / 2), rng.uniform(0, 180)
        )
        rows.append((footprint(outline).area_m2, *footprint(outline).shape))
    table = np.array(rows)
    return points, table[:, 0], table[:, 1:]


def oracle(query: Stars, reference: Stars, config: MatcherConfig) -> list[list[tuple[float, int]]]:
    """Eq. 1 and 2 word for word, one pair at a time."""
    tau = math.radians(config.tau_angle_deg)
    answer = []
    for q in query.features:
        found = []
        for index, r in enumerate(reference.features):
            d_angle = sum(abs(q[i] - r[i]) for i in range(3))
            d_perimeter = abs(q[3] - r[3]) / max(q[3], r[3])
            d_shape = sum(abs(q[i] - r[i]) for i in range(4, 8)) / 4
            if d_angle >= tau or d_perimeter > config.tau_perimeter or d_shape > config.tau_shape:
                continue
            score = 0.0
            for t in range(0, 32, 8):
                angle = max(0.0, 1 - sum(abs(q[t + i] - r[t + i]) for i in range(3)) / tau)
                ratio = min(q[t + 3], r[t + 3]) / max(q[t + 3], r[t + 3])
                shape = 1 - sum(abs(q[t + i] - r[t + i]) for i in range(4, 8)) / 4
                score += (2 * angle + ratio + shape) / 4
            found.append((score / 4, index))
        answer.append(sorted(found, key=lambda pair: (-pair[0], pair[1]))[: config.matches_per_star])
    return answer


def test_matching_equals_the_oracle() -> None:
    points, _, shapes = buildings(1, 250, 700.0)
    others, _, other_shapes = buildings(2, 40, 280.0)
    config = MatcherConfig(matches_per_star=7)
    query, reference = stars(others, other_shapes), stars(points, shapes)
    matches = match_stars(query, index_stars(reference), config)
    expected = [(q, i, s) for q, row in enumerate(oracle(query, reference, config)) for s, i in row]
    assert len(matches) == len(expected) > 100
    assert list(zip(matches.query, matches.reference, strict=True)) == [(q, i) for q, i, _ in expected]
    np.testing.assert_allclose(matches.score, [s for _, _, s in expected], rtol=1e-12)


@settings(max_examples=25, deadline=None)
@given(
    yaw=st.floats(-math.pi, math.pi),
    x=st.floats(-1e5, 1e5),
    y=st.floats(-1e5, 1e5),
    seed=st.integers(0, 1000),
)
def test_descriptors_do_not_change_with_rotation_shift_and_order(
    yaw: float, x: float, y: float, seed: int
) -> None:
    points, _, shapes = buildings(3, 60, 350.0)
    order = np.random.default_rng(seed).permutation(len(points))
    moved = (points @ rotation(yaw).T + [x, y])[order]
    one, two = stars(points, shapes), stars(moved, shapes[order])
    assert len(one) == len(two)
    named = {tuple(sorted(t)): (tuple(t), f) for t, f in zip(one.triangles, one.features, strict=True)}
    for triangle, features in zip(order[two.triangles], two.features, strict=True):
        vertices, expected = named[tuple(sorted(triangle))]
        assert vertices == tuple(triangle)
        np.testing.assert_allclose(features, expected, atol=1e-6)


@pytest.mark.parametrize("points", [np.empty((0, 2)), np.ones((3, 2)), np.column_stack([np.arange(9.0)] * 2)])
def test_too_few_or_collinear_buildings_have_no_stars(points: np.ndarray) -> None:
    assert len(stars(points, np.zeros((len(points), 4)))) == 0


def test_star_of_four_hand_drawn_triangles() -> None:
    points = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0], [5.0, 6.0], [-4.0, 1.0], [1.0, -5.0]])
    found = stars(points, np.tile([0.1, 0.2, 0.3, 0.4], (6, 1)))
    central = [f for t, f in zip(found.triangles, found.features, strict=True) if set(t) == {0, 1, 2}]
    assert len(central) == 1
    angles = [math.atan2(3, 4), math.atan2(4, 3), math.pi / 2]
    np.testing.assert_allclose(central[0][:8], [*angles, 12.0, 0.1, 0.2, 0.3, 0.4])


def test_hypotheses_recover_the_transform_and_reject_mirrors_and_scale() -> None:
    points, _, shapes = buildings(4, 40, 250.0)
    query = stars(points, shapes)
    same = Matches(np.arange(len(query)), np.arange(len(query)), np.ones(len(query)), len(query))
    centre = points.mean(axis=0)

    def found(world: np.ndarray):  # type: ignore[no-untyped-def]
        return hypothesize(same, query, points, query, world, centre, CONFIG)

    truth = Similarity((centre[0], centre[1]), (500.0, -90.0), 2.5, 1.1)
    right = found(truth.apply(points))
    assert len(right) == len(query)
    np.testing.assert_allclose(right.positions_m, np.tile([500.0, -90.0], (len(query), 1)), atol=1e-6)
    np.testing.assert_allclose(right.yaws_rad, 2.5)
    np.testing.assert_allclose(right.scales, 1.1)
    mirrored = found(points * [-1.0, 1.0])
    assert len(mirrored) == 0 and mirrored.mirrored == len(query)
    large = found(points * 1.2)
    assert len(large) == 0 and large.off_scale == len(query)


def test_consistent_yaws_wrap_around() -> None:
    yaws = np.array([math.pi - 0.02, -math.pi + 0.03, 0.5, 1.0, -math.pi + 0.01])
    assert set(consistent(yaws, np.ones(5), 0.1)) == {0, 1, 4}
    assert set(consistent(yaws, np.array([1.0, 1.0, 9.0, 1.0, 1.0]), 0.1)) == {2}
    assert set(consistent(yaws, np.ones(5), math.pi)) == {0, 1, 2, 3, 4}


def test_mutual_pairs_and_jaccard_by_hand() -> None:
    query = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]])
    reference = np.array([[1.0, 0.0], [4.0, 0.0], [100.0, 3.0], [100.0, 160.0], [50.0, 50.0], [900.0, 0.0]])
    assert mutual_pairs(query, reference, 25.0).tolist() == [[0, 0], [1, 2]]
    assert observable(query, reference, 15.0, 60.0).tolist() == [0, 1, 2]
    assert observable(query, reference, 15.0, 80.0).tolist() == [0, 1, 2, 4]
    score, pairs = mnn_jaccard(query, reference, CONFIG)
    assert score == pytest.approx(2 / (4 + 3 - 2)) and pairs.tolist() == [[0, 0], [1, 2]]
    assert mnn_jaccard(np.empty((0, 2)), reference, CONFIG)[0] == 0.0


def test_fits_recover_known_motions() -> None:
    points = buildings(5, 20, 200.0)[0]
    truth = Similarity((10.0, 20.0), (70.0, -5.0), -2.0, 1.0)
    np.testing.assert_allclose(
        fit_rigid(points, truth.apply(points)).apply(points), truth.apply(points), atol=1e-9
    )
    scaled = Similarity((10.0, 20.0), (70.0, -5.0), 1.0, 1.07)
    assert fit_similarity(points, scaled.apply(points), 0.15).scale == pytest.approx(1.07)
    assert fit_similarity(points, scaled.apply(points), 0.05).scale == pytest.approx(1.05)


def frames_of(
    points: np.ndarray, poses: list[Keyframe], radius_m: float, noise_m: float, seed: int
) -> list[FrameObservation]:
    """What each pose sees of map points (N, 2), in its level camera frame."""
    rng = np.random.default_rng(seed)
    seen = []
    for pose in poses:
        level = (points - [pose.x_m, pose.y_m]) @ rotation(pose.yaw_rad)
        level = level[np.linalg.norm(level, axis=1) < radius_m]
        seen.append(FrameObservation(pose.stamp_ns, level + rng.normal(0.0, noise_m, level.shape), 105.0))
    return seen


def test_refinement_recovers_a_known_shift_and_turn() -> None:
    points = buildings(6, 400, 900.0)[0]
    poses = [Keyframe(i, 200.0 + 25.0 * i, 400.0 + 5.0 * i, 0.3 * i) for i in range(1, 21)]
    seen = frames_of(points, poses, 110.0, 0.3, 1)
    coarse = Similarity((450.0, 450.0), (450.0 + 6.0, 450.0 - 5.0), math.radians(1.0))
    refined = refine(coarse, poses, seen, points, cKDTree(points), CONFIG)
    assert refined is not None
    np.testing.assert_allclose(refined.position_m, [poses[-1].x_m, poses[-1].y_m], atol=0.3)
    assert refined.yaw_rad == pytest.approx(math.remainder(poses[-1].yaw_rad, 2 * math.pi), abs=0.005)
    assert refined.rms_m < 1.0
    assert np.all(np.diag(covariance_enu(refined, CONFIG))[:2] >= 9.0)
    assert refine(coarse, [], seen, points, cKDTree(points), CONFIG) is None
    assert refine(coarse, poses, [], points, cKDTree(points), CONFIG) is None


CITY = buildings(7, 3000, 2600.0)
WRONG_CITY = buildings(8, 3000, 2600.0)


def flight(seed: int) -> tuple[LocalMap, list[Keyframe], list[FrameObservation], np.ndarray]:
    """A noisy rotated local map of the city around an 800 m path, and the true last position."""
    points, areas, shapes = CITY
    rng = np.random.default_rng(seed)
    path = np.column_stack([np.linspace(800.0, 1500.0, 25), np.linspace(900.0, 1250.0, 25)])
    yaw = float(rng.uniform(-math.pi, math.pi))
    near = np.flatnonzero(cKDTree(path).query(points)[0] < 120.0)
    near = near[rng.random(len(near)) > 0.1]
    turn = rotation(-yaw)
    centroids = (points[near] - path[0]) @ turn.T + rng.normal(0.0, 0.8, (len(near), 2))
    local = (path - path[0]) @ turn.T
    poses = [Keyframe((i + 1) * 10**9, float(x), float(y), 0.1 * i) for i, (x, y) in enumerate(local)]
    seen = frames_of((points - path[0]) @ turn.T, poses, 90.0, 0.8, seed)
    local_map = LocalMap(
        poses[-1].stamp_ns,
        np.arange(len(near)),
        centroids,
        areas[near],
        np.clip(shapes[near] + rng.normal(0.0, 0.03, (len(near), 4)), 0.0, 1.0),
        np.full(len(near), 3),
    )
    return local_map, poses, seen, path[-1]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_noisy_map_is_located_within_5_m(seed: int) -> None:
    local_map, poses, seen, truth = flight(seed)
    shift = np.array([320_000.0, 4_700_000.0])
    matcher = Matcher(assemble(EPSG, CITY[0] + shift, CITY[1], CITY[2], CONFIG), CONFIG)
    answer = matcher.fix(local_map, poses, seen)
    assert isinstance(answer.result, Fix), answer
    error = math.hypot(
        answer.result.easting_m - truth[0] - shift[0], answer.result.northing_m - truth[1] - shift[1]
    )
    assert error < 5.0
    assert answer.result.stamp_ns == local_map.stamp_ns and answer.result.altitude_m == 105.0
    assert answer.candidates[0].acceptance >= 1.0
    assert (answer.result.latitude_deg, answer.result.longitude_deg) == pytest.approx((42.4, -71.2), abs=0.3)
    assert matcher.fix(local_map, poses, seen).result.__dict__.keys() == answer.result.__dict__.keys()


def test_the_wrong_city_gives_no_fix() -> None:
    matcher = Matcher(assemble(EPSG, *WRONG_CITY, CONFIG), CONFIG)
    for seed in range(4):
        local_map, poses, seen, _ = flight(seed)
        answer = matcher.fix(local_map, poses, seen)
        assert isinstance(answer.result, NoFix)
        assert answer.result.reason and answer.result.stamp_ns == local_map.stamp_ns


def test_small_maps_say_why_there_is_no_fix() -> None:
    matcher = Matcher(assemble(EPSG, *CITY, CONFIG), CONFIG)
    for count in (0, 3, 8):
        some = LocalMap(
            5,
            np.arange(count),
            CITY[0][:count],
            CITY[1][:count],
            CITY[2][:count],
            np.ones(count, dtype=np.int64),
        )
        answer = matcher.fix(some, [Keyframe(5, 0.0, 0.0, 0.0)], [])
        assert isinstance(answer.result, NoFix) and "fewer than 12" in answer.result.reason
