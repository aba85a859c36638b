"""Instance metrics on towns drawn by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from buildloc_eval.instance_metrics import Comparison, compare, figures, one_to_one, outline_distance, pooled
from buildloc_eval.places import Labels

GSD = 0.5  # 8 m2 are 32 pixels
SHAPE = (60, 80)


def town(*boxes: tuple[int, int, int, int]) -> Labels:
    """Buildings 1, 2, ... at rows r0 to r1 and columns c0 to c1."""
    labels = np.zeros(SHAPE, dtype=np.int32)
    for number, (r0, r1, c0, c1) in enumerate(boxes, start=1):
        labels[r0:r1, c0:c1] = number
    return labels


def scored(true: Labels, found: Labels) -> Comparison:
    return compare(true, found, np.ones(SHAPE, dtype=np.bool_), GSD)


HOUSE, OTHER = (10, 20, 10, 20), (10, 20, 20, 30)


def test_the_same_town_is_perfect_and_numbers_do_not_matter() -> None:
    true = town(HOUSE, OTHER, (40, 50, 40, 60))
    found = np.where(true > 0, 10 - true, 0).astype(np.int32)
    scores = figures(scored(true, found))
    assert scores["true"] == scores["found"] == 3.0
    for name in ("pixel_iou", "pixel_f1", "recall_0.5", "precision_0.5", "recall_0.3", "precision_0.3"):
        assert scores[name] == 1.0
    for name in ("missed", "merged", "split", "false_per_km2", "centroid_p90_m", "log_area_std", "outline_m"):
        assert scores[name] == 0.0


def test_a_shifted_house_is_matched_by_its_overlap() -> None:
    # Four columns of ten to the right, two rows up: IoU 6*8 / (200 - 48) = 0.316.
    result = scored(town(HOUSE), town((8, 18, 14, 24)))
    assert result.true.matched.all() and not result.true.matched_strict.any()
    assert result.pairs.centroid_m[0].tolist() == [2.0, 1.0]  # east and north
    scores = figures(result)
    assert scores["pixel_iou"] == pytest.approx(48 / 152)
    assert scores["pixel_f1"] == pytest.approx(96 / 200)
    assert scores["centroid_median_m"] == pytest.approx(math.hypot(2.0, 1.0))


def test_a_larger_house_has_its_area_and_outline_error() -> None:
    # A pixel more on each side: 12 x 12 against 10 x 10, outlines a pixel apart.
    result = scored(town(HOUSE), town((9, 21, 9, 21)))
    assert result.pairs.log_area[0] == pytest.approx(math.log(1.44))
    assert result.pairs.outline_m[0] == pytest.approx(GSD, rel=0.05)
    np.testing.assert_allclose(result.pairs.shape[0], 0.0, atol=0.02)


def test_two_houses_found_as_one_are_merged_and_neither_missed_nor_false() -> None:
    result = scored(town(HOUSE, OTHER), town((10, 20, 10, 30)))
    assert result.true.merged.all() and result.found.merged.all()
    assert not result.true.lost.any() and not result.found.lost.any()
    # IoU of one of the two is a half: one to one, so one is matched.
    assert result.true.matched.sum() == result.true.matched_strict.sum() == 1


def test_a_house_with_a_shed_below_the_least_area_is_not_merged() -> None:
    shed = (10, 14, 20, 24)  # 16 pixels, 4 m2
    result = scored(town(HOUSE, shed), town((10, 20, 10, 24)))
    assert len(result.true) == 1 and not result.true.merged.any() and result.true.matched_strict.all()


def test_a_house_found_in_two_pieces_is_split() -> None:
    result = scored(town((10, 20, 10, 30)), town((10, 20, 10, 19), (10, 20, 21, 30)))
    assert result.true.split.all() and result.found.split.all()
    assert result.true.matched.all() and result.found.matched.sum() == 1
    assert not result.found.lost.any()


def test_what_is_nowhere_is_missed_and_what_is_invented_is_false() -> None:
    result = scored(town(HOUSE), town((40, 50, 40, 60)))
    assert result.true.lost.all() and result.found.lost.all() and len(result.pairs.true) == 0
    scores = figures(result)
    assert scores["missed"] == 1.0 and scores["recall_0.3"] == 0.0 and scores["centroid_median_m"] is None
    assert scores["false_per_km2"] == pytest.approx(1e6 / (60 * 80 * GSD**2))


def test_what_the_edge_of_the_labelled_ground_cuts_does_not_count() -> None:
    labelled = np.ones(SHAPE, dtype=np.bool_)
    labelled[:, 50:] = False
    true = town(
        (0, 10, 10, 20), (30, 40, 40, 60), HOUSE
    )  # at the picture's edge, at the ground's edge, whole
    found = town((1, 10, 10, 20), (30, 40, 40, 49), HOUSE, (45, 55, 45, 65), (5, 15, 60, 70))
    result = compare(true, found, labelled, GSD)
    # The fourth is cut, the fifth lies on unlabelled ground; the first two are found on cut buildings.
    assert result.true.number.tolist() == [3] and result.found.number.tolist() == [3]
    assert result.area_m2 == 60 * 50 * GSD**2


def test_small_ones_do_not_count_unless_they_are_found_on_a_building() -> None:
    speck, part = (40, 44, 40, 44), (10, 16, 10, 15)
    result = scored(town(HOUSE, speck), town(part, (40, 44, 40, 45), (50, 52, 50, 52)))
    assert len(result.true) == 1 and result.true.matched.all()  # 30 of 100 pixels
    assert result.found.number.tolist() == [1]


def test_matching_takes_the_best_pair_first_and_each_building_once() -> None:
    t, f = np.array([1, 1, 2, 2]), np.array([1, 2, 1, 3])
    iou = np.array([0.5, 0.4, 0.6, 0.35])
    assert one_to_one(t, f, iou, 0.3).tolist() == [2, 1]
    assert one_to_one(t, f, iou, 0.45).tolist() == [2]


def test_a_turned_picture_has_the_same_figures() -> None:
    rng = np.random.default_rng(5)
    boxes = [(r, r + 8, c, c + 9) for r in range(2, 50, 12) for c in range(2, 66, 13)]
    true = town(*boxes)
    shifts = rng.integers(-2, 3, (len(boxes), 2)).tolist()
    moved = [(r + y, s + y, c + x, e + x) for (r, s, c, e), (y, x) in zip(boxes, shifts, strict=True)]
    found = town(*moved[3:])
    upright = figures(scored(true, found))
    turned = compare(np.rot90(true), np.rot90(found), np.ones(SHAPE[::-1], dtype=np.bool_), GSD)
    assert figures(turned) == pytest.approx(upright)


def test_outlines_a_pixel_apart_are_a_pixel_apart() -> None:
    small, large = np.zeros((2, 40, 40), dtype=np.uint8)
    small[10:30, 10:30], large[9:31, 9:31] = 1, 1
    assert outline_distance(small, large) == pytest.approx(1.0, abs=0.03)
    assert outline_distance(small, small) == 0.0


def test_pieces_of_ground_are_pooled() -> None:
    right, wrong = scored(town(HOUSE), town(HOUSE)), scored(town(HOUSE), town((40, 50, 40, 60)))
    both = figures(pooled([right, wrong]))
    assert both["recall_0.3"] == both["precision_0.3"] == both["missed"] == 0.5
    assert both["pixel_iou"] == pytest.approx(100 / (100 + 100 + 200))
