"""Training crops and their targets: what is drawn, turned and weathered keeps true labels. No PyTorch."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import shapely
from augment import augmented, coarse, colours, snow
from buildloc_eval.places import Scene
from crops import CROP_PX, ONE_HOUSE_M2, CropConfig, CropSampler, core
from layouts import block, decoys, render, street
from rendered import Canvas, Light, building, joined, rectangle

PLAIN = CropConfig(rendered_share=0.0, decoy_share=0.0)


def two_touching_squares() -> np.ndarray:
    labels = np.zeros((40, 60), dtype=np.int32)
    labels[10:30, 10:30] = 1
    labels[10:30, 30:50] = 2
    return labels


def test_cores_of_touching_buildings_lie_apart_by_twice_the_depth() -> None:
    found = core(two_touching_squares(), gsd_m=0.2)
    assert found[20, 13:27].all() and found[20, 33:47].all()
    assert not found[20, 27:33].any()
    assert cv2.connectedComponents(found.astype(np.uint8))[0] - 1 == 2


def test_a_building_thinner_than_two_depths_has_no_core() -> None:
    labels = np.zeros((20, 40), dtype=np.int32)
    labels[8:13, 5:35] = 1
    assert not core(labels, gsd_m=0.2).any()


def test_a_rendered_town_depends_on_its_seed_alone() -> None:
    first, again, other = (render(96, 0.2, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert np.array_equal(first[0], again[0]) and np.array_equal(first[1], again[1])
    assert not np.array_equal(first[0], other[0])
    assert first[0].min() >= 0.0 and first[0].max() <= 255.0


def test_rendered_buildings_are_numbered_without_gaps() -> None:
    for seed in range(8):
        labels = render(128, 0.2, np.random.default_rng(seed))[1]
        numbers = np.unique(labels[labels > 0])
        assert numbers.max(initial=0) <= labels.max()
        assert (numbers >= 1).all()


def test_decoys_leave_every_roof_untouched() -> None:
    rng = np.random.default_rng(5)
    rgb = rng.uniform(0.0, 255.0, (80, 80, 3)).astype(np.float32)
    labels = np.zeros((80, 80), dtype=np.int32)
    labels[20:50, 30:70] = 1
    before = rgb.copy()
    changed = [decoys(rgb, labels, 0.2, np.random.default_rng(seed)) for seed in range(5)]
    assert np.array_equal(rgb, before)
    assert all(np.array_equal(out[labels > 0], rgb[labels > 0]) for out in changed)
    assert any((out != rgb).any() for out in changed)


def test_weather_and_camera_keep_shape_type_and_range() -> None:
    rgb, labels = render(64, 0.2, np.random.default_rng(1))
    for seed in range(30):
        out = augmented(rgb, labels, 0.2, 1.0, np.random.default_rng(seed))
        assert out.shape == rgb.shape and out.dtype == np.float32
        assert np.isfinite(out).all() and out.min() >= 0.0 and out.max() <= 255.0


def test_snow_brightens_and_colours_change_with_the_seed() -> None:
    rgb = np.full((64, 64, 3), 80.0, dtype=np.float32)
    labels = np.zeros((64, 64), dtype=np.int32)
    assert max(snow(rgb, labels, np.random.default_rng(seed)).mean() for seed in range(5)) > 120.0
    assert not np.allclose(
        colours(rgb, 1.0, np.random.default_rng(0)), colours(rgb, 1.0, np.random.default_rng(1))
    )


def test_a_coarser_picture_loses_detail_and_keeps_its_mean() -> None:
    rgb = np.random.default_rng(2).uniform(0.0, 255.0, (64, 64, 3)).astype(np.float32)
    out = coarse(rgb, 0.1, np.random.default_rng(0))
    assert out.std() < 0.7 * rgb.std()
    assert out.mean() == pytest.approx(rgb.mean(), rel=0.05)


def white_roofs(gsd_m: float) -> Scene:
    """Black ground with white roofs: the picture is the label."""
    labels = np.zeros((900, 900), dtype=np.int32)
    rng = np.random.default_rng(0)
    for number in range(1, 60):
        outline = rectangle(
            rng.uniform(50, 850, 2), rng.uniform(40, 90), rng.uniform(30, 60), rng.uniform(0, 3)
        )
        cv2.fillPoly(labels, [outline.round().astype(np.int32)], number)
    rgb = np.repeat(((labels > 0) * 255).astype(np.uint8)[:, :, None], 3, axis=2)
    return Scene("white", gsd_m, rgb, labels, np.ones(labels.shape, dtype=np.bool_))


def test_labels_follow_the_picture_at_any_scale_heading_and_tilt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("crops.augmented", lambda rgb, labels, gsd_m, strength, rng: rgb)
    for gsd in (0.1, 0.2, 0.3):
        rgb, target, weight = CropSampler([white_roofs(gsd)], PLAIN, seed=1).batch(0, 6)
        known = weight[:, 0] > 0
        seen = (rgb[:, 0] > 127) == (target[:, 0] > 0)
        assert seen[known].mean() > 0.985
        assert 0.05 < target[:, 0][known].mean() < 0.6
        assert (target[:, 1] <= target[:, 0]).all()


def test_ground_outside_the_scene_has_no_weight() -> None:
    small = white_roofs(0.2).part(slice(0, 150), slice(0, 150), "corner")
    weight = CropSampler([small], PLAIN, seed=1).batch(0, 4)[2]
    assert weight.shape == (4, 2, CROP_PX, CROP_PX)
    assert np.array_equal(weight[:, 0], weight[:, 1])
    assert 0.05 < weight.mean() < 0.9


def test_where_large_buildings_of_a_mask_are_cut_apart_nobody_knows() -> None:
    scene = replace(white_roofs(0.2), told_apart=False)
    areas = np.bincount(scene.buildings.ravel()) * 0.2**2
    small = Scene(
        "small", 0.2, scene.rgb, np.where(areas[scene.buildings] <= ONE_HOUSE_M2, scene.buildings, 0),
        scene.labelled, told_apart=False,
    )  # fmt: skip
    for town, some_unknown in ((scene, True), (small, False)):
        _, target, weight = CropSampler([town], PLAIN, seed=1).batch(0, 4)
        unknown = weight[:, 1] < weight[:, 0]
        assert unknown.any() == some_unknown
        assert (target[:, 0][unknown] == 1.0).all()  # the ground is known


def test_houses_of_a_block_touch_and_do_not_overlap() -> None:
    canvas = Canvas(256, 0.2, np.random.default_rng(3))
    plans = block(canvas, 0.4)
    outlines = [shapely.Polygon(rectangle(*plan)) for plan in plans]
    for k, outline in enumerate(outlines):
        others = outlines[:k] + outlines[k + 1 :]
        assert min(outline.distance(other) for other in others) < 1e-6
        assert max(outline.intersection(other).area for other in others) < 1e-6


def test_houses_of_a_street_stand_on_both_sides_of_its_road() -> None:
    canvas = Canvas(448, 0.2, np.random.default_rng(2))
    plans = street(canvas, 0.4)
    assert len(plans) > 6
    across = np.sort([centre @ (-np.sin(0.4), np.cos(0.4)) for centre, *_ in plans])
    assert np.diff(across).max() * 0.2 > 10.0  # the road and the gardens in front


def test_what_is_built_against_a_house_is_part_of_it_and_lower() -> None:
    several = 0
    for seed in range(40):
        canvas = Canvas(200, 0.2, np.random.default_rng(seed))
        assert building(canvas, 1, np.array([100.0, 100.0]), 60.0, 45.0, 0.3)
        assert cv2.connectedComponents(canvas.labels.astype(np.uint8))[0] - 1 == 1
        heights = np.unique(canvas.roof_px[canvas.labels == 1]) * 0.2
        several += len(heights) > 1
        assert (heights[:-1] < 3.4).all() or heights.max() < 3.4
        assert canvas.roof_px[100, 100] * 0.2 in heights and not canvas.roof_px[canvas.labels == 0].any()
    assert 5 < several < 30


def test_what_joins_two_bodies_of_a_house_reaches_both() -> None:
    house = (np.array([100.0, 100.0]), 60.0, 45.0, 0.3)
    for seed in range(20):
        canvas = Canvas(64, 0.2, np.random.default_rng(seed))
        one, other, link = (shapely.Polygon(rectangle(*wing)) for wing in (house, *joined(canvas, house)))
        assert 2.0 <= one.distance(other) * 0.2 <= 6.0
        assert link.distance(one) < 1e-6 and link.distance(other) < 1e-6


def test_tall_houses_shade_lower_roofs_and_not_higher_ones() -> None:
    shaded = []
    for height in (5.0, 500.0):
        canvas = Canvas(64, 0.2, np.random.default_rng(1))
        canvas.labels[:, 32:] = 1
        canvas.roof_px[:, 32:] = height
        before = canvas.rgb.copy()
        for angle in np.linspace(0.0, 6.0, 7):
            canvas.light = Light(np.array([np.cos(angle), np.sin(angle)]), 1.0, 0.5, np.zeros(2))
            canvas.shade(rectangle(np.array([24.0, 32.0]), 8.0, 8.0, 0.0), 40.0)
        shaded.append((canvas.rgb != before)[:, 32:].any())
    assert shaded == [True, False]


def test_a_batch_depends_on_seed_and_step_alone_so_that_a_run_resumes() -> None:
    config = CropConfig(rendered_scenes=2)
    first, again = (CropSampler([white_roofs(0.2)], config, seed=7) for _ in range(2))
    first.batch(0, 2)
    for mine, theirs in zip(first.batch(5, 3), again.batch(5, 3), strict=True):
        assert np.array_equal(mine, theirs)
