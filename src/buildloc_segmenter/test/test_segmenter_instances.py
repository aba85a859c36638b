"""One label per building, the line between touching ones, and blocks, on hand-drawn scores."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from buildloc_segmenter.instances import (
    DENSE_SCORE,
    VALLEY,
    Instances,
    draw_mask,
    fill_holes,
    find_instances,
    owned,
)
from buildloc_segmenter.tiles import blocks

GSD_M = 0.2
Box = tuple[int, int, int, int]  # left, top, right, bottom; pixels


def scores(*boxes: Box, inset: int = 0, size: tuple[int, int] = (80, 120)) -> np.ndarray:
    """Logits of 5 in the boxes, made smaller by ``inset``, and -5 elsewhere."""
    image = np.full(size, -5.0, dtype=np.float32)
    for left, top, right, bottom in boxes:
        image[top + inset : bottom - inset, left + inset : right - inset] = 5.0
    return image


def found(
    building: np.ndarray, core: np.ndarray | None = None, min_area_m2: float = 8.0, min_score: float = 0.0
) -> Instances:
    return find_instances(building, core, GSD_M, min_area_m2, min_score, image_gsd_m=0.1)


def parts(mask: np.ndarray) -> int:
    return int(cv2.connectedComponents(mask, connectivity=8)[0]) - 1


TERRACE: tuple[Box, ...] = ((20, 20, 60, 60), (60, 20, 90, 60), (90, 30, 110, 50))


def test_touching_roofs_are_split_where_their_cores_say() -> None:
    instances = found(scores(*TERRACE), scores(*TERRACE, inset=3))
    assert len(instances) == 3
    for left, top, right, bottom in TERRACE:
        (number,) = np.unique(instances.labels[top + 3 : bottom - 3, left + 3 : right - 3])
        true = np.zeros(instances.labels.shape, dtype=bool)
        true[top:bottom, left:right] = True
        same = instances.labels == number
        assert (same & true).sum() / (same | true).sum() > 0.94  # one pixel of line goes to either side
    assert ((instances.labels > 0) == (scores(*TERRACE) > 0)).all()


def test_without_cores_a_narrow_neck_is_split_and_a_wall_is_not() -> None:
    # Two roofs of 8 x 8 m that touch along 0.8 m, and a house with a wing of 4 m.
    assert len(found(scores((10, 20, 50, 60), (50, 38, 52, 42), (52, 20, 92, 60)))) == 2
    assert len(found(scores((10, 20, 50, 60), (50, 30, 90, 50)))) == 1


def test_a_part_without_a_core_is_one_building() -> None:
    instances = found(scores((10, 10, 40, 40), (60, 10, 90, 40)), scores((10, 10, 40, 40), inset=3))
    assert len(instances) == 2 and len(np.unique(instances.labels[10:40, 60:90])) == 1


def test_a_core_that_is_a_speck_splits_nothing() -> None:
    core = scores((10, 10, 60, 50), inset=3)
    core[30, 20:60] = -5.0  # a roof ridge across the core ...
    core[28:33, 55:57] = -5.0
    core[30, 58] = 5.0  # ... and a speck of core at its end
    assert len(found(scores((10, 10, 60, 50)), core)) == 1


def test_what_is_finer_than_the_inset_of_a_core_splits_nothing() -> None:
    core = scores((10, 10, 110, 70), inset=3)
    core[:, 60:62] = -1.0  # a ridge of 0.4 m that the network is unsure of
    assert len(found(scores((10, 10, 110, 70)), core)) == 1


def valley(boxes: tuple[Box, ...], size: tuple[int, int]) -> np.ndarray:
    """Cores of the boxes that the network is sure of, joined by what it is less sure of."""
    low = scores(*boxes, inset=-3, size=size)
    return np.where(scores(*boxes, inset=3, size=size) > 0.0, low, np.minimum(low, 1.5)).astype(np.float32)


def houses(*cells: tuple[int, int]) -> tuple[Box, ...]:
    """Houses of 12 x 12 m at the cells of a grid, column and row."""
    return tuple((10 + 60 * i, 10 + 60 * k, 70 + 60 * i, 70 + 60 * k) for i, k in cells)


def test_a_ridge_is_a_shallower_valley_than_a_gap() -> None:
    for low, count in ((0.5, 1), (VALLEY + 0.5, 1), (VALLEY - 0.5, 2), (-5.0, 2)):
        core = scores((10, 10, 110, 70), inset=3)
        core[:, 50:70] = np.minimum(core[:, 50:70], low)  # wide enough to reach its depth when it is smoothed
        assert len(found(scores((10, 10, 110, 70)), core)) == count


def test_in_a_dense_town_any_valley_between_cores_is_enough() -> None:
    street = houses((0, 0), (1, 0), (2, 0), (3, 0), (0, 1), (0, 2), (0, 3))  # and another one around a corner
    pair = houses((5, 5), (6, 5))
    hall = houses(*((i, k) for i in range(4) for k in range(2)))
    size = (380, 440)
    counts = [
        len(found(scores(*at, size=size), valley(at, size))) for at in (street, hall, pair, street + pair)
    ]
    assert counts == [7, 1, 1, 9]
    # Beside a works of ten times its area the street makes no dense town.
    size, works = (900, 440), (10, 260, 430, 880)
    core = np.maximum(valley(street, size), scores(works, inset=3, size=size))
    assert len(found(scores(*street, works, size=size), core)) == 2


def test_in_a_dense_town_a_building_may_be_less_sure() -> None:
    pair, street = houses((5, 5), (6, 5)), houses((0, 0), (1, 0), (2, 0), (3, 0), (0, 1), (0, 2), (0, 3))
    for boxes, share in ((pair, 1.0), (street + pair, DENSE_SCORE)):
        image, core = scores(*boxes, size=(380, 440)), valley(boxes, (380, 440))
        every = found(image, core)
        enough, too_much = 0.99 * every.scores.min() / share, 1.01 * every.scores.max() / share
        assert len(found(image, core, min_score=enough)) == len(every)
        assert len(found(image, core, min_score=too_much)) == 0


@pytest.mark.parametrize(("zoom", "gap_m"), [(2.0, 0.4), (1.0, 0.4), (0.4, 0.75)])
def test_the_mask_keeps_touching_buildings_apart_at_any_size(zoom: float, gap_m: float) -> None:
    pixel_m = GSD_M / zoom
    instances = find_instances(scores(*TERRACE), scores(*TERRACE, inset=3), GSD_M, 8.0, 0.0, pixel_m)
    height, width = (round(side * zoom) for side in instances.labels.shape)
    mask = draw_mask(instances, (width, height))
    assert mask.shape == (height, width) and set(np.unique(mask)) == {0, 255}
    assert parts(mask) == 3
    row = mask[round(25 * zoom), round(30 * zoom) : round(80 * zoom)]  # through the first two roofs
    assert (row == 0).sum() * pixel_m >= min(gap_m, 1.0) - pixel_m / 2


def test_a_slanted_line_keeps_buildings_apart_in_the_mappers_raster() -> None:
    rows, columns = np.mgrid[:80, :120]
    side = (columns - 60) * 0.8 + (rows - 40) * 0.6
    core = np.where(np.abs(side) > 3, scores((10, 10, 110, 70), inset=3), -5.0).astype(np.float32)
    instances = found(scores((10, 10, 110, 70)), core)
    assert len(instances) == 2
    full = draw_mask(instances, (240, 160))  # 0.1 m per pixel
    assert parts(full) == 2
    at_map = cv2.resize(full, (96, 64), interpolation=cv2.INTER_LINEAR) > 127  # 0.25 m per pixel
    assert parts(at_map.astype(np.uint8)) == 2


def test_small_buildings_and_holes_go_and_the_numbers_stay_without_gaps() -> None:
    image = scores((10, 10, 40, 40), (60, 10, 66, 16), (60, 40, 90, 70))  # 36, 1.4 and 36 m2
    image[20:22, 20:22] = -5.0
    instances = found(image)
    assert len(instances) == 2 and set(np.unique(instances.labels)) == {0, 1, 2}
    assert instances.labels[21, 21] > 0 and instances.labels[12, 62] == 0
    mask = draw_mask(instances, (120, 80))
    assert mask[21, 21] == 255 and mask[12, 62] == 0 and (mask > 0).sum() == 1800


def test_a_building_that_the_network_doubts_goes_and_its_neighbour_stays() -> None:
    house, terrace, shed = (10, 10, 40, 40), (40, 10, 70, 40), (80, 10, 95, 25)
    image = scores(house, terrace, shed)
    core = np.full(image.shape, -5.0, dtype=np.float32)
    # Of the house 0.64 is core, as sure as the network gets; of a shed that it is as sure of 0.36.
    core[13:37, 13:37] = core[13:22, 83:92] = 5.0
    core[13:37, 43:67] = 0.5  # a terrace at the house: of 0.64, a probability of 0.62
    for min_score, numbers in ((0.3, {0, 1, 2, 3}), (0.38, {0, 1, 2}), (0.5, {0, 1}), (0.7, {0})):
        instances = found(image, core, min_score=min_score)
        assert set(np.unique(instances.labels)) == numbers and len(instances.scores) == len(instances)
        assert (instances.scores >= min_score).all()
    kept = found(image, core, min_score=0.5)
    assert kept.labels[25, 25] == 1 and kept.labels[25, 55] == 0 and not kept.between.any()
    assert parts(draw_mask(kept, (120, 80))) == 1
    assert kept.scores == pytest.approx([(1.0 / (1.0 + np.exp(-core)))[kept.labels == 1].mean()])


def test_without_cores_it_is_the_building_probability_that_scores() -> None:
    image = scores((10, 10, 40, 40), (60, 10, 90, 40))
    image[10:40, 60:90] = 1.0  # a probability of 0.73
    assert [len(found(image, min_score=least)) for least in (0.7, 0.75)] == [2, 1]


def test_only_enclosed_background_is_a_hole() -> None:
    # Close to the ground the whole picture is smaller than the smallest building: it stays empty.
    assert fill_holes(np.zeros((40, 60), dtype=np.uint8), 1e6).max() == 0
    mask = np.ones((40, 60), dtype=np.uint8)
    mask[:3, :3] = 0  # a corner of ground
    mask[20:23, 20:23] = 0
    filled = fill_holes(mask, 50)
    assert filled[0, 0] == 0 and filled[21, 21] == 1


def test_an_image_of_ground_and_one_of_roof() -> None:
    assert len(found(np.full((40, 60), -5.0, dtype=np.float32))) == 0
    roof = found(np.full((40, 60), 5.0, dtype=np.float32))
    assert len(roof) == 1 and draw_mask(roof, (60, 40)).min() == 255


def plain_holes(mask: np.ndarray, max_px: float) -> np.ndarray:
    """Filled holes by the definition: each component of the background on its own."""
    filled = mask.copy()
    parts, part = cv2.connectedComponents(1 - mask, connectivity=4)
    border = np.unique(np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]]))
    for number in set(range(1, parts)) - set(border.tolist()):
        if (part == number).sum() < max_px:
            filled[part == number] = 1
    return filled


def plain_instances(mask: np.ndarray, cores: np.ndarray, min_core_px: float, min_px: float) -> np.ndarray:
    """Instances by the definition: a pixel belongs to the core closest to it in its part of the mask."""
    labels = np.zeros(mask.shape, dtype=np.int32)
    parts, part = cv2.connectedComponents(mask, connectivity=8)
    for number in range(1, parts):
        inside = (part == number).astype(np.uint8)
        count, core = cv2.connectedComponents(cores & inside, connectivity=4)
        large = [k for k in range(1, count) if (core == k).sum() >= min_core_px]
        grown = np.where(np.isin(core, large), core, 0) if large else inside.astype(np.int32)
        while (inside.astype(bool) & (grown == 0)).any():
            wider = cv2.dilate(grown.astype(np.float32), np.ones((3, 3), np.uint8)).astype(np.int32)
            grown = np.where((grown == 0) & (inside > 0), wider, grown)
        for k in set(np.unique(grown).tolist()) - {0}:
            if (grown == k).sum() >= max(min_px, 1.0):
                labels[grown == k] = labels.max() + 1
    return labels


@pytest.mark.parametrize("seed", range(4))
def test_the_fast_way_finds_what_the_definition_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(0.0, 40.0, (120, 160)).astype(np.float32), (0, 0), 3.0)
    mask = (noise > 0.0).astype(np.uint8)
    filled = fill_holes(mask, 60.0)
    # An island in a hole counts for the hole, in the definition it does not: a few pixels.
    assert (filled != plain_holes(mask, 60.0)).mean() < 2e-3
    core = np.where(noise > 1.5, 5.0, -5.0).astype(np.float32)
    instances = found(np.where(filled > 0, 5.0, -5.0).astype(np.float32), core, 2.4)
    smooth = cv2.GaussianBlur(core, (0, 0), 0.6 / GSD_M) > VALLEY
    plain = plain_instances(filled, filled & smooth.astype(np.uint8), 25.0, 60.0)
    assert len(instances) == plain.max() > 5
    # Which of two cores is closer is a tie along the line between them, and the flood goes along the axes.
    _, pixels = np.unique(np.stack([instances.labels, plain])[:, plain > 0], axis=1, return_counts=True)
    assert np.sort(pixels)[-plain.max() :].sum() > 0.97 * pixels.sum()
    assert ((instances.labels > 0) == (plain > 0)).mean() > 0.995


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_quarter_turns_turn_the_buildings(turns: int) -> None:
    rng = np.random.default_rng(turns)
    noise = cv2.GaussianBlur(rng.normal(0.0, 40.0, (90, 130)).astype(np.float32), (0, 0), 5)
    upright, turned = found(noise), found(np.ascontiguousarray(np.rot90(noise, turns)))
    assert len(upright) == len(turned) > 2
    # The flood decides ties in the order of rows: the line between two may move by a pixel.
    assert ((np.rot90(upright.labels, turns) > 0) != (turned.labels > 0)).mean() < 1e-3
    areas = [np.sort(np.bincount(image.labels.ravel())) for image in (upright, turned)]
    assert np.abs(areas[0] - areas[1]).max() < 0.02 * areas[0].max()


def test_blocks_share_out_the_buildings_of_an_image() -> None:
    boxes = tuple((x, y, x + 14, y + 14) for x in range(3, 280, 20) for y in range(3, 180, 20))
    whole = scores(*boxes, size=(190, 300))
    mask = np.zeros((190, 300), dtype=np.uint8)
    count = 0
    for block in blocks(190, 300, 100, 40):
        window = np.s_[block.rows, block.columns]
        mine = owned(found(np.ascontiguousarray(whole[window]), min_area_m2=1.0), block.own_in_window(1.0))
        count += len(np.unique(mine.labels)) - 1
        mask[window] |= draw_mask(mine, mine.labels.shape[::-1])
    assert count == len(boxes)
    assert ((mask > 0) == (whole > 0)).all()


def test_one_block_is_all_of_a_small_image() -> None:
    (block,) = blocks(50, 70, 100, 40)
    assert block.is_all and (block.rows, block.columns) == (slice(0, 50), slice(0, 70))
