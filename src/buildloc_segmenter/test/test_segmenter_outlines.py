"""Outlines of hand-drawn houses: corners, right angles where there are some, nothing lost by turning."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from buildloc_segmenter.instances import find_instances
from buildloc_segmenter.outlines import Building, buildings
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.affinity import rotate, translate
from shapely.geometry import Point, Polygon

GSD_M = 0.2
HOUSES = {
    "rectangle": Polygon([(0, 0), (14, 0), (14, 8), (0, 8)]),
    "L": Polygon([(0, 0), (14, 0), (14, 6), (8, 6), (8, 12), (0, 12)]),
    "T": Polygon([(0, 0), (15, 0), (15, 5), (10, 5), (10, 11), (5, 11), (5, 5), (0, 5)]),
    "step": Polygon([(0, 0), (14, 0), (14, 8), (7, 8), (7, 9.5), (0, 9.5)]),
}
OCTAGON = Polygon([(math.cos(a) * 6, math.sin(a) * 6) for a in np.arange(8) * math.pi / 4])


def drawn(outline: Polygon, side_px: int = 150, finer: int = 8) -> np.ndarray:
    """Logits (side_px, side_px) of a polygon in metres, anti-aliased: 5 inside, -5 outside."""
    mask = np.zeros((side_px * finer, side_px * finer), dtype=np.uint8)
    # A polygon's corner at 0 is the first pixel's outer corner, whose centre OpenCV has at 0.
    corners = np.array(outline.exterior.coords) / GSD_M * finer - 0.5
    cv2.fillPoly(mask, [np.round(corners * 16).astype(np.int32)], 1, cv2.LINE_8, 4)
    share = cv2.resize(mask.astype(np.float32), (side_px, side_px), interpolation=cv2.INTER_AREA)
    return share * 10.0 - 5.0


def centred(outline: Polygon, angle_deg: float = 0.0) -> Polygon:
    return rotate(translate(outline, 15.0 - outline.centroid.x, 15.0 - outline.centroid.y), angle_deg)


def traced(outline: Polygon, pixel_m: float = 0.1) -> Building:
    """The one building found in a drawing."""
    (building,) = buildings(find_instances(drawn(outline), None, GSD_M, 8.0, 0.5, pixel_m), pixel_m)
    return building


def iou(a: Polygon, b: Polygon) -> float:
    return float(a.intersection(b).area / a.union(b).area)


def metres(building: Building, pixel_m: float = 0.1) -> Polygon:
    return Polygon(np.array(building.outline.exterior.coords) * pixel_m)


def corner_angles_deg(outline: Polygon) -> np.ndarray:
    points = np.array(outline.exterior.coords)[:-1]
    sides = np.roll(points, -1, axis=0) - points
    angles = np.degrees(np.arctan2(sides[:, 1], sides[:, 0]))
    return np.abs((angles - np.roll(angles, 1) + 180.0) % 360.0 - 180.0)


@settings(max_examples=25, deadline=None)
@given(name=st.sampled_from(sorted(HOUSES)), angle_deg=st.floats(0.0, 180.0))
def test_a_house_keeps_its_corners_whichever_way_it_stands(name: str, angle_deg: float) -> None:
    true = centred(HOUSES[name], angle_deg)
    building = traced(true)
    outline = metres(building)
    assert len(outline.exterior.coords) == len(true.exterior.coords)
    assert corner_angles_deg(outline) == pytest.approx(90.0, abs=0.01)
    assert iou(outline, true) > 0.97
    assert outline.centroid.distance(true.centroid) < 0.06
    assert building.area_m2 == pytest.approx(true.area, rel=0.02)
    assert building.area_m2 == pytest.approx(outline.area, rel=1e-9)


@pytest.mark.parametrize("pixel_m", [0.05, 0.2, 0.5])
def test_outlines_are_in_pixels_of_the_image(pixel_m: float) -> None:
    true = centred(HOUSES["L"])
    assert iou(metres(traced(true, pixel_m), pixel_m), true) > 0.98


@pytest.mark.parametrize("outline", [OCTAGON, Point(0, 0).buffer(6.0)])
def test_what_has_no_right_angles_gets_none(outline: Polygon) -> None:
    true = centred(outline)
    found = metres(traced(true))
    assert iou(found, true) > 0.9 and len(found.exterior.coords) > 6
    assert corner_angles_deg(found).max() < 80.0


def test_one_slanted_wall_stays_slanted() -> None:
    true = centred(Polygon([(0, 0), (14, 0), (14, 6), (10, 10), (0, 10)]))
    found = metres(traced(true))
    assert len(found.exterior.coords) == 6 and iou(found, true) > 0.97
    assert np.sort(corner_angles_deg(found)) == pytest.approx([45, 45, 90, 90, 90], abs=3)


def test_a_building_at_the_images_border_ends_there() -> None:
    true = Polygon([(-5, 4), (9, 4), (9, 14), (-5, 14)])
    found = metres(traced(true))
    assert iou(found, true.intersection(Polygon([(0, 0), (30, 0), (30, 30), (0, 30)]))) > 0.98


def test_touching_roofs_have_one_outline_each_and_share_a_wall() -> None:
    left, right = (Polygon([(x, 8), (x + 8, 8), (x + 8, 18), (x, 18)]) for x in (6.0, 14.0))
    core = np.maximum(drawn(left.buffer(-0.6)), drawn(right.buffer(-0.6)))
    both = np.maximum(drawn(left), drawn(right))
    found = [metres(b) for b in buildings(find_instances(both, core, GSD_M, 8.0, 0.5, 0.1), 0.1)]
    assert len(found) == 2
    assert all(max(iou(outline, true) for outline in found) > 0.95 for true in (left, right))


def test_without_cores_the_score_is_the_mean_probability() -> None:
    sure, unsure = (traced_score(logit) for logit in (4.0, 0.5))
    assert sure == pytest.approx(1 / (1 + math.exp(-4.0)), abs=0.01)
    assert unsure == pytest.approx(1 / (1 + math.exp(-0.5)), abs=0.01)


def traced_score(logit: float) -> float:
    field = np.full((60, 60), -5.0, dtype=np.float32)
    field[10:50, 10:50] = logit
    (building,) = buildings(find_instances(field, None, GSD_M, 8.0, 0.5, 0.2), 0.2)
    return building.score
