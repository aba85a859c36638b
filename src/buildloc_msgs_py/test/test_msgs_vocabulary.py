"""Footprint metrics, ground geometry, configuration ranges and the pairing of images with telemetry."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from buildloc_msgs_py import ground, topics
from buildloc_msgs_py.config import ConfigError, check, from_mapping, param
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import footprint
from buildloc_msgs_py.pairing import FrameFault, FramePairing
from buildloc_msgs_py.types import CameraModel, Frame
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity
from shapely.geometry import Polygon

L_SHAPE = Polygon([(0, 0), (10, 0), (10, 5), (5, 5), (5, 10), (0, 10)])
CAMERA = CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5)
LEVEL = (0.0, 0.0, 0.0, 1.0)


def test_shape_metrics_of_a_rectangle() -> None:
    found = footprint(Polygon([(0, 0), (10, 0), (10, 5), (0, 5)]))
    assert (found.x_m, found.y_m, found.area_m2) == (5.0, 2.5, 50.0)
    assert found.shape == pytest.approx((4 * math.pi * 50 / 30**2, 0.5, 1.0, 1.0))


def test_shape_metrics_of_an_l() -> None:
    found = footprint(L_SHAPE)
    assert found.area_m2 == 75.0
    assert found.convexity == pytest.approx(75 / 87.5)
    # The tightest box of the L leans 45 degrees: the diagonal by three quarters of it.
    box = L_SHAPE.minimum_rotated_rectangle
    assert found.rectangularity == pytest.approx(75 / box.area)


@settings(max_examples=50, deadline=None)
@given(
    angle=st.floats(-180, 180), factor=st.floats(0.1, 20), dx=st.floats(-1e3, 1e3), dy=st.floats(-1e3, 1e3)
)
def test_shape_metrics_do_not_change_under_a_similarity(
    angle: float, factor: float, dx: float, dy: float
) -> None:
    moved = affinity.translate(affinity.scale(affinity.rotate(L_SHAPE, angle), factor, factor), dx, dy)
    assert footprint(moved).shape == pytest.approx(footprint(L_SHAPE).shape, rel=1e-4)
    assert footprint(moved).area_m2 == pytest.approx(75.0 * factor**2, rel=1e-6)


@pytest.mark.parametrize("bad", [Polygon(), Polygon([(0, 0), (1, 1), (1, 0), (0, 1)])])
def test_an_outline_without_area_or_validity_is_refused(bad: Polygon) -> None:
    with pytest.raises(BuildlocError, match="repair it"):
        footprint(bad)


def test_a_level_camera_puts_the_image_centre_below_itself_and_up_is_up() -> None:
    uv = np.array([[31.5, 23.5], [41.5, 23.5], [31.5, 13.5]])
    metres = ground.pixels_to_level(uv, CAMERA, 100.0, LEVEL)
    assert metres == pytest.approx(np.array([[0.0, 0.0], [20.0, 0.0], [0.0, 20.0]]))


def test_tilt_moves_the_centre_by_its_tangent_and_heading_does_not() -> None:
    pitch = math.radians(10.0)
    tilted = (math.sin(pitch / 2), 0.0, 0.0, math.cos(pitch / 2))  # image-up swings forward
    centre = np.array([[31.5, 23.5]])
    there = ground.pixels_to_level(centre, CAMERA, 100.0, tilted)
    assert np.abs(there[0]) == pytest.approx([0.0, 100.0 * math.tan(pitch)])
    half = math.radians(35.0)
    z, w = math.sin(half), math.cos(half)
    turned = (w * tilted[0], z * tilted[0], z * tilted[3], w * tilted[3])  # heading after tilt
    assert ground.pixels_to_level(centre, CAMERA, 100.0, turned) == pytest.approx(there)
    assert ground.heading_rad((0.0, 0.0, z, w)) == pytest.approx(math.radians(70.0))


LENSES = [
    ((-0.2, 0.05, 0.001, -0.002, 0.0), "plumb_bob"),
    ((-0.2, 0.05, 0.001, -0.002, 0.01, 0.1, 0.02, 0.001), "rational_polynomial"),
    ((0.05, -0.02, 0.003, -0.001), "equidistant"),
]


@pytest.mark.parametrize(("distortion", "model"), LENSES)
def test_distortion_is_taken_out_of_points_and_of_images_alike(
    distortion: tuple[float, ...], model: str
) -> None:
    camera = CameraModel(640, 480, 500.0, 510.0, 322.0, 236.0, distortion, model)
    tilted = (0.08, -0.05, 0.0, math.sqrt(1 - 0.08**2 - 0.05**2))
    uv = np.array([[240.0, 150.0], [322.0, 236.0], [480.0, 340.0]])
    level = ground.pixels_to_level(uv, camera, 100.0, tilted)
    back = level @ [[1.0, 0.0], [0.0, -1.0]] / 100.0 * [500.0, 510.0] + [322.0, 236.0]
    image = np.zeros((480, 640), dtype=np.uint8)
    for u, v in uv.astype(int):
        cv2.circle(image, (u, v), 5, 255, -1)
    discs = (ground.rectify(image, camera, tilted) > 127).astype(np.uint8)
    _, _, _, found = cv2.connectedComponentsWithStats(discs)
    # A disc's centre moves less than half a pixel where its lens and tilt bend it.
    assert np.sort(found[1:], axis=0) == pytest.approx(np.sort(back, axis=0), abs=0.5)
    straight = ground.pixels_to_level(uv, replace(camera, distortion=()), 100.0, tilted)
    assert np.abs(straight - level)[[0, 2]].max() > 0.3


def test_a_bent_edge_is_followed() -> None:
    straight, bent = replace(CAMERA, distortion=()), replace(CAMERA, distortion=(-0.2, 0.0, 0.0, 0.0))
    assert len(ground.border(straight)) == 4
    assert ground.border(straight).tolist() == [[-0.5, -0.5], [63.5, -0.5], [63.5, 47.5], [-0.5, 47.5]]
    assert len(ground.border(bent)) == 64


def test_a_camera_that_looks_at_the_horizon_is_refused() -> None:
    with pytest.raises(BuildlocError, match="point the gimbal down"):
        ground.level_matrix((math.sin(math.radians(40)), 0.0, 0.0, math.cos(math.radians(40))))


def test_outlines_have_the_area_of_their_pixels() -> None:
    mask = np.zeros((40, 60), dtype=np.uint8)
    mask[10:20, 30:50] = 255
    (outline,) = ground.outlines(mask, 0.5, 1.0)
    assert outline.bounds == pytest.approx((0.0, 0.0, 10.0, 5.0))
    assert ground.outlines(mask, 0.5, 51.0) == []


def test_observe_leaves_out_what_touches_the_border() -> None:
    mask = np.zeros((48, 64), dtype=np.uint8)
    mask[0:10, 0:10] = 255
    mask[20:28, 28:36] = 255
    seen = ground.observe(mask, 5, CAMERA, 100.0, LEVEL, 20.0)
    assert seen.centroids_m == pytest.approx(np.array([[0.0, 0.0]]))
    assert (seen.stamp_ns, seen.altitude_m) == (5, 100.0)


def test_observe_follows_outlines_counter_clockwise() -> None:
    mask = np.zeros((48, 64), dtype=np.uint8)
    mask[10:40, 10:50] = 255
    mask[15:35, 15:45] = 0  # a courtyard
    mask[20:30, 25:35] = 255  # and a house in it
    seen = ground.observe(mask, 5, CAMERA, 100.0, LEVEL, 20.0)
    assert seen.outlines_m is not None and seen.outlines_m.shape == (2, ground.OUTLINE_POINTS, 2)
    pixel = 100.0 / CAMERA.fx
    sides = np.array([[39.0, 29.0], [9.0, 9.0]]) * pixel  # between the centres of the outermost pixels
    for ring, centre, side in zip(seen.outlines_m, seen.centroids_m, sides, strict=True):
        assert np.abs(ring - centre).max(axis=0) == pytest.approx(side / 2.0, abs=pixel)
        x, y = ring.T
        assert 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) == pytest.approx(side.prod(), rel=0.1)


def test_a_frame_without_buildings_has_no_outlines() -> None:
    seen = ground.observe(np.zeros((48, 64), np.uint8), 5, CAMERA, 100.0, LEVEL, 20.0)
    assert seen.centroids_m.shape == (0, 2)
    assert seen.outlines_m is not None and seen.outlines_m.shape == (0, ground.OUTLINE_POINTS, 2)


@dataclass(frozen=True)
class SampleConfig:
    """A config of every kind of parameter."""

    period_s: float = param(5.0, "period, s", 0.1, 60.0)
    count: int = param(3, "count", 1, 9)
    name: str = param("a", "name")
    providers: tuple[str, ...] = param(("cpu",), "providers")


def test_config_from_a_mapping() -> None:
    made = from_mapping(SampleConfig, {"period_s": 7, "providers": ["x", "y"]})
    assert made == SampleConfig(period_s=7.0, providers=("x", "y"))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"period_s": 61.0}, r"parameter period_s = 61.0 is out of range \[0.1, 60\]"),
        ({"period_s": math.nan}, "parameter period_s = nan is out of range"),
        ({"count": 2.5}, "parameter count = 2.5 is not a int"),
        ({"cuont": 2}, "parameter cuont is unknown to SampleConfig; it has period_s, count"),
    ],
)
def test_config_refuses_with_name_value_and_range(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_mapping(SampleConfig, values)
    check(SampleConfig())


def stamped(stamp_s: float, **values: Any) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=int(stamp_s), nanosec=round((stamp_s % 1) * 1e9))
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp, frame_id="camera"), **values)


def info(stamp_s: float, width: int = 64) -> SimpleNamespace:
    return stamped(stamp_s, width=width, height=48, k=[50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1], d=[])


def image(stamp_s: float) -> SimpleNamespace:
    data = np.zeros(64 * 48 * 3, dtype=np.uint8)
    return stamped(stamp_s, width=64, height=48, step=192, encoding="bgr8", data=data)


def height(stamp_s: float, metres: float) -> SimpleNamespace:
    return stamped(stamp_s, range=metres)


def attitude(stamp_s: float) -> SimpleNamespace:
    return stamped(stamp_s, quaternion=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0))


def play(pairing: FramePairing, *messages: tuple[str, Any]) -> list[Frame | FrameFault]:
    return [result for topic, message in messages for result in pairing.add(topic, message)]


def test_an_image_waits_for_telemetry_and_takes_the_nearest_in_any_order() -> None:
    pairing = FramePairing()
    before = play(
        pairing,
        (topics.CAMERA_INFO, info(1.0)),
        (topics.ALTITUDE, height(0.9, 90.0)),
        (topics.IMAGE, image(1.0)),
        (topics.GIMBAL_ATTITUDE, attitude(1.0)),
    )
    assert before == []
    (frame,) = play(pairing, (topics.ALTITUDE, height(1.05, 105.0)))
    assert isinstance(frame, Frame) and frame.altitude_m == 105.0 and frame.stamp_ns == 10**9
    assert play(pairing, (topics.IMAGE, image(1.0))) == []  # the same picture again


def test_an_image_without_its_telemetry_is_a_fault_that_names_the_topic() -> None:
    pairing = FramePairing()
    play(
        pairing,
        (topics.CAMERA_INFO, info(1.0)),
        (topics.ALTITUDE, height(1.0, 90.0)),
        (topics.IMAGE, image(1.0)),
    )
    (fault,) = pairing.flush()
    assert isinstance(fault, FrameFault) and fault.stamp_ns == 10**9
    assert fault.reason == "no gimbal/attitude received; check that it is published or recorded"


def test_a_bad_altitude_is_a_fault_and_never_the_last_good_one() -> None:
    pairing = FramePairing()
    good = [
        (topics.CAMERA_INFO, info(1.0)),
        (topics.ALTITUDE, height(0.8, 90.0)),
        (topics.GIMBAL_ATTITUDE, attitude(1.0)),
    ]
    (fault,) = play(pairing, *good, (topics.IMAGE, image(1.0)), (topics.ALTITUDE, height(1.0, math.nan)))
    assert isinstance(fault, FrameFault) and "altitude nan m is not a positive number" in fault.reason


def test_telemetry_that_stopped_is_a_fault() -> None:
    pairing = FramePairing()
    play(
        pairing,
        (topics.CAMERA_INFO, info(1.0)),
        (topics.ALTITUDE, height(1.0, 90.0)),
        (topics.GIMBAL_ATTITUDE, attitude(9.0)),
    )
    (fault,) = [*play(pairing, (topics.IMAGE, image(9.0))), *pairing.flush()]
    assert isinstance(fault, FrameFault) and "altitude nearest to the image is 8.0 s away" in fault.reason


def test_images_wait_for_telemetry_that_lags_but_not_for_one_that_is_silent() -> None:
    """A busy node takes one message of each topic in turn: images run ahead of telemetry at 10 Hz."""
    pairing = FramePairing()
    play(pairing, (topics.CAMERA_INFO, info(1.0)))
    taken: list[Frame | FrameFault] = []
    for turn in range(40):
        stamp_s = 1.0 + turn / 10
        telemetry = (
            (topics.ALTITUDE, height(stamp_s, 60.0 + stamp_s)),
            (topics.GIMBAL_ATTITUDE, attitude(stamp_s)),
        )
        images = ((topics.IMAGE, image(turn)),) if 1 <= turn < 9 else ()
        taken += play(pairing, *images, *telemetry)
    assert [f.altitude_m for f in taken if isinstance(f, Frame)] == [61.0, 62.0, 63.0, 64.0]
    silent = [(topics.IMAGE, image(second)) for second in range(9, 13)]
    taken = play(pairing, *silent)
    assert [f.stamp_ns // 10**9 for f in taken if isinstance(f, FrameFault)] == [6, 7, 8]


def test_reset_forgets_images_and_telemetry_but_not_the_intrinsics() -> None:
    pairing = FramePairing()
    before = [(topics.ALTITUDE, height(5.0, 90.0)), (topics.GIMBAL_ATTITUDE, attitude(5.0))]
    play(pairing, (topics.CAMERA_INFO, info(1.0)), *before, (topics.IMAGE, image(6.0)))
    pairing.reset()
    assert pairing.flush() == [] and play(pairing, (topics.IMAGE, image(5.0))) == []
    (frame,) = play(pairing, (topics.GIMBAL_ATTITUDE, attitude(5.0)), (topics.ALTITUDE, height(5.0, 70.0)))
    assert isinstance(frame, Frame) and frame.altitude_m == 70.0


def test_an_image_of_another_size_than_camera_info_is_a_fault() -> None:
    pairing = FramePairing()
    messages = [
        (topics.CAMERA_INFO, info(1.0, width=65)),
        (topics.ALTITUDE, height(1.0, 90.0)),
        (topics.GIMBAL_ATTITUDE, attitude(1.0)),
    ]
    (fault,) = play(pairing, *messages, (topics.IMAGE, image(1.0)))
    assert isinstance(fault, FrameFault) and "image is 64x48 but camera_info says 65x48" in fault.reason
