"""Many footprints at once: the same as one by one, as shapely measures them, wherever they lie."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import footprint, footprints
from numpy.typing import NDArray
from shapely import affinity
from shapely.geometry import Polygon, box

UTM = (331_234.567, 4_701_234.567)


def outlines(count: int, seed: int) -> NDArray[np.object_]:
    """Star-shaped polygons around the origin, 3 to 12 corners, 1 to 100 m wide, some of them thin."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        corners = int(rng.integers(3, 13))
        angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, corners))
        radius = rng.uniform(0.3, 1.0, corners) * 10.0 ** rng.uniform(0.3, 2.0)
        xy = np.column_stack([np.cos(angle), np.sin(angle)]) * radius[:, None] * [1.0, rng.uniform(0.1, 1.0)]
        found.append(Polygon(xy))
    values = np.array(found, dtype=object)
    return values[shapely.is_valid(values) & (shapely.area(values) > 0.1)]


def moved(values: NDArray[np.object_], angle_rad: float, shift: tuple[float, float]) -> NDArray[np.object_]:
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    return np.asarray(shapely.transform(values, lambda xy: xy @ rotation + shift), dtype=object)


def test_the_measures_are_shapelys() -> None:
    values = outlines(2000, 1)
    found = footprints(values)
    rectangles = shapely.minimum_rotated_rectangle(values)
    np.testing.assert_allclose(found.areas_m2 / found.shapes[:, 2], shapely.area(rectangles), rtol=1e-9)
    np.testing.assert_allclose(found.centroids_m, shapely.get_coordinates(shapely.centroid(values)))
    circle = 4.0 * np.pi * found.areas_m2 / shapely.length(values) ** 2
    np.testing.assert_allclose(found.shapes[:, 0], circle)
    np.testing.assert_allclose(found.shapes[:, 3], found.areas_m2 / shapely.area(shapely.convex_hull(values)))
    # Its sides are shapely's too, unless three corners carry two rectangles of one area, as in triangles.
    corners = shapely.get_coordinates(rectangles).reshape(-1, 5, 2)[:, :3]
    sides = np.linalg.norm(np.diff(corners, axis=1), axis=2)
    elongation = sides.min(axis=1) / sides.max(axis=1)
    same = np.isclose(found.shapes[:, 1], elongation, rtol=1e-6)
    assert same[shapely.get_num_coordinates(shapely.convex_hull(values)) > 4].mean() > 0.95
    assert (found.shapes[~same, 1] < elongation[~same]).all()


def test_many_at_once_are_each_one_alone() -> None:
    values = outlines(200, 2)
    found = footprints(values)
    for row, outline in enumerate(values):
        one = footprint(outline)
        assert (one.x_m, one.y_m) == tuple(found.centroids_m[row])
        assert one.area_m2 == found.areas_m2[row] and one.shape == tuple(found.shapes[row])


@pytest.mark.parametrize(("angle_rad", "shift"), [(0.0, UTM), (0.7, (0.0, 0.0)), (2.4, UTM)])
def test_place_and_heading_do_not_matter(angle_rad: float, shift: tuple[float, float]) -> None:
    # A coordinate of 4.7e6 m has steps of 1e-9 m: 1e-6 of the shape of a building a millimetre thin.
    values = outlines(2000, 3)
    there = footprints(moved(values, angle_rad, shift))
    here = footprints(values)
    np.testing.assert_allclose(there.shapes, here.shapes, atol=1e-6)
    np.testing.assert_allclose(there.areas_m2, here.areas_m2, rtol=1e-6)


def test_ties_go_to_the_longest_rectangle() -> None:
    # All three rectangles of a triangle have twice its area: sides 3, 4 or 5 and 4, 3 or 2.4.
    for shift in range(3):
        corners = np.roll([(0, 0), (4, 0), (0, 3)], shift, axis=0)
        assert footprint(Polygon(corners)).elongation == pytest.approx(2.4 / 5.0)


def test_holes_count() -> None:
    found = footprint(Polygon(box(0, 0, 10, 10).exterior, [box(2, 2, 8, 8).exterior]))
    assert found.area_m2 == 64.0 and found.rectangularity == found.convexity == pytest.approx(0.64)
    assert found.compactness == pytest.approx(4 * np.pi * 64 / (40 + 24) ** 2)


def test_nothing_to_measure() -> None:
    found = footprints(np.empty(0, dtype=object))
    assert found.centroids_m.shape == (0, 2) and found.areas_m2.shape == (0,) and found.shapes.shape == (0, 4)


@pytest.mark.parametrize("bad", [Polygon(), Polygon([(0, 0), (1, 1), (2, 2)])])
def test_one_without_area_is_refused_among_many(bad: Polygon) -> None:
    with pytest.raises(BuildlocError, match="has no area"):
        footprints(np.array([box(0, 0, 1, 1), bad], dtype=object))


def test_slivers_stay_numbers() -> None:
    for thickness_m in (1e-3, 1e-6):
        thin = affinity.translate(affinity.rotate(box(0, 0, 10, thickness_m), 33), *UTM)
        assert np.isfinite(footprints(np.array([thin], dtype=object)).shapes).all()
