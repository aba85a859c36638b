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
from buildloc_mapper.pose_graph import Edge, optimize
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


def test_pose_graph_spreads_a_loop_closure_and_pulls_scale_to_one() -> None:
    step = Similarity(10.0, 0.0, math.pi / 2, 1.02)
    edges = [Edge(i, i + 1, step, 40) for i in range(3)]
    edges.append(Edge(0, 3, Similarity(0.0, 10.0, -math.pi / 2, 1.0), 40, loop=True))
    poses = [Similarity(0.0, 0.0, 0.0, 1.0)]
    for edge in edges[:3]:
        poses.append(poses[-1].compose(edge.transform))
    result = optimize(poses, edges, MapperConfig())
    square = np.array([(0, 0), (10, 0), (10, 10), (0, 10)], dtype=float)
    drifted = np.abs(np.array([p[:2] for p in poses]) - square).max()
    assert np.abs(np.array([p[:2] for p in result]) - square).max() < 0.6 * drifted
    assert abs(result[3].scale - 1.0) < abs(poses[3].scale - 1.0)
    assert result[0] == pytest.approx((0.0, 0.0, 0.0, 1.0), abs=1e-4)


def test_pose_graph_follows_most_links_when_one_lies() -> None:
    step = Similarity(5.0, 0.0, 0.0, 1.0)
    edges = [Edge(i, i + 1, step, 60) for i in range(4)] + [Edge(0, 2, Similarity(40.0, 0.0, 0.0, 1.0), 20)]
    poses = [Similarity(5.0 * i, 0.0, 0.0, 1.0) for i in range(5)]
    # Huber bounds the pull of the outlier (30 m off) to about what its weight allows.
    assert abs(optimize(poses, edges, MapperConfig())[2].x_m - 10.0) < 2.0


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
    update = mapper.add(frame, mask)
    assert update is not None and update.funnel["rejected_scale"] == 1


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


def test_a_keyframe_that_links_to_nothing_is_left_out_and_then_starts_a_new_map() -> None:
    mapper = Mapper(replace(MapperConfig(), max_lost=2))
    mapper.add(*FLIGHT[0])
    blank = np.zeros_like(FLIGHT[0][0].image_bgr)
    for stamp in (50, 51):
        frame, mask = shoot(stamp, 0.0, 0.0, 0.0)
        update = mapper.add(replace(frame, image_bgr=blank), mask)
        assert (update is None) == (stamp == 50)
    assert update is not None and update.funnel["restarts"] == 1
    assert [k.stamp_ns for k in update.keyframes] == [51]


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
