"""A textured plane with known buildings, photographed from known poses: poses and buildings come back."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.fusion import Fusion, View
from buildloc_mapper.mapper import Mapper, MapperError
from buildloc_mapper.similarity import Similarity
from buildloc_msgs_py.config import ConfigError
from buildloc_msgs_py.ground import camera_matrix
from buildloc_msgs_py.types import Mask
from textured import BUILDINGS, LEVEL, shoot, tilt

FLIGHT = [
    shoot(i, x, y, yaw, altitude, attitude)
    for i, (x, y, yaw, altitude, attitude) in enumerate(
        [
            (-50.0, 0.0, 0.3, 60.0, LEVEL),
            (-30.0, 2.0, 0.35, 62.0, tilt(0.05, -0.03)),
            (-10.0, 4.0, 0.25, 58.0, tilt(-0.04, 0.04)),
            (10.0, 2.0, 0.9, 60.0, LEVEL),
            (30.0, 4.0, 0.4, 61.0, tilt(0.0, 0.05)),
            (50.0, 6.0, 0.3, 60.0, LEVEL),
        ]
    )
]
TRUTH = np.array([(-50.0, 0.0), (-30.0, 2.0), (-10.0, 4.0), (10.0, 2.0), (30.0, 4.0), (50.0, 6.0)])


def test_fusion_puts_the_mask_of_a_distorting_lens_where_the_ground_is() -> None:
    (frame, mask), pose, config = FLIGHT[0], Similarity(0.0, 0.0, 0.0, 1.0), MapperConfig()
    lens = replace(frame.camera, distortion=(-0.25, 0.08, 0.001, -0.002))
    v, u = np.mgrid[: lens.height, : lens.width].astype(np.float64)
    k = camera_matrix(lens)
    ideal = cv2.undistortPoints(
        np.stack([u, v], axis=-1).reshape(-1, 1, 2), k, np.array(lens.distortion), R=np.eye(3), P=k
    ).reshape(lens.height, lens.width, 2)
    bent = (cv2.remap(mask.pixels, ideal.astype(np.float32), None, cv2.INTER_LINEAR) > 127).astype(
        np.uint8
    ) * 255
    views = {
        0: View.of(frame, mask, config),
        1: View.of(replace(frame, camera=lens), Mask(0, "", bent), config),
    }
    poses = {0: pose, 1: pose}

    def agreement(seen: dict[int, View]) -> float:
        fusion = Fusion(config)
        fusion.update(seen, poses)
        count, building = np.concatenate([c.reshape(2, -1) for c in fusion.counts.values()], axis=1)
        return float((building == 2).sum() / ((building > 0) & (count == 2)).sum())

    assert agreement(views) > 0.97  # all but the outlines' own pixels
    assert agreement({0: views[0], 1: View.of(frame, Mask(0, "", bent), config)}) < 0.95


def test_a_jump_in_altitude_is_counted_and_left_out() -> None:
    mapper = Mapper(MapperConfig())
    mapper.add(*FLIGHT[0])
    frame, mask = FLIGHT[1]
    assert mapper.add(replace(frame, altitude_m=95.0), mask) is None
    update = mapper.add(replace(frame, stamp_ns=2), replace(mask, stamp_ns=2))
    assert update is not None and update.funnel["rejected_scale"] >= 1
    assert [k.stamp_ns for k in update.keyframes] == [0, 2] and update.funnel["unlinked"] == 1


def test_flight_gives_trajectory_and_buildings_in_one_metric_frame() -> None:
    mapper = Mapper(MapperConfig())
    for frame, mask in FLIGHT:
        update = mapper.add(frame, mask)
        assert update is not None
    assert update.funnel["keyframes"] == len(FLIGHT)
    # buildloc_map starts at the first keyframe: align by that pose alone, no fit.
    c, s = math.cos(0.3), math.sin(0.3)
    to_world = np.array([[c, -s], [s, c]])
    places = np.array([(k.x_m, k.y_m) for k in update.keyframes]) @ to_world.T + TRUTH[0]
    assert np.abs(places - TRUTH).max() < 1.0
    centroids = update.local_map.centroids_m @ to_world.T + TRUTH[0]
    whole = np.array([(x, y) for x, y, *_ in BUILDINGS[:3]])
    nearest = np.linalg.norm(centroids[None] - whole[:, None], axis=2).min(axis=1)
    assert nearest.max() < 1.0
    assert len(update.outlines) == len(update.local_map)


def test_a_keyframe_that_links_to_nothing_waits_for_one_that_links_to_it() -> None:
    mapper, there = Mapper(MapperConfig()), [shoot(50 + i, 60.0 - 15.0 * i, 70.0, 0.0) for i in range(2)]
    mapper.add(*FLIGHT[0])
    frame, mask = FLIGHT[1]
    assert mapper.add(replace(frame, image_bgr=np.zeros_like(frame.image_bgr)), mask) is None
    assert mapper.add(*there[0]) is None
    update = mapper.add(*there[1])
    assert update is not None and [k.stamp_ns for k in update.keyframes] == [50, 51]
    assert (update.funnel["submaps"], update.funnel["unlinked"]) == (1, 2)


def test_a_frame_that_opencv_refuses_costs_that_frame_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise cv2.error("(-215:Assertion failed)")

    mapper = Mapper(MapperConfig())
    mapper.add(*FLIGHT[0])
    with monkeypatch.context() as broken:
        broken.setattr(cv2, "cvtColor", refuse)  # of every image that comes in
        for call in (lambda: mapper.add(*FLIGHT[1]), lambda: mapper.track(FLIGHT[1][0])):
            with pytest.raises(MapperError, match="OpenCV refuses the frame"):
                call()
    with monkeypatch.context() as broken:
        broken.setattr(cv2, "estimateAffinePartial2D", refuse)  # of a pair, with the map half changed
        assert mapper.add(*FLIGHT[2]) is None
    update = mapper.add(*FLIGHT[3])
    assert update is not None and update.funnel["rejected_opencv"] >= 1


@pytest.mark.parametrize("stamp", [0, -5])
def test_an_equal_or_earlier_stamp_is_refused_and_nothing_is_lost(stamp: int) -> None:
    mapper = Mapper(MapperConfig())
    mapper.add(*FLIGHT[0])
    frame, mask = FLIGHT[1]
    with pytest.raises(MapperError, match="feed keyframes in the order"):
        mapper.add(replace(frame, stamp_ns=stamp), replace(mask, stamp_ns=stamp))
    update = mapper.add(frame, mask)
    assert update is not None and update.funnel["rejected_stamp"] == 1
    assert [k.stamp_ns for k in update.keyframes] == [0, 1]


def test_reset_forgets_the_flight() -> None:
    mapper = Mapper(MapperConfig())
    mapper.add(*FLIGHT[0])
    mapper.reset()
    update = mapper.add(*FLIGHT[1])
    assert update is not None and len(update.keyframes) == 1


def test_mask_of_another_image_is_refused() -> None:
    with pytest.raises(MapperError, match="stamp or size"):
        Mapper(MapperConfig()).add(FLIGHT[0][0], FLIGHT[1][1])


def test_config_out_of_range_refuses_to_start() -> None:
    with pytest.raises(ConfigError, match=r"map_gsd_m = 0.0 is out of range \[0.05, 5\]"):
        Mapper(replace(MapperConfig(), map_gsd_m=0.0))
