"""What a flight may bring that it should not: the map is right or smaller, never wrong; the flight goes on.

Frames of a textured plane through pairing and mapper, with true masks. Where frames are lost, the others must
still lie where they were taken: ``check`` compares all of them with the truth, after rigid alignment.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.mapper import Mapper, MapUpdate
from buildloc_matcher.geometry import fit_rigid
from buildloc_msgs_py import topics
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.pairing import FrameFault
from buildloc_msgs_py.types import ByteArray, CameraModel, Frame, Mask
from messages import paired
from textured import BUILDINGS, CAMERA, LEVEL, shoot, tilt

SECOND = 10**9
STEP_M = 15.0
Shot = tuple[Frame, Mask]
Place = tuple[float, float]
# A pixel is 0.15 m; registration is good to a fraction of it, and a map's drift over 100 m to some pixels.
NEAR_M = 0.5


def at(
    index: int, place: Place, yaw: float = 0.2, altitude: float = 60.0, camera: CameraModel = CAMERA
) -> Shot:
    """Keyframe number ``index``, five seconds after the one before."""
    return shoot((index + 1) * 5 * SECOND, *place, yaw, altitude, LEVEL, camera)


def straight(count: int = 7) -> list[Place]:
    return [(STEP_M * (i - (count - 1) / 2.0), 2.0 * math.sin(i)) for i in range(count)]


def painted(shot: Shot, image: ByteArray) -> Shot:
    return replace(shot[0], image_bgr=image), shot[1]


def mapped(shots: Sequence[Shot]) -> tuple[MapUpdate, list[bool]]:
    """The map after the last keyframe that gave one, and which keyframes gave one."""
    mapper = Mapper(MapperConfig())
    given = [mapper.add(*shot) is not None for shot in shots]
    update = mapper.finish()
    assert update is not None
    return update, given


def check(update: MapUpdate, shots: Sequence[Shot], places: Sequence[Place], keyframes: int) -> None:
    """Exactly so many keyframes, all where they were taken, and every building where it stands."""
    assert len(update.keyframes) == keyframes
    true = {shot[0].stamp_ns: place for shot, place in zip(shots, places, strict=True)}
    found = np.array([(k.x_m, k.y_m) for k in update.keyframes])
    flown = np.array([true[k.stamp_ns] for k in update.keyframes])
    to_world = fit_rigid(found, flown)
    assert np.linalg.norm(to_world.apply(found) - flown, axis=1).max() < NEAR_M
    whole = update.local_map.select(~update.local_map.cut)
    centroids = to_world.apply(whole.centroids_m)
    standing = np.array([(x, y) for x, y, *_ in BUILDINGS])
    to_true = np.linalg.norm(centroids[:, None] - standing[None], axis=2)
    assert to_true.min(axis=1, initial=np.inf).max(initial=0.0) < 1.0
    assert len(set(to_true.argmin(axis=1))) == len(whole), "a building is in the map twice"


PLACES = straight()
FLIGHT = [at(i, place) for i, place in enumerate(PLACES)]


def test_a_good_flight_is_mapped_whole() -> None:
    update, given = mapped(FLIGHT)
    assert all(given)
    check(update, FLIGHT, PLACES, keyframes=7)
    assert (~update.local_map.cut).sum() >= 3


def test_repeated_frames_neither_drift_nor_double_the_buildings() -> None:
    """A drone that hovers, or a camera driver that sends its last image again."""
    places = [*PLACES[:4], *[PLACES[3]] * 4, *PLACES[4:]]
    hovering = [at(i, place) for i, place in enumerate(places)]
    update, given = mapped(hovering)
    assert all(given)
    check(update, hovering, places, keyframes=11)


def elsewhere(shot: Shot) -> ByteArray:
    noise = np.random.default_rng(9).integers(0, 256, (45, 60, 3), dtype=np.uint8)
    return np.kron(noise, np.ones((8, 8, 1), dtype=np.uint8))


def water(shot: Shot) -> ByteArray:
    """Swell that has gone on by the next frame."""
    rng = np.random.default_rng(shot[0].stamp_ns // SECOND)
    v, u = np.mgrid[:360, :480] / 60.0
    swell = sum(
        3.0 * np.sin(math.cos(a) * k * u + math.sin(a) * k * v + rng.uniform(0.0, math.tau))
        for a, k in ((0.3, 1.0), (0.5, 2.3), (1.9, 3.1))
    )
    grey = np.clip(70.0 + swell + rng.normal(0.0, 1.0, swell.shape), 0, 255).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)


def blurred(shot: Shot) -> ByteArray:
    return np.asarray(cv2.GaussianBlur(shot[0].image_bgr, (0, 0), 25.0), dtype=np.uint8)


@pytest.mark.parametrize(
    "paint",
    [
        elsewhere,
        lambda shot: np.zeros_like(shot[0].image_bgr),
        lambda shot: np.full_like(shot[0].image_bgr, 255),
        blurred,
        water,
    ],
    ids=["elsewhere", "black", "white", "blurred", "water"],
)
def test_one_useless_frame_costs_itself_alone(paint: Callable[[Shot], ByteArray]) -> None:
    shots = list(FLIGHT)
    shots[3] = painted(shots[3], paint(shots[3]))
    update, given = mapped(shots)
    assert given == [True, True, True, False, True, True, True]
    check(update, shots, PLACES, keyframes=6)
    assert sum(count for name, count in update.funnel.items() if name.startswith("rejected_")) >= 1


def test_a_flight_may_begin_with_a_useless_frame() -> None:
    shots = [painted(FLIGHT[0], np.zeros_like(FLIGHT[0][0].image_bgr)), *FLIGHT[1:]]
    update, _ = mapped(shots)
    check(update, shots, PLACES, keyframes=6)


def test_without_overlap_there_is_no_link_but_another_map() -> None:
    """80 m on, the next frame shows none of the ground of the last: of the way between nothing is claimed."""
    places = [(-80.0, 0.0), (-65.0, 0.0), (15.0, 0.0), (30.0, 0.0), (45.0, 0.0)]
    shots = [at(i, place) for i, place in enumerate(places)]
    update, _ = mapped(shots)
    check(update, shots, places, keyframes=3)
    assert [k.stamp_ns for k in update.keyframes] == [shot[0].stamp_ns for shot in shots[2:]]


def test_a_stretch_of_water_splits_the_map_and_a_revisit_joins_it() -> None:
    out, over = [(x, 0.0) for x in (-70.0, -55.0, -40.0, -25.0)], [(100.0, 0.0)] * 6
    back = [(75.0, 10.0), (63.0, 8.0), (48.0, 4.0), (33.0, 2.0), (18.0, 0.0), (3.0, 0.0)]
    places = [*out, *over, *back]
    shots = [at(i, place, yaw=0.2 if i < 10 else 2.5) for i, place in enumerate(places)]
    for i in range(4, 10):
        shots[i] = painted(shots[i], water(shots[i]))
    alone, _ = mapped(shots[:12])
    check(alone, shots[:12], places[:12], keyframes=2)  # what was flown before the water is not in this map
    joined, _ = mapped(shots)
    check(joined, shots, places, keyframes=10)


def test_stamps_out_of_order_are_refused_and_change_nothing() -> None:
    mapper = Mapper(MapperConfig())
    for shot in FLIGHT[:4]:
        mapper.add(*shot)
    for late in (FLIGHT[3], FLIGHT[1]):  # the same stamp again, and one from before
        with pytest.raises(BuildlocError, match="order"):
            mapper.add(*late)
    for shot in FLIGHT[4:]:
        assert mapper.add(*shot) is not None
    update = mapper.finish()
    assert update is not None
    check(update, FLIGHT, PLACES, keyframes=7)


def test_an_altimeter_that_jumps_costs_its_frame() -> None:
    frame, mask = FLIGHT[3]
    shots = [*FLIGHT[:3], (replace(frame, altitude_m=100.0), mask), *FLIGHT[4:]]
    update, given = mapped(shots)
    assert not given[3] and update.funnel["rejected_scale"] >= 1
    check(update, shots, PLACES, keyframes=6)


def test_a_drone_that_climbs_is_followed() -> None:
    shots = [at(i, place, altitude=60.0 if i < 3 else 85.0) for i, place in enumerate(PLACES)]
    update, given = mapped(shots)
    assert all(given)
    check(update, shots, PLACES, keyframes=7)


@pytest.mark.parametrize("altitude_m", [math.nan, 0.0, -5.0, 1e6])
def test_an_impossible_altitude_is_one_line(altitude_m: float) -> None:
    mapper = Mapper(MapperConfig())
    mapper.add(*FLIGHT[0])
    frame, mask = FLIGHT[1]
    with pytest.raises(BuildlocError, match="altitude"):
        mapper.add(replace(frame, altitude_m=altitude_m), mask)
    assert mapper.add(*FLIGHT[2]) is not None


def heading(clockwise_rad: float) -> tuple[float, float, float, float]:
    return 0.0, 0.0, math.sin(clockwise_rad / 2), math.cos(clockwise_rad / 2)


@pytest.mark.parametrize("frozen", [False, True])
def test_a_gimbal_whose_heading_is_frozen_turns_nothing(frozen: bool) -> None:
    """The camera turns by 120 degrees; the gimbal tells it, or says always the same."""
    yaws = [0.4 * max(0, i - 1) for i in range(7)]
    shots = []
    for i, (place, yaw) in enumerate(zip(PLACES, yaws, strict=True)):
        frame, mask = at(i, place, yaw)
        shots.append((replace(frame, attitude_xyzw=heading(0.0 if frozen else -yaw)), mask))
    update, given = mapped(shots)
    assert all(given)
    check(update, shots, PLACES, keyframes=7)
    turned = [k.yaw_rad - update.keyframes[0].yaw_rad for k in update.keyframes]
    assert np.abs(np.array(turned) - yaws).max() < math.radians(1.0)


def test_a_camera_that_looks_at_the_horizon_is_one_line() -> None:
    mapper = Mapper(MapperConfig())
    mapper.add(*FLIGHT[0])
    frame, mask = FLIGHT[1]
    with pytest.raises(BuildlocError, match="point the gimbal down"):
        mapper.add(replace(frame, attitude_xyzw=tilt(0.0, 1.4)), mask)
    assert mapper.add(*FLIGHT[2]) is not None


def through_pairing(
    shots: Sequence[Shot], silent: Callable[[int], tuple[str, ...]]
) -> tuple[list[Shot], list[str]]:
    """The shots that come through, and why the others do not."""
    masks = {mask.stamp_ns: mask for _, mask in shots}
    answers = paired([(frame, silent(i)) for i, (frame, _) in enumerate(shots)])
    faults = [answer.reason for answer in answers if isinstance(answer, FrameFault)]
    return [(f, masks[f.stamp_ns]) for f in answers if isinstance(f, Frame)], faults


def test_a_gimbal_that_falls_silent_costs_the_frames_of_its_silence() -> None:
    """The attitude of five seconds ago is not taken for that of now."""
    came, faults = through_pairing(FLIGHT, lambda i: (topics.GIMBAL_ATTITUDE,) if i in (2, 3) else ())
    assert len(faults) == 2 and all("gimbal/attitude nearest to the image is" in f for f in faults)
    update, _ = mapped(came)
    check(update, FLIGHT, PLACES, keyframes=5)


def test_without_a_gimbal_there_is_no_frame_and_the_reason_is_said() -> None:
    came, faults = through_pairing(FLIGHT, lambda i: (topics.GIMBAL_ATTITUDE,))
    assert came == [] and len(faults) == 7
    assert all("no gimbal/attitude received" in fault for fault in faults)


def test_camera_info_may_change_in_flight() -> None:
    """The camera zooms in, then sends smaller images: every frame goes by the intrinsics of its own time."""
    zoomed = replace(CAMERA, fx=520.0, fy=520.0)
    small = CameraModel(360, 270, 300.0, 300.0, 179.5, 134.5)
    cameras = [CAMERA, CAMERA, zoomed, zoomed, small, small, CAMERA]
    shots = [at(i, place, camera=cameras[i]) for i, place in enumerate(PLACES)]
    came, faults = through_pairing(shots, lambda i: ())
    assert faults == [] and [frame.camera.fx for frame, _ in came] == [c.fx for c in cameras]
    update, _ = mapped(came)
    check(update, shots, PLACES, keyframes=7)


def test_an_image_of_another_size_than_its_camera_info_is_a_fault() -> None:
    small = CameraModel(360, 270, 300.0, 300.0, 179.5, 134.5)
    shots = [at(i, place, camera=small if i == 3 else CAMERA) for i, place in enumerate(PLACES)]
    came, faults = through_pairing(shots, lambda i: (topics.CAMERA_INFO,) if i == 3 else ())
    assert len(faults) == 1 and "image is 360x270 but camera_info says 480x360" in faults[0]
    update, _ = mapped(came)
    check(update, shots, PLACES, keyframes=6)
