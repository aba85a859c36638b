"""The stars of a map, of its thinned triangulations, and a sample of them that lasts."""

from __future__ import annotations

import numpy as np
import pytest
from buildloc_matcher.mesh import Mesh, mesh
from towns import Buildings, stars_of, town

MAP = town(31, 120, 600.0)


def stars(buildings: Buildings, thinnings: int = 0, max_stars: int = 0) -> Mesh:
    return mesh(buildings.centroids_m, buildings.areas_m2, buildings.shapes, thinnings, max_stars)


def triangles(found: Mesh) -> list[tuple[int, ...]]:
    return [tuple(sorted(corners)) for corners in found.corners.tolist()]


def names(found: Mesh) -> set[bytes]:
    return {features.tobytes() for features in found.stars.features}


def test_without_thinning_they_are_those_of_the_triangulation() -> None:
    found, expected = stars(MAP), stars_of(MAP)
    np.testing.assert_array_equal(found.stars.features, expected.features)
    np.testing.assert_array_equal(found.stars.areas_m2, expected.areas_m2)
    areas = np.sort(MAP.areas_m2[found.corners], axis=1)
    np.testing.assert_array_equal(found.stars.areas_m2, areas)


@pytest.mark.parametrize("thinnings", [1, 3, 8])
def test_thinnings_add_stars_whose_triangle_is_new(thinnings: int) -> None:
    plain, before, found = stars(MAP), stars(MAP, thinnings - 1), stars(MAP, thinnings)
    count = len(before.corners)
    assert triangles(found)[:count] == triangles(before)
    assert triangles(found)[: len(plain.corners)] == triangles(plain)
    assert len(set(triangles(found))) == len(found.corners) > count
    np.testing.assert_array_equal(found.stars.features[:count], before.stars.features)
    again = stars(MAP, thinnings)  # the same quarter is left out every time
    np.testing.assert_array_equal(again.corners, found.corners)
    np.testing.assert_array_equal(np.sort(MAP.areas_m2[found.corners], axis=1), found.stars.areas_m2)


def test_a_building_too_many_breaks_its_stars_and_thinning_mends_some() -> None:
    spot = MAP.centroids_m.mean(axis=0)
    invented = Buildings(
        np.vstack([MAP.centroids_m, spot]),
        np.append(MAP.areas_m2, np.float32(100.0)),
        np.vstack([MAP.shapes, np.full(4, 0.5, dtype=np.float32)]),
    )
    true = set(triangles(stars(MAP)))
    broken = true - set(triangles(stars(invented)))
    mended = broken & set(triangles(stars(invented, 8)))
    assert len(broken) > 3 and len(mended) > len(broken) // 2


def test_a_sample_is_as_large_as_asked_and_made_of_the_stars() -> None:
    everything = names(stars(MAP))
    for most in (1, 20, 64):
        sample = stars(MAP, max_stars=most)
        assert len(sample.stars) == len(sample.corners) == most and names(sample) < everything
    for most in (0, len(everything), 10_000):
        assert names(stars(MAP, max_stars=most)) == everything


def test_a_sample_lasts_while_the_map_grows() -> None:
    before = earlier = set[bytes]()
    for count in range(60, 121, 5):
        grown = MAP.select(np.arange(count))
        sample, everything = names(stars(grown, max_stars=40)), names(stars(grown))
        # A star of the sample that was there before was in the sample before.
        lasting = sample & earlier
        assert lasting <= before and (lasting or not before)
        before, earlier = sample, everything


def test_too_few_buildings_have_no_stars() -> None:
    for count in (0, 2, 4):
        found = stars(MAP.select(np.arange(count)), 8, 64)
        assert found.corners.shape == (0, 3) and len(found.stars) == 0
