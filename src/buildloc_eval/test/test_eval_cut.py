"""Flights cut out of orthophotos, on ground that is drawn by hand."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from buildloc_eval.cut import CutFlight, cut
from buildloc_eval.endurance import scores
from buildloc_eval.flight import FlightConfig, FlightError, follow, tour
from buildloc_eval.mapper_process import Load
from buildloc_eval.orthos import banepa, barnarp
from buildloc_eval.sections import PICTURES, Sections, fingerprint
from buildloc_eval.world import MirroredWorld, PictureWorld, WorldError
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import heading_rad, pixels_to_level, rotation_matrix

BOX = (0.0, 0.0, 900.0, 700.0)
CONFIG = FlightConfig(
    length_m=1200.0, speed_mps=5.0, altitude_m=60.0, altitude_swing_m=6.0, tilt_deg=3.0, width=160, height=120
)
GSD = 0.5
HOUSE_M = (450.0, 350.0)  # one white house of 20 m by 10 m


def flight(altitude_factor: float = 1.0, seed: int = 3) -> CutFlight:
    image = np.full((1400, 1800), 90, dtype=np.uint8)
    column, row = int(HOUSE_M[0] / GSD), int((BOX[3] - HOUSE_M[1]) / GSD)
    image[row - 10 : row + 10, column - 20 : column + 20] = 255
    world = PictureWorld(image, 32632, BOX[0], BOX[3], GSD)
    colours = PictureWorld(np.dstack([image] * 3), 32632, BOX[0], BOX[3], GSD)
    past_the_house = np.array([(300.0, 340.0), (600.0, 360.0), (500.0, 200.0)])
    trajectory = follow(past_the_house, math.inf, CONFIG, seed)
    return cut("drawn", colours, world, trajectory, CONFIG, seed, altitude_factor)


def test_a_tour_stays_inside_and_comes_back() -> None:
    for seed in range(10):
        corners = tour(BOX, CONFIG, seed)
        assert np.array_equal(corners[0], corners[-1])
        assert (corners > 0).all() and (corners < BOX[2:]).all()
        length = np.hypot(*np.diff(corners, axis=0).T).sum()
        assert CONFIG.length_m <= length <= 1.25 * CONFIG.length_m
        courses = np.arctan2(*np.diff(corners, axis=0).T[::-1])
        turns = [abs(math.remainder(b - a, math.tau)) for a, b in itertools.pairwise(courses)]
        assert max(turns) <= math.radians(120.0) + 1e-9
    assert np.array_equal(tour(BOX, CONFIG, 4), tour(BOX, CONFIG, 4))
    with pytest.raises(FlightError, match="round trip"):
        tour((0.0, 0.0, 200.0, 200.0), CONFIG, 1)


def test_telemetry_says_what_is_true_but_for_noise_and_a_constant_heading() -> None:
    cut_out = flight()
    assert 12 <= len(cut_out) < 40
    told = [cut_out.frame(i) for i in range(len(cut_out))]
    heights = np.array([frame.altitude_m for frame in told]) - cut_out.poses[:, 2]
    assert 0.1 < heights.std() < 0.6 and abs(heights.mean()) < 0.3
    turned = [
        math.remainder(heading_rad(f.attitude_xyzw) + p[3], math.tau)
        for f, p in zip(told, cut_out.poses, strict=True)
    ]
    assert np.ptp(turned) < math.radians(3.0) and abs(np.mean(turned)) > 0.05
    down = np.array([rotation_matrix(f.attitude_xyzw)[2] for f in told])
    tilts = np.degrees(np.arccos(down[:, 2]))
    assert 2.0 < math.sqrt((tilts**2).mean()) < 8.0  # 3 degrees of roll, and of pitch
    again = cut_out.frame(5)
    assert np.array_equal(again.image_bgr, told[5].image_bgr) and again.altitude_m == told[5].altitude_m


def test_an_altimeter_that_says_too_much_changes_nothing_else() -> None:
    right, high = flight().frame(4), flight(altitude_factor=1.03).frame(4)
    assert np.array_equal(right.image_bgr, high.image_bgr) and right.attitude_xyzw == high.attitude_xyzw
    assert high.altitude_m / right.altitude_m == pytest.approx(1.03, abs=2e-4)


def test_masks_show_the_house_where_it_is() -> None:
    cut_out, seen = flight(), 0
    for index in range(len(cut_out)):
        mask, frame = cut_out.mask(index), cut_out.frame(index)
        assert mask.stamp_ns == frame.stamp_ns
        v, u = np.nonzero(mask.pixels)
        if len(v) == 0 or min(v.min(), u.min()) == 0 or v.max() == 119 or u.max() == 159:
            continue
        seen += 1
        x, y, altitude, yaw, *_ = cut_out.poses[index]
        level = pixels_to_level(
            np.column_stack([u, v]).astype(float), frame.camera, altitude, frame.attitude_xyzw
        )
        c, s = math.cos(yaw), math.sin(yaw)
        place = level.mean(axis=0) @ np.array([[c, s], [-s, c]]) + (x, y)
        # the attitude that is told has 0.2 degrees of noise: 0.2 m from 60 m
        assert place == pytest.approx(HOUSE_M, abs=1.0)
    assert seen >= 1


def test_a_mirrored_world_goes_on_over_its_seams() -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (40, 60, 3), dtype=np.uint8)
    one = PictureWorld(image, 32632, 100.0, 500.0, 2.0)
    world = MirroredWorld(one, 2, 2)
    assert MirroredWorld(one, 2, 1).bounds_m == (100.0, 340.0, 220.0, 500.0)
    assert one.bounds_m == (100.0, 420.0, 220.0, 500.0)
    assert world.bounds_m == (100.0, 340.0, 340.0, 500.0)
    whole = world.window(world.bounds_m)
    assert (whole.left_m, whole.top_m) == (100.0, 500.0)
    doubled = np.vstack([image, image[::-1]])
    assert np.array_equal(whole.image_bgr, np.hstack([doubled, doubled[:, ::-1]]))
    with pytest.raises(WorldError):
        world.window((500.0, 340.0, 600.0, 400.0))


def test_orthophotos_are_read_with_their_labels(tmp_path: Path) -> None:
    """Two houses that share a wall are one; outlines lie on the pixels that they were drawn around."""
    folder = tmp_path / "imagery" / "barnarp"
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "ortho.jpg"), np.full((100, 200, 3), 80, dtype=np.uint8))
    origin = {"origin_lat_deg": 57.7, "origin_lon_deg": 14.14, "gsd_m": 0.5}
    (folder / "georef.json").write_text(json.dumps(origin))
    degrees = np.array([1.0 / (111_320.0 * math.cos(math.radians(57.7))), 1.0 / 111_320.0])
    houses = [shapely.box(x, -y - 10.0, x + 10.0, -y) for x, y in ((20.0, 10.0), (30.0, 10.0), (70.0, 30.0))]
    features = [
        {
            "type": "Feature",
            "properties": {},
            "geometry": json.loads(
                shapely.to_geojson(shapely.transform(h, lambda xy: xy * degrees + (14.14, 57.7)))
            ),
        }
        for h in houses
    ]
    (folder / "footprints.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )
    ground = barnarp(tmp_path)
    assert len(ground.buildings) == 2
    west, south, east, north = ground.picture.bounds_m
    assert (east - west, north - south) == pytest.approx((100.0, 50.0))
    centres = shapely.get_coordinates(shapely.centroid(ground.buildings)) - (west, north)
    assert centres[np.argsort(centres[:, 0])] == pytest.approx(
        np.array([(30.0, -15.0), (75.0, -35.0)]), abs=0.3
    )
    mask = ground.labels.window(ground.labels.bounds_m).image_bgr
    v, u = np.nonzero(mask[:, :120])
    assert (u.mean() + 0.5, v.mean() + 0.5) == pytest.approx((60.0, 30.0), abs=1.0)
    assert (mask > 0).sum() * 0.25 == pytest.approx(300.0, rel=0.1)
    for read in (barnarp, banepa):
        with pytest.raises(BuildlocError, match="set BUILDLOC_DATA"):
            read(tmp_path / "nowhere")


def test_sections_are_kept_until_key_or_pictures_change(tmp_path: Path) -> None:
    made: list[str] = []

    def make() -> dict[str, object]:
        made.append("made")
        (tmp_path / "a.png").write_bytes(b"picture")
        return {"figure": 2.5, PICTURES: [["caption", "a.png"]]}

    def scores_of(key: str) -> object:
        return Sections(tmp_path, key, lambda text: None).scores("a", make)["figure"]

    assert (scores_of("one"), scores_of("one"), len(made)) == (2.5, 2.5, 1)
    assert (scores_of("two"), len(made)) == (2.5, 2)
    (tmp_path / "a.png").unlink()
    assert (scores_of("two"), len(made)) == (2.5, 3)


def test_a_fingerprint_knows_settings() -> None:
    assert fingerprint(["buildloc_eval"], 1, False) == fingerprint(["buildloc_eval"], 1, False)
    assert fingerprint(["buildloc_eval"], 1, False) != fingerprint(["buildloc_eval"], 2, False)


def test_endurance_compares_the_two_ends() -> None:
    wall = (0.1,) * 5 + (0.3,) * 5
    figures = scores(flight(), Load(wall, wall, (100.0,) * 9 + (150.0,), 160.0, None))
    assert figures["last_over_first"] == pytest.approx(3.0)
    assert (figures["median_ms"], figures["memory_at_end_mb"]) == (pytest.approx(200.0), 150.0)
