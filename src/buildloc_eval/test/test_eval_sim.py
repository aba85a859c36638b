"""Simulated flights: geometry against an independent derivation, worlds, bags and their truth."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from buildloc.bag import read_frames
from buildloc_eval.camera import attitude, camera_model, photograph
from buildloc_eval.cli import add_sim_arguments, run_sim
from buildloc_eval.flight import FlightConfig, FlightError, fly, legs, margin_m
from buildloc_eval.report import score
from buildloc_eval.sim import SimError, write_flight
from buildloc_eval.town import suburb, write_town
from buildloc_eval.truth import TruthError, read_truth
from buildloc_eval.world import OrthoWorld, TownWorld, WorldError, to_utm
from buildloc_msgs_py.ground import pixels_to_level, rotation_matrix
from buildloc_msgs_py.types import Fix, Frame, NoFix
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Transformer

CENTRE = (47.62, 8.15)
SMALL = FlightConfig(
    length_m=120.0, leg_m=80.0, spacing_m=30.0, altitude_m=60.0, width=320, height=240, speed_mps=10.0
)
angles = st.floats(-0.3, 0.3)


@settings(max_examples=40, deadline=None)
@given(roll=angles, pitch=angles, heading=st.floats(-3.1, 3.1), u=st.floats(0, 319), v=st.floats(0, 239))
def test_attitude_and_levelling_agree_with_plain_ray_casting(
    roll: float, pitch: float, heading: float, u: float, v: float
) -> None:
    camera, altitude_m = camera_model(SMALL), 60.0
    quaternion = attitude(roll, pitch, heading)
    ray = rotation_matrix(quaternion) @ [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0]
    x, y = ray[:2] / ray[2] * altitude_m  # level axes turned by the heading, y to the right of x
    c, s = math.cos(heading), math.sin(heading)
    unturned = np.array([c * x + s * y, -s * x + c * y])
    level = pixels_to_level(np.array([[u, v]]), camera, altitude_m, quaternion)[0]
    assert level == pytest.approx([unturned[0], -unturned[1]], abs=1e-6)


def test_a_camera_that_sees_beyond_the_world_is_refused() -> None:
    camera, level = camera_model(SMALL), attitude(0.0, 0.0, 0.0)
    rng = np.random.default_rng(1)
    photograph(Target(215.0, 205.0), camera, (50.0, 50.0, 60.0, 0.0), level, SMALL, rng)
    with pytest.raises(WorldError, match="beyond the edge"):
        photograph(Target(215.0, 205.0), camera, (40.0, 50.0, 60.0, 0.0), level, SMALL, rng)


class Target:
    """Flat ground with one bright dot."""

    epsg = 32632
    bounds_m = (0.0, 0.0, 400.0, 400.0)

    def __init__(self, x: float, y: float) -> None:
        self._x, self._y = x, y

    def window(self, box_m: tuple[float, float, float, float]):
        from buildloc_eval.world import Window

        image = np.zeros((2000, 2000, 3), dtype=np.uint8)
        column, row = round(self._x / 0.2 - 0.5), round((400.0 - self._y) / 0.2 - 0.5)
        cv2.circle(image, (column, row), 6, (255,) * 3, -1)
        return Window(image, 0.0, 400.0, 0.2)


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw"), [(0.0, 0.0, 0.0), (0.06, -0.04, 0.7), (-0.08, 0.05, -2.4), (0.02, 0.1, 3.0)]
)
def test_a_ground_point_comes_back_from_its_pixel(roll: float, pitch: float, yaw: float) -> None:
    camera = camera_model(SMALL)
    clean = replace(SMALL, exposure=0.0, blur_px=0.0, noise=0.0)
    x, y, altitude_m = 200.0, 210.0, 60.0
    told = attitude(roll, pitch, -yaw)
    pose, rng = (x, y, altitude_m, yaw), np.random.default_rng(1)
    image = photograph(Target(215.0, 205.0), camera, pose, told, clean, rng)
    moments = cv2.moments(image[:, :, 0], binaryImage=False)
    pixel = np.array([[moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]]])
    level = pixels_to_level(pixel, camera, altitude_m, told)[0]
    c, s = math.cos(yaw), math.sin(yaw)
    found = np.array([x, y]) + np.array([[c, -s], [s, c]]) @ level
    # A third of the image's ground sampling distance of 0.26 m, and half the world's pixel of 0.2 m.
    assert found == pytest.approx([215.0, 205.0], abs=0.2)


def test_legs_stay_inside_with_room_for_the_image_and_have_the_length() -> None:
    box = (1000.0, 2000.0, 1700.0, 2600.0)
    flight = fly(box, replace(SMALL, length_m=800.0, leg_m=300.0), 3)
    margin = margin_m(SMALL) - 1e-6
    low, high = flight.xy_m.min(axis=0), flight.xy_m.max(axis=0)
    assert (low >= [1000 + margin, 2000 + margin]).all() and (high <= [1700 - margin, 2600 - margin]).all()
    flown = np.hypot(*np.diff(flight.xy_m, axis=0).T).sum()
    assert 0.9 * 800 < flown <= 800.0
    assert np.array_equal(flight.xy_m, fly(box, replace(SMALL, length_m=800.0, leg_m=300.0), 3).xy_m)


def test_a_region_that_is_too_small_is_refused() -> None:
    with pytest.raises(FlightError, match="region is too small"):
        legs((0.0, 0.0, 90.0, 90.0), SMALL)
    with pytest.raises(FlightError, match="do not fit the region"):
        legs((0.0, 0.0, 400.0, 250.0), replace(SMALL, length_m=5000.0))


def test_flights_that_are_none_are_refused() -> None:
    box = (0.0, 0.0, 2000.0, 2000.0)
    with pytest.raises(FlightError, match="further or more slowly"):
        fly(box, replace(SMALL, length_m=10.0, speed_mps=100.0), 1)
    with pytest.raises(FlightError, match="reaches the ground"):
        fly(box, replace(SMALL, altitude_swing_m=60.0), 1)
    with pytest.raises(FlightError, match="near the horizon"):
        fly(box, replace(SMALL, hfov_deg=150.0, tilt_deg=20.0), 1)


def test_the_suburb_is_reproducible_and_its_houses_do_not_touch() -> None:
    houses = suburb(4, 500.0)
    assert len(houses) > 80
    assert all(house.is_valid and 40.0 < house.area < 1600.0 for house in houses)
    tree = shapely.STRtree(houses)
    near = tree.query(houses, predicate="dwithin", distance=2.0)
    assert near.shape[1] == len(houses)  # each is near itself alone
    assert [h.wkb for h in suburb(4, 500.0)] == [h.wkb for h in houses]
    assert [h.wkb for h in suburb(5, 500.0)] != [h.wkb for h in houses]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("town") / "town.geojson"
    write_town(path, 4, 500.0, CENTRE)
    return path


def test_the_same_place_looks_the_same_in_every_window(town: Path) -> None:
    world = TownWorld(town, 4)
    west, south, _, _ = world.bounds_m
    inner = world.window((west + 130, south + 130, west + 170, south + 160))
    outer = world.window((west + 90, south + 100, west + 210, south + 190))
    assert inner.image_bgr.std() > 15
    column = round((inner.left_m - outer.left_m) / inner.gsd_m)
    row = round((outer.top_m - inner.top_m) / inner.gsd_m)
    height, width = inner.image_bgr.shape[:2]
    same = outer.image_bgr[row : row + height, column : column + width].astype(int)
    # What is clipped at the smaller window's edge may differ by the rounding of a clipped outline.
    assert np.mean(np.abs(inner.image_bgr.astype(int) - same) > 2) < 0.001


def test_a_bag_reads_back_as_frames_with_truth(town: Path, tmp_path: Path) -> None:
    world = TownWorld(town, 4)
    trajectory = fly(world.bounds_m, SMALL, 9)
    shown: list[tuple[int, int]] = []
    images = write_flight(tmp_path / "bag", world, trajectory, SMALL, 9, lambda a, b: shown.append((a, b)))
    frames = list(read_frames(tmp_path / "bag"))
    truth = read_truth(tmp_path / "bag")
    assert len(frames) == images == len(truth.poses) == len(shown) and images >= 10
    assert truth.epsg == world.epsg == 32632
    for frame in frames:
        assert isinstance(frame, Frame)
        pose = truth.poses[frame.stamp_ns]
        assert abs(frame.altitude_m - pose.altitude_m) < 2.0  # telemetry noise of 0.3 m
    with pytest.raises(SimError, match="exists; choose another"):
        write_flight(tmp_path / "bag", world, trajectory, SMALL, 9, lambda a, b: None)


def _sim(*words: str) -> int:
    parser = argparse.ArgumentParser()
    add_sim_arguments(parser)
    return run_sim(parser.parse_args(words))


def test_the_command_repeats_itself_and_replaces_only_bags(town: Path, tmp_path: Path) -> None:
    size = ["--width", "160", "--height", "96", "--length-m", "30", "--leg-m", "30", "--altitude-m", "40"]
    first, second = tmp_path / "a" / "bag", tmp_path / "b" / "bag"
    for out in (first, second):
        assert _sim("--world", str(town), "--out", str(out), *size) == 0
    assert (first / "bag.mcap").read_bytes() == (second / "bag.mcap").read_bytes()
    with pytest.raises(SimError, match="give --force"):
        _sim("--world", str(town), "--out", str(first), *size)
    assert _sim("--world", str(town), "--out", str(first), "--force", "--seed", "2", *size) == 0
    assert (first / "bag.mcap").read_bytes() != (second / "bag.mcap").read_bytes()
    with pytest.raises(SimError, match="is not a bag"):
        _sim("--world", str(town), "--out", str(tmp_path), "--force", *size)


def test_a_bag_that_cannot_be_finished_leaves_nothing(town: Path, tmp_path: Path) -> None:
    world = TownWorld(town, 4)
    outside = fly((0.0, 0.0, 500.0, 500.0), SMALL, 9)
    with pytest.raises(WorldError, match="beyond the edge"):
        write_flight(tmp_path / "bag", world, outside, SMALL, 9, lambda a, b: None)
    assert not (tmp_path / "bag").exists()


def test_a_world_without_polygons_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "points.geojson"
    point = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [8.1, 47.6]}}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [point]}))
    with pytest.raises(WorldError, match="has no polygons"):
        TownWorld(path, 1)


def test_the_reported_heading_is_not_the_true_one(town: Path, tmp_path: Path) -> None:
    world = TownWorld(town, 4)
    short = replace(SMALL, length_m=20.0)
    write_flight(tmp_path / "bag", world, fly(world.bounds_m, short, 9), short, 9, lambda a, b: None)
    (frame, *_), truth = list(read_frames(tmp_path / "bag")), read_truth(tmp_path / "bag")
    assert isinstance(frame, Frame)
    x_axis = rotation_matrix(frame.attitude_xyzw)[:, 0]
    told = math.atan2(-x_axis[1], x_axis[0])
    assert abs(math.remainder(told - truth.poses[frame.stamp_ns].yaw_rad, math.tau)) > 0.2


def test_orthophoto_windows_and_placement(tmp_path: Path) -> None:
    image = np.arange(100 * 200 * 3, dtype=np.int64).reshape(100, 200, 3) % 251
    cv2.imwrite(str(tmp_path / "ortho.png"), image.astype(np.uint8))
    georef = tmp_path / "georef.json"
    georef.write_text(json.dumps({"origin_lat_deg": 47.6, "origin_lon_deg": 8.1, "gsd_m": 0.5}))
    world = OrthoWorld(tmp_path / "ortho.png", georef)
    _, east, north = to_utm(47.6, 8.1)
    assert world.bounds_m == pytest.approx((east, north - 50.0, east + 100.0, north))
    window = world.window((east + 10.0, north - 30.0, east + 20.0, north - 20.0))
    assert (window.left_m, window.top_m) == pytest.approx((east + 10.0, north - 20.0))
    assert np.array_equal(window.image_bgr[:20, :20], image[40:60, 20:40].astype(np.uint8))
    with pytest.raises(WorldError, match="leaves the orthophoto"):
        world.window((east - 20.0, north, east - 10.0, north + 10.0))
    georef.write_text("{}")
    with pytest.raises(WorldError, match="origin_lat_deg"):
        OrthoWorld(tmp_path / "ortho.png", georef)


def test_scores_compare_every_fix_with_the_truth_of_its_own_stamp(town: Path, tmp_path: Path) -> None:
    world = TownWorld(town, 4)
    short = replace(SMALL, length_m=40.0)
    write_flight(tmp_path / "bag", world, fly(world.bounds_m, short, 9), short, 9, lambda a, b: None)
    truth = read_truth(tmp_path / "bag")
    stamp, pose = sorted(truth.poses.items())[1]
    to_wgs84 = Transformer.from_crs(truth.epsg, 4326, always_xy=True)
    lon, lat = to_wgs84.transform(pose.x_m + 3.0, pose.y_m - 4.0)
    fix = Fix(stamp, lat, lon, 60.0, 0.0, 0.0, 0.0, np.eye(3))
    scored = score([NoFix(0, "why"), fix], truth)
    assert scored.errors_m == pytest.approx((5.0,), abs=1e-3) and scored.no_fix == 1
    with pytest.raises(TruthError, match="another bag"):
        score([replace(fix, stamp_ns=1)], truth)
