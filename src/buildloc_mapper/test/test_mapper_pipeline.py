"""A textured plane with known buildings, photographed from known poses: poses and buildings come back."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.extraction import extract_buildings
from buildloc_mapper.fusion import FusedMap, View, fuse
from buildloc_mapper.mapper import Mapper, MapperError
from buildloc_mapper.pose_graph import Edge, optimize
from buildloc_mapper.registration import Link, Rejection, Similarity, extract, register
from buildloc_msgs_py.config import ConfigError
from buildloc_msgs_py.ground import camera_matrix, level_matrix
from buildloc_msgs_py.types import ByteArray, CameraModel, Frame, Mask

GSD = 0.2
SIDE = 1200  # world of 240 m, origin at its centre, y up
CAMERA = CameraModel(480, 360, 400.0, 400.0, 239.5, 179.5)
LEVEL = (0.0, 0.0, 0.0, 1.0)
BUILDINGS = [
    (-40.0, -10.0, 14.0, 9.0),
    (-5.0, 12.0, 10.0, 10.0),
    (30.0, -8.0, 18.0, 8.0),
    (55.0, 20.0, 9.0, 12.0),
]


def world() -> tuple[ByteArray, ByteArray]:
    """Image (SIDE, SIDE, 3) and building mask of the plane."""
    rng = np.random.default_rng(3)
    noise = sum(
        cv2.resize(rng.normal(size=(SIDE // k, SIDE // k)), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC) * w
        for k, w in ((4, 18.0), (12, 22.0), (40, 18.0))
    )
    grey = np.clip(110 + noise, 0, 255).astype(np.uint8)
    mask = np.zeros((SIDE, SIDE), dtype=np.uint8)
    for x, y, w, h in BUILDINGS:
        c0, r0 = (round(v / GSD) for v in (x - w / 2 + SIDE * GSD / 2, SIDE * GSD / 2 - y - h / 2))
        mask[r0 : r0 + int(h / GSD), c0 : c0 + int(w / GSD)] = 255
    grey[mask > 0] = np.clip(grey[mask > 0].astype(int) + 60, 0, 255)
    return np.repeat(grey[:, :, None], 3, axis=2), mask


WORLD, WORLD_MASK = world()


def tilt(roll_rad: float, pitch_rad: float) -> tuple[float, float, float, float]:
    qx, qy = math.sin(roll_rad / 2), math.sin(pitch_rad / 2)
    return qx, qy, 0.0, math.sqrt(1 - qx * qx - qy * qy)


def shoot(
    stamp: int, x: float, y: float, yaw: float, altitude: float = 60.0, attitude=LEVEL
) -> tuple[Frame, Mask]:
    """Frame and mask of a camera at (x, y) whose image-right points to ``yaw``."""
    c, s = math.cos(yaw), math.sin(yaw)
    to_world = np.array([[c, -s, x], [s, c, y], [0, 0, 1.0]])
    to_pixel = np.array([[1 / GSD, 0, SIDE / 2 - 0.5], [0, -1 / GSD, SIDE / 2 - 0.5], [0, 0, 1.0]])
    ray = camera_matrix(CAMERA) @ level_matrix(attitude).T @ np.diag([1.0, -1.0, altitude])
    homography = to_pixel @ to_world @ np.linalg.inv(ray)
    size, flags = (CAMERA.width, CAMERA.height), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    image = cv2.warpPerspective(WORLD, homography, size, flags=flags)
    pixels = (cv2.warpPerspective(WORLD_MASK, homography, size, flags=flags) > 127).astype(np.uint8) * 255
    return Frame(stamp, "camera", image, CAMERA, altitude, attitude), Mask(stamp, "camera", pixels)


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


def test_register_recovers_the_relative_pose_through_altitude_and_tilt_changes() -> None:
    config = MapperConfig()
    link = register(extract(FLIGHT[0][0], config), extract(FLIGHT[1][0], config), config)
    assert isinstance(link, Link)
    c, s = math.cos(-0.3), math.sin(-0.3)
    expected = np.array([[c, -s], [s, c]]) @ [20.0, 2.0]
    # A tenth of the ground size of four pixels: what SIFT gives on clean texture.
    assert np.allclose((link.transform.x_m, link.transform.y_m), expected, atol=0.3)
    assert link.transform.yaw_rad == pytest.approx(0.05, abs=0.005)
    assert link.transform.scale == pytest.approx(1.0, abs=0.01)


def test_register_rejects_ground_that_does_not_overlap_and_a_wrong_altitude() -> None:
    config = MapperConfig()
    first = extract(FLIGHT[0][0], config)
    assert isinstance(register(first, extract(shoot(9, 80.0, 60.0, 0.0)[0], config), config), Rejection)
    wrong = replace(FLIGHT[1][0], altitude_m=90.0)
    assert register(first, extract(wrong, config), config) == Rejection("scale")


def test_a_blank_image_has_no_features_and_links_to_nothing() -> None:
    blank = replace(FLIGHT[0][0], image_bgr=np.zeros_like(FLIGHT[0][0].image_bgr))
    features = extract(blank, MapperConfig())
    assert len(features.points_m) == 0
    assert register(features, features, MapperConfig()) == Rejection("few_matches")


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


def test_fusion_counts_views_and_drops_what_one_view_alone_claims() -> None:
    (frame, mask), pose = FLIGHT[0], Similarity(0.0, 0.0, 0.0, 1.0)
    ghost = mask.pixels.copy()
    ghost[10:60, 10:60] = 255
    views = [
        View(pixels, frame.camera, frame.altitude_m, frame.attitude_xyzw)
        for pixels in (mask.pixels, mask.pixels, ghost)
    ]
    config = MapperConfig()
    fused = fuse(views, [pose] * 3, config)
    assert fused.seen.max() == 3
    alone = fuse(views[:2], [pose] * 2, config)
    assert np.array_equal(fused.confirmed(config), alone.confirmed(config))
    assert (
        fused.confirmed(replace(config, min_observations=1, min_share=0.3)).sum()
        > alone.confirmed(config).sum()
    )


def test_extraction_leaves_out_buildings_that_were_not_seen_whole() -> None:
    building = np.zeros((40, 60), dtype=np.uint16)
    building[10:20, 10:30] = 2
    building[25:35, 40:60] = 2  # runs out of the observed ground
    seen = np.full_like(building, 2)
    found = extract_buildings(FusedMap(100.0, 50.0, 1.0, seen, building), 7, MapperConfig())
    assert (found.truncated, len(found.local_map), found.local_map.stamp_ns) == (1, 1, 7)
    assert found.local_map.centroids_m[0] == pytest.approx((120.0, 35.0))
    assert found.local_map.areas_m2[0] == pytest.approx(200.0)
    assert found.outlines[0].bounds == pytest.approx((110.0, 30.0, 130.0, 40.0))


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
