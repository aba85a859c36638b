"""The error model: what is done to a simulated town measures as it was stated."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from buildloc_eval.instance_metrics import compare, figures, robust_sigma
from buildloc_eval.overlapping import Flicker, Overlap, flicker
from buildloc_eval.places import drawn
from buildloc_eval.segmentation_errors import (
    ErrorModelError,
    Perceived,
    SegmentationErrors,
    disturb,
    halves,
    measured,
    merge,
    perceive,
    read_errors,
    write_errors,
)

NONE = SegmentationErrors(
    true=1, missed=0.0, merged=0.0, split=0.0, false_per_km2=0.0, false_share=0.0, false_median_m2=40.0,
    centroid_sigma_m=0.0, log_area_bias=0.0, log_area_sigma=0.0, shape_sigma=(0.0, 0.0, 0.0, 0.0),
    outline_m=0.0, twice=1, flicker=0.0, centroid_frame_sigma_m=0.0, false_again=1.0,
)  # fmt: skip
GSD = 0.25
SIDE_M = 600.0
GROUND = shapely.box(0.0, 0.0, SIDE_M, SIDE_M)
TO_PIXELS = np.array([[1 / GSD, 0.0, -0.5], [0.0, -1 / GSD, SIDE_M / GSD - 0.5], [0.0, 0.0, 1.0]])
SIZE = (int(SIDE_M / GSD),) * 2


def town(spacing_m: float = 30.0) -> np.ndarray:
    places = np.arange(15.0, SIDE_M - 15.0, spacing_m)
    return np.array([shapely.box(x, y, x + 12.0, y + 9.0) for x in places for y in places], dtype=object)


def in_pixels(outlines: np.ndarray) -> list[shapely.Polygon]:
    return [
        shapely.transform(o, lambda xy: np.column_stack([xy[:, 0], SIDE_M - xy[:, 1]]) / GSD)
        for o in outlines
    ]


def test_without_errors_a_frame_shows_the_town_as_it_is() -> None:
    seen = perceive(town(), NONE, GROUND, np.random.default_rng(1))
    mask = seen.frame(TO_PIXELS, SIZE, GSD, np.random.default_rng(2))
    true = drawn(in_pixels(town()), SIZE[::-1])
    assert ((mask > 0) == (true > 0)).all()


def test_what_is_done_to_a_town_measures_as_stated() -> None:
    stated = dataclasses.replace(
        NONE, missed=0.2, merged=0.1, split=0.06, false_per_km2=120.0, centroid_sigma_m=0.5, flicker=0.12,
        log_area_bias=-0.1, log_area_sigma=0.12, outline_m=0.6, centroid_frame_sigma_m=0.3, false_again=0.5,
    )  # fmt: skip
    neighbours = shapely.transform(town()[::4], lambda xy: np.add(xy, (13.0, 0.0)))
    outlines = np.concatenate([town(), neighbours])
    true = drawn(in_pixels(outlines), SIZE[::-1])
    scores, moved, areas = [], [], []
    for seed in range(6):
        seen = perceive(outlines, stated, GROUND, np.random.default_rng([1, seed]))
        mask = seen.frame(TO_PIXELS, SIZE, GSD, np.random.default_rng([2, seed]))
        found = cv2.connectedComponents(mask, connectivity=8)[1].astype(np.int32)
        c = compare(true, found, np.ones(true.shape, dtype=np.bool_), GSD)
        scores.append(figures(c))
        alone = ~np.isin(c.pairs.found, c.found.number[c.found.merged | c.found.split])
        moved.append(c.pairs.centroid_m[alone])
        areas.append(c.pairs.log_area[alone])
    mean = {
        key: float(np.mean([s[key] for s in scores]))
        for key in ("missed", "merged", "split", "false_per_km2")
    }
    assert mean["missed"] == pytest.approx(0.2, abs=0.03)
    # A merged pair needs both: some of the closest have a neighbour that is never found.
    assert mean["merged"] == pytest.approx(0.1 * 0.85, abs=0.025)
    assert mean["split"] == pytest.approx(0.06 * 0.85, abs=0.02)
    assert mean["false_per_km2"] == pytest.approx(120.0, rel=0.3)
    assert robust_sigma(np.concatenate(moved).ravel()) == pytest.approx(0.5, rel=0.12)
    assert np.median(np.concatenate(areas)) == pytest.approx(-0.1, abs=0.03)
    assert robust_sigma(np.concatenate(areas)) == pytest.approx(0.12, rel=0.25)
    assert np.mean([s["outline_m"] for s in scores]) == pytest.approx(0.6, rel=0.25)


def test_frames_of_a_flight_share_what_stays_and_differ_in_what_flickers() -> None:
    stated = dataclasses.replace(
        NONE, missed=0.3, flicker=0.14, centroid_sigma_m=0.5, centroid_frame_sigma_m=0.2, outline_m=0.5
    )
    assert stated.frame_missed == pytest.approx(0.1) and stated.never_found == pytest.approx(1 - 0.7 / 0.9)
    outlines = town()
    seen = perceive(outlines, stated, GROUND, np.random.default_rng(1))
    assert len(seen.outlines) / len(outlines) == pytest.approx(1.0 - stated.never_found, abs=0.05)
    masks = [seen.frame(TO_PIXELS, SIZE, GSD, np.random.default_rng([5, k])) > 0 for k in range(2)]
    at = (shapely.get_coordinates(shapely.centroid(outlines)) * (1, -1) + (0, SIDE_M)) / GSD
    columns, rows = at.astype(int).T
    a, b = (mask[rows, columns] for mask in masks)
    assert (a ^ b).mean() == pytest.approx(0.14, abs=0.05)
    again = seen.frame(TO_PIXELS, SIZE, GSD, np.random.default_rng([5, 0])) > 0
    assert (again == masks[0]).all()


def test_an_outline_is_moved_and_resized_by_as_much_as_stated() -> None:
    stated = dataclasses.replace(
        NONE,
        centroid_sigma_m=0.5,
        centroid_frame_sigma_m=0.3,
        log_area_bias=0.1,
        log_area_sigma=0.2,
        outline_m=1.0,
    )
    house, rng = shapely.box(0.0, 0.0, 12.0, 9.0), np.random.default_rng(3)
    found = np.array([disturb(house, stated, rng) for _ in range(1500)], dtype=object)
    assert shapely.is_valid(found).all()
    moved = shapely.get_coordinates(shapely.centroid(found)) - (6.0, 4.5)
    assert moved.std(axis=0) == pytest.approx([0.4, 0.4], rel=0.07)
    ratio = np.log(shapely.area(found) / house.area)
    assert (ratio.mean(), ratio.std()) == pytest.approx((0.1, 0.2), abs=0.02)


def test_the_closest_are_merged_and_a_cut_house_has_two_halves() -> None:
    row = np.array([shapely.box(x, 0, x + 10, 8) for x in (0, 10.5, 30, 43, 80)], dtype=object)
    single, joined = merge(row, 0.4)
    assert len(single) == 3 and len(joined) == 1
    assert joined[0].area == pytest.approx(164.0, abs=8.0)
    assert len(merge(row, 0.9)[1]) == 2  # the third pair is too far apart
    parts = halves(shapely.box(0.0, 0.0, 12.0, 6.0))
    assert sorted(part.area for part in parts) == pytest.approx([34.8, 34.8])


def test_flicker_is_counted_over_pairs_of_frames() -> None:
    apart = np.array([[0.3, -0.3], [-0.3, 0.3]])
    found = flicker([Overlap(7, 2, 1, apart, 3, 1), Overlap(9, 1, 0, -apart, 1, 1)])
    assert found == Flicker(20, 0.15, pytest.approx(1.4826 * 0.3 / math.sqrt(2.0)), 4, 0.5)
    assert flicker([Overlap(0, 0, 3, np.empty((0, 2)), 0, 0)]) is None


def test_measured_errors_survive_their_file(tmp_path: Path) -> None:
    moved = shapely.transform(town(), lambda xy: xy + 1.0)
    true, found = (drawn(in_pixels(outlines), SIZE[::-1]) for outlines in (town(), moved))
    c = compare(true, found, np.ones(true.shape, dtype=np.bool_), GSD)
    errors = measured(c, Flicker(50, 0.1, 0.2, 5, 0.4))
    assert errors.missed == errors.merged == errors.false_share == 0.0 and errors.true == len(town())
    write_errors(tmp_path / "errors.json", {"seed": 1}, {"all": errors})
    assert read_errors("all", tmp_path / "errors.json") == errors
    with pytest.raises(ErrorModelError, match="has no place mars"):
        read_errors("mars", tmp_path / "errors.json")
    (tmp_path / "errors.json").write_text("{}")
    with pytest.raises(ErrorModelError, match="is no error model"):
        read_errors("all", tmp_path / "errors.json")


def test_a_frame_leaves_a_line_between_neighbours_that_touch() -> None:
    row = np.array([shapely.box(100, 100, 112, 110), shapely.box(112, 100, 124, 110)], dtype=object)
    mask = Perceived(row, np.ones(2), 0.0).frame(TO_PIXELS, SIZE, GSD, np.random.default_rng(0))
    assert cv2.connectedComponents(mask, connectivity=8)[0] == 3
