"""Outlines shifted onto the walls of the reference: hand-drawn houses, and a flight over merged ones."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from buildloc_matcher.evidence import ground
from buildloc_matcher.geometry import Similarity, rotation
from buildloc_matcher.outline_fit import Walls, align, walls
from buildloc_matcher.reference.buildings import OUTLINE_UNIT_M, stored_outlines
from buildloc_matcher.refinement import Refined, Unrefined, refine
from buildloc_matcher.window import start
from buildloc_msgs_py.ground import OUTLINE_POINTS
from buildloc_msgs_py.types import FloatArray, FrameObservation, Keyframe
from numpy.typing import NDArray
from shapely import affinity
from shapely.geometry import Polygon, box
from towns import DEFAULT

HOUSE, NEIGHBOUR, FAR = box(0, 0, 12, 9), box(14, 0, 26, 9), box(60, 60, 80, 70)


def reference(*houses: Polygon) -> Walls:
    """Walls of houses as a database keeps them: to 0.1 m."""
    polygons = np.array(houses, dtype=object)
    centroids = shapely.get_coordinates(shapely.centroid(polygons))
    return walls(centroids[:, None] + OUTLINE_UNIT_M * stored_outlines(polygons, centroids))


def rings(*seen: Polygon) -> FloatArray:
    """(N, P, 2) points evenly along outlines, counter-clockwise."""
    borders = shapely.get_exterior_ring(shapely.orient_polygons(np.array(seen, dtype=object)))
    parts = np.arange(OUTLINE_POINTS) / OUTLINE_POINTS
    points = shapely.line_interpolate_point(borders[:, None], parts, normalized=True)
    return shapely.get_coordinates(points).reshape(len(seen), OUTLINE_POINTS, 2)


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (1.5, -1.0), (-2.0, 0.5)])
def test_a_house_is_put_onto_its_walls(x: float, y: float) -> None:
    found = align(rings(HOUSE) - (-x, -y), reference(FAR, HOUSE, NEIGHBOUR))
    # To the 0.1 m that outlines are kept to.
    np.testing.assert_allclose(found.shifts_m, [[-x, -y]], atol=0.1)
    assert found.buildings.tolist() == [1] and found.seen.tolist() == [False, True, False]
    np.testing.assert_allclose(found.certainty, [np.eye(2)], atol=0.05)


def test_one_blob_over_two_houses_lies_on_their_outer_walls() -> None:
    blob = box(0, 0, 26, 9)
    found = align(rings(blob) - (-1.0, 1.0), reference(HOUSE, NEIGHBOUR))
    np.testing.assert_allclose(found.shifts_m, [[-1.0, 1.0]], atol=0.15)
    assert found.seen.all()


def test_a_house_grown_on_one_side_stays_on_the_other_three() -> None:
    with_drive = box(0, -4.5, 12, 9)  # its centroid is 2.25 m off
    found = align(rings(with_drive), reference(HOUSE))
    assert np.hypot(*found.shifts_m[0]) < 1.0


def test_the_wall_across_the_alley_faces_the_other_way() -> None:
    # 1.5 m between the walls: without their directions the nearest would be the neighbour's.
    found = align(rings(HOUSE) - (-1.2, 0.0), reference(HOUSE, box(13.5, 0, 26, 9)))
    np.testing.assert_allclose(found.shifts_m, [[-1.2, 0.0]], atol=0.1)


def test_what_fits_no_walls_is_no_building_of_the_reference() -> None:
    shed = shapely.Point(30.0, 30.0).buffer(4.0)
    found = align(rings(shed, HOUSE), reference(HOUSE))
    assert found.buildings.tolist() == [-1, 0]
    assert align(rings(HOUSE), reference(box(0, 0, 9000, 9))).buildings.tolist() == [-1]  # without an outline
    assert align(np.empty((0, OUTLINE_POINTS, 2)), reference(HOUSE)).shifts_m.shape == (0, 2)


def test_along_a_long_wall_nothing_is_told() -> None:
    terrace = box(-300, 0, 300, 9)
    found = align(rings(box(-20, 0, 20, 9)), reference(terrace))
    assert found.certainty[0, 0, 0] < 0.05 < 0.95 < found.certainty[0, 1, 1]


def pairs_of_houses(rng: np.random.Generator, count: int) -> NDArray[np.object_]:
    """(count, 2) houses side by side or one behind the other, every pair some 70 m from the next."""
    houses: list[list[Polygon]] = []
    for i in range(count):
        x, y = 70.0 * np.array(divmod(i, 6)) + rng.uniform(-12.0, 12.0, 2)
        first, second, deep = rng.uniform(7.0, [9.0, 18.0, 10.0])
        pair = [box(0, 0, first, deep), box(first + 3.0, 0, first + 3.0 + second, deep)]
        turn = float(rng.choice([0.0, 90.0]))
        houses.append([affinity.translate(affinity.rotate(one, turn, (0, 0)), x, y) for one in pair])
    return np.array(houses, dtype=object)


@pytest.mark.parametrize("seed", range(4))
def test_merged_pairs_are_placed_by_their_walls(seed: int) -> None:
    houses = pairs_of_houses(np.random.default_rng(seed), 36)
    blobs = shapely.envelope(shapely.union(houses[:, 0], houses[:, 1]))
    middles, around = shapely.get_coordinates(shapely.centroid(blobs)), rings(*blobs)
    poses = [Keyframe(i + 1, 100.0 + 12.0 * i, 150.0 + 8.0 * i, 0.2 * i) for i in range(15)]
    seen = []
    for pose in poses:
        place, turn = (pose.x_m, pose.y_m), rotation(pose.yaw_rad)
        near = np.hypot(*(middles - place).T) < 110.0
        level, outlines = (middles[near] - place) @ turn, (around[near] - place) @ turn
        seen.append(FrameObservation(pose.stamp_ns, level, 100.0, outlines))
    centroids, areas = shapely.get_coordinates(shapely.centroid(houses.ravel())), np.full(72, 100.0)
    outlined = ground(centroids, areas, stored_outlines(houses.ravel(), centroids))
    last, begun = (poses[-1].x_m, poses[-1].y_m), Similarity((0.0, 0.0), (1.5, -1.0), 0.0)
    refined = refine(start(begun, poses, DEFAULT), seen, outlined, DEFAULT)
    assert isinstance(refined, Refined), refined
    np.testing.assert_allclose(refined.position_m, last, atol=0.2)
    # The middle of two houses is the place of neither: without walls that is metres or a refusal.
    without = refine(start(begun, poses, DEFAULT), seen, ground(centroids, areas), DEFAULT)
    assert isinstance(without, Unrefined) or np.hypot(*(without.position_m - last)) > 1.0
