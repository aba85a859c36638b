"""The mapping evaluation on paths made by hand, and its reading of the real flights."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from buildloc_eval.bars import Bar, bar_table, judge
from buildloc_eval.cut import cut
from buildloc_eval.flight import FlightConfig, follow
from buildloc_eval.flown import Path2d, align
from buildloc_eval.mapping import (
    BARS,
    bias_scores,
    building_scores,
    configs,
    cut_scores,
    pair_table,
    path_table,
    plan,
)
from buildloc_eval.pairs import chain, links, pair_scores
from buildloc_eval.sections import PICTURES
from buildloc_eval.survey import LEVEL, Survey, attitude_of, mirafiori, sheffield
from buildloc_eval.world import PictureWorld
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.registration import Link
from buildloc_mapper.similarity import Similarity
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import heading_rad, rotation_matrix
from buildloc_msgs_py.types import CameraModel, LocalMap
from textured import BUILDINGS, GSD, WORLD, WORLD_MASK

DATA = Path(os.environ.get("BUILDLOC_DATA", Path(__file__).parents[4] / "shared" / "data"))
YAW = np.array([0.3, 0.4, 2.0, 2.1, -1.0])
TRUE = np.array([(0.0, 0.0), (5.0, 1.0), (9.0, 4.0), (6.0, 9.0), (0.0, 7.0)])


def survey(true_m: np.ndarray, yaw_rad: np.ndarray | None) -> Survey:
    camera = CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5)
    n = len(true_m)
    return Survey("drawn", (Path("none.jpg"),) * n, camera, (50.0,) * n, (LEVEL,) * n, true_m, yaw_rad)


def pose(index: int) -> Similarity:
    return Similarity(float(TRUE[index, 0]), float(TRUE[index, 1]), float(YAW[index]), 1.0)


def inverse(of: Similarity) -> Similarity:
    back = Similarity(0.0, 0.0, -of.yaw_rad, 1.0)
    x, y = -back.apply(np.array([of[:2]]))[0]
    return Similarity(float(x), float(y), -of.yaw_rad, 1.0)


def true_links() -> list[Link | None]:
    return [Link(inverse(pose(i)).compose(pose(i + 1)), 50, np.eye(4)) for i in range(len(TRUE) - 1)]


def rmse(path: Path2d, with_scale: bool = False) -> dict[str, Any]:
    aligned = align(survey(TRUE, YAW), path, with_scale)
    assert aligned is not None
    return aligned.scores


def test_true_links_have_no_error_and_chain_to_the_true_path() -> None:
    scores, constants = pair_scores(survey(TRUE, YAW), YAW, true_links())
    assert scores["pairs_registered"] == 4
    assert scores["translation_p90_m"] == pytest.approx(0.0, abs=1e-9)
    assert scores["yaw_p90_deg"] == pytest.approx(0.0, abs=1e-9)
    assert (constants.height_factor, constants.heading_rad) == pytest.approx((1.0, 0.0))
    flown = align(survey(TRUE, YAW), chain(true_links()), with_scale=False)
    assert flown is not None
    assert flown.scores["images"] == 5 and flown.scores["rmse_m"] == pytest.approx(0.0, abs=1e-6)
    assert flown.places_m == pytest.approx(TRUE, abs=1e-6)
    assert flown.to_world == pytest.approx(pose(0), abs=1e-6)


def test_a_wrong_height_is_an_error_that_the_fit_names() -> None:
    low = [replace(k, transform=k.transform._replace(x_m=k.transform.x_m / 1.05, y_m=k.transform.y_m / 1.05))
           for k in true_links() if k is not None]  # fmt: skip
    scores, constants = pair_scores(survey(TRUE, YAW), YAW, list(low))
    assert scores["translation_median_m"] > 0.2
    assert constants.height_factor == pytest.approx(1.05)
    assert scores["fitted_to_truth"]["translation_p90_m"] == pytest.approx(0.0, abs=1e-9)
    path = chain(list(low))
    rigid, scaled = rmse(path), rmse(path, with_scale=True)
    assert rigid["rmse_m"] > 0.1 > scaled["rmse_m"]
    assert rigid["scale"] == scaled["scale"] == pytest.approx(1.05)
    assert rmse(constants.correct(path))["rmse_m"] == pytest.approx(0.0, abs=1e-6)


def test_a_tilted_axis_is_told_from_the_height() -> None:
    offset = Similarity(0.5, -0.2, 0.0, 1.0)
    off = [
        replace(k, transform=inverse(offset).compose(k.transform).compose(offset))
        for k in true_links()
        if k is not None
    ]
    scores, constants = pair_scores(survey(TRUE, YAW), YAW, list(off))
    assert scores["translation_median_m"] > 0.01
    assert constants.height_factor == pytest.approx(1.0)
    assert constants.axis_m == pytest.approx([-0.5, 0.2])
    path = constants.correct(chain(list(off)))
    assert rmse(path)["rmse_m"] == pytest.approx(0.0, abs=1e-6)


def test_a_chain_ends_where_a_link_is_missing() -> None:
    broken = true_links()
    broken[2] = None
    assert chain(broken).index == (0, 1, 2)
    scores, _ = pair_scores(survey(TRUE, YAW), YAW, broken)
    assert (scores["pairs"], scores["pairs_registered"]) == (4, 3)
    short = Path2d((0, 1), (pose(0), pose(1)), {})
    assert align(survey(TRUE, YAW), short, with_scale=False) is None


def test_attitudes_look_where_they_should() -> None:
    """Level frame: x right, y down in the image, z down."""
    ahead = rotation_matrix(attitude_of(0.0, 0.3, 0.0)) @ [0.0, 0.0, 1.0]
    assert ahead == pytest.approx([0.0, -math.sin(0.3), math.cos(0.3)])
    right = rotation_matrix(attitude_of(0.0, 0.0, 0.3)) @ [0.0, 0.0, 1.0]
    assert right == pytest.approx([math.sin(0.3), 0.0, math.cos(0.3)])
    assert heading_rad(attitude_of(0.7, 0.3, 0.0)) == pytest.approx(0.7)


def test_tables_have_a_line_for_every_method_and_way() -> None:
    path = {"images": 3, "of": 4, "rmse_m": 1.25, "rmse_percent": 0.5, "buildings": {"median_m": 0.25}}
    sections = {"a": {"mapper": path, "plain_chaining": path, "pairs": {"pairs_registered": 7}}, "b": {}}
    paths, pairs = path_table(sections).splitlines(), pair_table(sections).splitlines()
    assert (
        len(paths) == 3 and paths[1].split()[2:6] == ["3", "of", "4", "1.250"] and paths[2].endswith("0.250")
    )
    assert len(pairs) == 2 and "7" in pairs[1]
    assert all(len({len(line) for line in lines}) == 1 for lines in (paths, pairs))


def test_bars_are_judged_by_what_was_measured() -> None:
    sections = {"a": {"mapper": {"rmse_m": 1.0, "images": 30}}}
    held, missed = Bar("a", "mapper.rmse_m", 1.0), Bar("a", "mapper.images", 31, at_least=True)
    assert held.judge(sections) == {"at most": 1.0, "measured": 1.0, "held": True}
    assert missed.judge(sections) == {"at least": 31, "measured": 30, "held": False}
    absent = Bar("a", "mapper.yaw.deg", 1.0).judge(sections)
    assert absent == {"at most": 1.0, "measured": None, "held": False}
    assert Bar("b", "mapper.rmse_m", 1.0).judge(sections) is None
    judged = judge((held, Bar("b", "mapper.rmse_m", 1.0), missed), sections)
    assert [answer["held"] for answer in judged.values()] == [True, False]
    assert [line.endswith("MISSED") for line in bar_table(judged).splitlines()[1:]] == [False, True]


def test_only_buildings_seen_whole_are_scored() -> None:
    places = np.array([(0.0, 0.0), (10.0, 0.0), (20.0, 0.0)])
    cut = np.array([False, False, True])
    none = np.zeros(3)
    found = LocalMap(
        0, np.arange(3), places, none, np.zeros((3, 4)), none.astype(int), np.zeros((3, 2, 2)), cut
    )
    turned = Similarity(5.0, 5.0, math.pi / 2, 1.0)
    true = np.array([(5.0, 5.0), (5.0, 15.5)])
    scores = building_scores(found, turned, true)
    assert (scores["buildings"], scores["median_m"]) == (2, pytest.approx(0.25))
    assert building_scores(found.select(cut), turned, true) == {"buildings": 0}


def test_a_quick_run_is_a_part_of_the_whole_and_every_bar_has_its_section(tmp_path: Path) -> None:
    quick, whole = (list(plan(tmp_path, tmp_path, 1, q, lambda text: None)) for q in (True, False))
    assert set(quick) < set(whole) and "sheffield_flight_sift" in quick
    assert {bar.section for bar in BARS} <= set(whole)


def test_a_flight_over_drawn_ground_is_scored_in_every_way(tmp_path: Path) -> None:
    """80 m out and 60 m to the side; what the report's figures and pictures are made of."""
    picture, labels = (PictureWorld(image, 32632, -120.0, 120.0, GSD) for image in (WORLD, WORLD_MASK))
    config = FlightConfig(
        altitude_m=55.0,
        altitude_swing_m=3.0,
        tilt_deg=2.0,
        width=320,
        height=240,
        hfov_deg=62.0,
        speed_mps=4.0,
    )
    corners = np.array([(-45.0, -10.0), (40.0, 0.0), (35.0, 50.0)])
    trajectory = follow(corners, math.inf, config, 2)
    flight = cut("drawn", picture, labels, trajectory, config, 2)
    houses = np.array([shapely.box(x - w / 2, y - h / 2, x + w / 2, y + h / 2) for x, y, w, h in BUILDINGS])
    scores = cut_scores(flight, houses, MapperConfig(), tmp_path)
    for way in ("mapper", "without_loop_closures", "plain_chaining"):
        assert scores[way]["of"] == len(flight) and scores[way]["rmse_m"] < 10.0
    assert scores["mapper"]["images"] == len(flight)
    assert scores["mapper"]["rmse_m"] < min(1.0, scores["plain_chaining"]["rmse_m"])
    assert scores["mapper"]["buildings"]["median_m"] < 1.0
    assert all((tmp_path / file).stat().st_size > 10_000 for _, file in scores[PICTURES])
    assert len(path_table({"drawn": scores}).splitlines()) == 4
    high = bias_scores(replace(flight, altitude_factor=1.03), MapperConfig())
    assert high["map_over_world"] == pytest.approx(1.03, abs=0.01)


def test_absent_flights_are_one_line(tmp_path: Path) -> None:
    for read in (mirafiori, sheffield):
        with pytest.raises(BuildlocError, match="set BUILDLOC_DATA"):
            read(tmp_path)


@pytest.mark.data
def test_consecutive_images_of_the_real_flight_are_registered() -> None:
    if not (DATA / "imagery" / "mirafiori_rtk" / "K.txt").is_file():
        pytest.skip(f"no real imagery: {DATA}/imagery/mirafiori_rtk is absent (set BUILDLOC_DATA)")
    whole = mirafiori(DATA)
    assert len(whole) == 32 and whole.yaw_rad is not None
    assert np.linalg.norm(np.diff(whole.true_m, axis=0), axis=1).min() > 2.0
    part = replace(whole, images=whole.images[:6], true_m=whole.true_m[:6])
    found, counts = links(part, configs(DATA)["sift"], lambda frame: frame)
    scores, _ = pair_scores(part, whole.yaw_rad, found)
    assert scores["pairs_registered"] == 5 and not any(k.startswith("rejected") for k in counts)
    # 0.2 m of 3 m are the telemetry's height, which is a fifteenth too low (docs/mapping.md).
    assert scores["translation_median_m"] < 0.3
    assert scores["yaw_median_deg"] < 0.4  # the gimbal tells whole tenths of a degree
