"""Submaps over a textured plane: lost stretches, foreign frames, revisits, and what the gimbal says."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_mapper.appearance import LANDMARKS, Appearance, signature
from buildloc_mapper.atlas import Atlas
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.matching import Described
from buildloc_mapper.registration import Link, Registration
from buildloc_msgs_py.types import Frame
from textured import shoot

SECOND = 10**9
CONFIG = MapperConfig()


def heading(clockwise_rad: float) -> tuple[float, float, float, float]:
    return 0.0, 0.0, math.sin(clockwise_rad / 2), math.cos(clockwise_rad / 2)


def at(index: int, x: float, y: float, yaw: float = 0.0, altitude: float = 60.0, told: float = 0.0) -> Frame:
    """Frame number ``index`` at (x, y); the gimbal tells ``told`` as its yaw."""
    return shoot(index * 5 * SECOND, x, y, yaw, altitude, heading(-told))[0]


def black(index: int) -> Frame:
    frame = at(index, 0.0, 0.0)
    return replace(frame, image_bgr=np.zeros_like(frame.image_bgr))


def elsewhere(index: int) -> Frame:
    """Ground of another place: noise that nothing else shows."""
    frame = at(index, 0.0, 0.0)
    noise = np.random.default_rng(index).integers(0, 256, (45, 60, 3), dtype=np.uint8)
    return replace(frame, image_bgr=np.kron(noise, np.ones((8, 8, 1), dtype=np.uint8)))


def flown(frames: list[Frame], config: MapperConfig = CONFIG) -> tuple[Atlas, list[int]]:
    atlas = Atlas(config)
    return atlas, [atlas.add(frame) for frame in frames]


def places(atlas: Atlas, keyframes: list[int]) -> np.ndarray:
    """(N, 2) places of keyframes of one submap, from the first of them."""
    poses = atlas.submap(keyframes[0]).poses
    found = np.array([poses[k][:2] for k in keyframes])
    return found - found[0]


def test_a_foreign_frame_stays_alone_and_the_flight_goes_on() -> None:
    atlas, ids = flown([at(0, -50.0, 0.0), elsewhere(1), at(2, -35.0, 0.0), at(3, -20.0, 0.0)])
    assert ids == [0, 1, 2, 3]
    assert list(atlas.submap(3).poses) == [0, 2, 3] and list(atlas.submap(1).poses) == [1]
    assert places(atlas, [0, 2, 3]) == pytest.approx(np.array([(0, 0), (15, 0), (30, 0)]), abs=0.2)


def test_black_frames_stay_alone_and_are_counted() -> None:
    atlas, _ = flown([at(0, -50.0, 0.0), black(1), black(2), at(3, -35.0, 0.0)])
    assert list(atlas.submap(3).poses) == [0, 3]
    assert len(atlas.submaps()) == 3
    assert atlas.counts["rejected_few_matches"] >= 3  # 1 to 0, 2 to 1 and 0, 3 to 2 and 1


def test_featureless_water_ends_a_submap_and_a_revisit_joins_what_lies_on_both_sides() -> None:
    water = [black(i) for i in range(2, 7)]
    there = [at(7, 40.0, 60.0), at(8, 30.0, 60.0)]
    back = [at(9, 15.0, 40.0), at(10, -10.0, 15.0), at(11, -40.0, -5.0, 2.0), at(12, -48.0, 0.0, 2.0)]
    atlas, _ = flown([at(0, -50.0, 0.0), at(1, -40.0, 0.0), *water, *there, *back])
    joined = atlas.submap(12)
    assert list(joined.poses) == [0, 1, 7, 8, 9, 10, 11, 12]
    true = np.array([(-50, 0), (-40, 0), (40, 60), (30, 60), (15, 40), (-10, 15), (-40, -5), (-48, 0)])
    assert places(atlas, list(joined.poses)) == pytest.approx(true - true[0], abs=1.5)


LOST = [at(0, -70.0, -60.0), at(1, -55.0, -60.0), at(2, 55.0, 70.0), at(3, 40.0, 70.0)]


def test_ground_that_links_to_nothing_starts_a_submap_and_the_earlier_one_is_kept() -> None:
    atlas, _ = flown(LOST)
    assert [list(submap.poses) for submap in atlas.submaps()] == [[0, 1], [2, 3]]
    assert places(atlas, [2, 3])[1] == pytest.approx((-15.0, 0.0), abs=0.2)


def test_submaps_are_joined_when_the_flight_comes_back_at_another_heading() -> None:
    back = [
        at(4, 42.0, 68.0, 2.0),
        at(5, -68.0, -58.0, 2.0),
        at(6, -60.0, -60.0, 2.1),
        at(7, 47.0, 69.0, 1.0),
    ]
    atlas, _ = flown([*LOST, *back])
    assert len(atlas.submaps()) == 2 and list(atlas.submap(7).poses) == [2, 3, 4, 7]
    assert list(atlas.submap(6).poses) == [0, 1, 5, 6]
    # A frame that sees both: the plane is small, so one from high above does.
    high = [at(8, 20.0, 30.0, 1.0, 100.0), at(9, -20.0, -20.0, 1.0, 100.0), at(10, -50.0, -50.0, 1.0, 80.0)]
    for frame in high:
        atlas.add(frame)
    assert [list(submap.poses) for submap in atlas.submaps()] == [list(range(11))]
    assert atlas.counts["joins"] == 1
    true = np.array([(-70, -60), (-55, -60), (55, 70), (40, 70), (42, 68), (-68, -58), (-60, -60), (47, 69)])
    # The first link is 15 m long and the plane 240 m: its error in yaw and scale is stretched tenfold.
    assert places(atlas, list(range(8))) == pytest.approx(true - true[0], abs=2.0)


def test_a_loop_is_closed_at_any_heading() -> None:
    config = replace(CONFIG, loop_gap=3)
    ring = [(-40, -40, 0.0), (-20, -40, 0.4), (0, -40, 0.9), (0, -20, 1.4), (-20, -20, 2.0), (-40, -25, 2.6)]
    atlas, _ = flown([at(i, *pose) for i, pose in enumerate([*ring, (-40, -40, 3.1)])], config)
    graph = atlas.submap(6)
    loops = [(edge.earlier, edge.later) for edge in graph.edges if edge.loop]
    assert (0, 6) in loops
    assert places(atlas, [0, 6])[1] == pytest.approx((0.0, 0.0), abs=0.1)
    assert any(edge.later - edge.earlier == 2 for edge in graph.edges if not edge.loop)


def test_gimbal_turns_that_stand_still_or_lie_are_left_out() -> None:
    yaws = [0.0, 0.05, 0.1, 0.15]
    honest, _ = flown([at(i, -40 + 10 * i, 0, yaw, told=yaw) for i, yaw in enumerate(yaws)])
    assert not honest.counts["gimbal_yaw_frozen"] and not honest.counts["gimbal_yaw_denied"]
    frozen, _ = flown([at(i, -40 + 10 * i, 0, yaw) for i, yaw in enumerate(yaws)])
    assert frozen.counts["gimbal_yaw_frozen"] == 3
    lying, _ = flown([at(i, -40 + 10 * i, 0, yaw, told=-5 * yaw) for i, yaw in enumerate(yaws)])
    assert lying.counts["gimbal_yaw_denied"] == 3
    for atlas in (honest, frozen, lying):
        assert places(atlas, [0, 1, 2, 3])[3] == pytest.approx((30.0, 0.0), abs=0.2)


def test_an_altimeter_that_is_off_by_3_percent_scales_the_map_and_the_sigma_says_so() -> None:
    path = [(-40.0 + 12 * i, 2.0 * i) for i in range(5)]
    frames = [replace(at(i, x, y), altitude_m=1.03 * 60.0) for i, (x, y) in enumerate(path)]
    atlas, _ = flown(frames)
    length = float(np.linalg.norm(places(atlas, [0, 4])[1])) / math.dist(path[0], path[4])
    assert length == pytest.approx(1.03, abs=0.003)
    assert abs(length - 1.0) < 2.0 * atlas.submap(4).scale_sigma(4)
    assert atlas.submap(4).poses[4].scale == pytest.approx(1.0, abs=0.003)


def test_a_camera_that_changes_in_flight_keeps_the_scale() -> None:
    frames = [at(i, -40.0 + 12 * i, 0.0) for i in range(4)]
    for i in (2, 3):  # the middle of the image alone
        camera, image = frames[i].camera, frames[i].image_bgr[30:-30, 40:-40]
        camera = replace(camera, width=400, height=300, cx=camera.cx - 40, cy=camera.cy - 30)
        frames[i] = replace(frames[i], camera=camera, image_bgr=np.ascontiguousarray(image))
    atlas, _ = flown(frames)
    assert places(atlas, [0, 1, 2, 3])[3] == pytest.approx((36.0, 0.0), abs=0.2)


def test_repeated_frames_do_not_move() -> None:
    frames = [at(0, -40.0, 0.0), at(1, -28.0, 0.0)]
    frames += [replace(frames[1], stamp_ns=i * 5 * SECOND) for i in (2, 3)] + [at(4, -16.0, 0.0)]
    atlas, _ = flown(frames)
    true = np.array([(0, 0), (12, 0), (12, 0), (12, 0), (24, 0)])
    assert places(atlas, [0, 1, 2, 3, 4]) == pytest.approx(true, abs=0.15)


def test_a_packed_keyframe_registers_as_before() -> None:
    registration = Registration(CONFIG)
    one, other = (registration.prepare(at(i, -40.0 + 12 * i, 0.0, 0.1 * i)) for i in range(2))
    fresh, packed = (registration.register(e, other) for e in (one, one.packed().unpacked()))
    assert isinstance(fresh, Link) and isinstance(packed, Link)
    assert packed.transform == pytest.approx(fresh.transform, abs=0.01)
    assert one.packed().jpeg.nbytes < 0.6 * one.level.grey.nbytes


def test_following_a_known_motion_gives_what_registration_gives() -> None:
    registration = Registration(CONFIG)
    one, other = (registration.prepare(at(i, -40.0 + 12 * i, 0.0, 0.1 * i)) for i in range(2))
    full = registration.register(one, other)
    assert isinstance(full, Link)
    near = full.transform._replace(x_m=full.transform.x_m + 0.8, yaw_rad=full.transform.yaw_rad + 0.01)
    followed = registration.follow(one, other.level, near)
    assert isinstance(followed, Link)
    assert followed.transform == pytest.approx(full.transform, abs=0.03)


def test_alike_are_those_that_share_features_in_any_order() -> None:
    rng = np.random.default_rng(1)
    seen = rng.integers(0, 120, (20, LANDMARKS, 128)).astype(np.uint8)
    appearance = Appearance()
    signatures = [signature(Described(np.zeros((LANDMARKS, 2)), d)) for d in seen]
    for one in signatures:
        appearance.add(one)
    half = np.concatenate([signatures[13][::-2], signatures[4][:10], rng.normal(size=(22, 32))]).astype(
        np.float32
    )
    assert appearance.alike(half, np.arange(20))[:2].tolist() == [13, 4]
    assert appearance.alike(half, np.array([2, 4, 7]))[0] == 4
    appearance.add(signatures[0][:0])  # a keyframe without features is like none
    assert appearance.alike(half, np.arange(21))[0] == 13
