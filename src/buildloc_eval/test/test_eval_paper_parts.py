"""Flights between two digitisers and over real imagery: where they go, what they see, what is told."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from buildloc_eval.cli import add_eval_arguments, run_eval
from buildloc_eval.flight import fly, margin_m
from buildloc_eval.orthos import LabelledGround
from buildloc_eval.paper import chapters, real, tokyo
from buildloc_eval.paper.chapters import real_imagery, share_in_reference, two_digitisers
from buildloc_eval.paper.flown import Maps, Snapshot
from buildloc_eval.paper.methods import nothing
from buildloc_eval.paper.plan import Models, Plan, Stores, maps_name, prediction_name, ragged
from buildloc_eval.paper.real import RealFlight, Site, Surveyed
from buildloc_eval.paper.report import write
from buildloc_eval.paper.sources import measure, read_outlines
from buildloc_eval.paper.stages import queries
from buildloc_eval.paper.tokyo import TokyoFlight
from buildloc_eval.realworld import DataError, data_folder
from buildloc_eval.segmentation import EvaluationError
from buildloc_eval.segmentation_errors import SegmentationErrors
from buildloc_eval.world import PictureWorld
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import Keyframe, LocalMap
from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.network import Network

ERRORS = SegmentationErrors(
    1, 0.1, 0.05, 0.05, 100.0, 0.2, 30.0, 0.5, 0.0, 0.2, (0.05, 0.05, 0.05, 0.05), 0.6, 1, 0.1, 0.2, 0.5
)
MODELS = Models(ERRORS)
SITE = np.array([320_000.0, 4_690_000.0])


def houses(west: float, south: float, side: int, pitch_m: float = 50.0) -> np.ndarray:
    """Houses of 12 x 8 m in a square."""
    x, y = (axis.ravel() * pitch_m for axis in np.meshgrid(np.arange(side), np.arange(side)))
    return np.asarray(shapely.box(west + x, south + y, west + x + 12.0, south + y + 8.0))


def ground(size_m: tuple[float, float] = (480.0, 400.0)) -> LabelledGround:
    """Noise of two scales, 0.4 m per pixel, with houses every 50 m to the very edges."""
    columns, rows = (round(side / 0.4) for side in size_m)
    rng = np.random.default_rng(3)
    grey = sum(
        cv2.resize(rng.normal(0.0, 25.0, (rows // scale, columns // scale)), (columns, rows))
        for scale in (1, 6)
    )
    image = np.dstack([np.clip(grey + 120.0, 0, 255).astype(np.uint8)] * 3)
    outlines = np.array([shapely.box(x, y, x + 12.0, y + 8.0) for x in (0.0, 200.0, size_m[0] - 12.0)
                         for y in (0.0, 190.0, size_m[1] - 8.0)])  # fmt: skip
    world = (32633, 0.0, size_m[1], 0.4)
    labels = PictureWorld(np.zeros((rows, columns), np.uint8), *world)
    return LabelledGround("town", PictureWorld(image, *world), labels, outlines, outlines)


FLIGHT = RealFlight("town_short", "barnarp", lambda _: ground(), Surveyed(0.08, 150.0, 60.0))


def test_tokyo_is_flown_over_in_places_apart_and_away_from_the_border() -> None:
    points = np.random.default_rng(1).uniform(0.0, 8000.0, (5000, 2))
    chosen = tokyo.choose(points, 4)
    assert chosen == tokyo.choose(points, 4) != tokyo.choose(points, 5)
    centres = np.array(chosen)
    gaps = np.hypot(*(centres[:, None] - centres[None]).T)[~np.eye(len(centres), dtype=bool)]
    assert len(centres) == 5 and gaps.min() > tokyo.APART_M
    assert (centres > 2490.0).all() and (centres < 5510.0).all()


def test_every_centre_of_tokyo_is_flown_both_ways_round_on_one_track() -> None:
    flights = tokyo.tokyo_flights()
    assert len({flight.name for flight in flights}) == len(flights) == 2 * len(tokyo.CENTRES_M)
    for there, back in zip(flights[::2], flights[1::2], strict=True):
        assert there.track == back.track
        assert (there.world, there.reference) == (back.reference, back.world)


def test_a_plan_asks_its_own_methods_for_its_own_prefixes() -> None:
    plan = Plan(("tokyo1_over_osm",), 2, (5,), {"default preset": {5: 1}}, ("default preset", "paper preset"))
    asked = list(queries(tokyo.tokyo_flights()[1], plan, 1))
    assert {query.method for query in asked} == {"default preset", "paper preset"}
    assert [(q.seed, q.method) for q in asked if q.prefixes] == [(1, "default preset")]
    assert len({query.name for query in asked}) == len(asked) == 5


def test_a_ground_is_set_into_the_city_in_place_of_what_stands_there() -> None:
    outlines = houses(SITE[0] - 1000.0, SITE[1] - 1000.0, 40)
    city = real.City(outlines, measure(outlines))
    site = real.set_in(city, ground(), SITE, 800.0)
    found = site.reference.centroids_m
    own = measure(shapely.transform(ground().outlines, lambda xy: xy + site.moved_m))
    np.testing.assert_allclose(found[-9:], own.centroids_m)
    np.testing.assert_allclose(site.reference.areas_m2[-9:], 96.0, rtol=1e-5)
    ends = own.centroids_m.min(axis=0), own.centroids_m.max(axis=0)
    np.testing.assert_allclose(np.mean(ends, axis=0), SITE, atol=1e-6)
    # The city's others: those within the radius that do not reach into the ground.
    hole = np.array([240.0 + 10.0 + 6.0, 200.0 + 10.0 + 4.0])
    kept = city.measured.centroids_m
    away = np.abs(kept - SITE)
    kept = kept[(np.hypot(*(kept - SITE).T) <= 800.0) & (away > hole).any(axis=1)]
    np.testing.assert_array_equal(found[:-9], kept)


def test_a_site_has_the_whole_search_radius_around_it() -> None:
    points = np.random.default_rng(2).uniform(0.0, 30_000.0, (4000, 2))
    drawn = np.array([real.draw_site(points, 12_000.0, np.random.default_rng(s)) for s in range(20)])
    assert (drawn > 11_900.0).all() and (drawn < 18_100.0).all()
    assert len(np.unique(drawn, axis=0)) > 10


@pytest.mark.parametrize(
    ("flight", "labelled"),
    # What is labelled of the places.
    [(real.FLIGHTS[0], (0.0, 0.0, 1287.0, 819.0)), (real.FLIGHTS[1], (0.0, 0.0, 441.0, 574.0))],
    ids=["barnarp", "banepa"],
)
def test_no_frame_sees_beyond_the_labels(
    flight: RealFlight, labelled: tuple[float, float, float, float]
) -> None:
    config, reach, places = flight.like.config, margin_m(flight.like.config), []
    for seed in range(4):
        box = real.region(labelled, config, np.random.default_rng(seed))
        path = fly(box, config, seed).xy_m
        assert (path >= np.array(labelled[:2]) + reach).all()
        assert (path <= np.array(labelled[2:]) - reach).all()
        assert np.hypot(*np.diff(path, axis=0).T).sum() == pytest.approx(config.length_m, rel=0.06)
        places.append(path.mean(axis=0))
    assert np.ptp(places, axis=0).max() > 5.0  # a seed draws where


def test_a_network_is_not_flown_over_ground_that_it_knows() -> None:
    found, left_out = real.networks(real.FLIGHTS, {})
    assert list(found) == ["barnarp"] and list(left_out) == ["banepa"]
    assert "--model banepa=PATH" in left_out["banepa"]
    shipped = Network(SegmenterConfig()).path
    with pytest.raises(EvaluationError, match="was trained on banepa"):
        real.networks(real.FLIGHTS, {"banepa": str(shipped)})
    with pytest.raises(EvaluationError, match="no flight of this run goes there"):
        real.networks(real.FLIGHTS, {"atlantis": str(shipped)})


def test_real_imagery_goes_through_registration_network_and_mapper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "footprints").mkdir()  # the flight's ground is made up: no data is read
    monkeypatch.setenv("BUILDLOC_DATA", str(tmp_path))
    network = real.network_for("barnarp", "")
    moved = SITE - np.array([240.0, 200.0])
    seen = real.see(FLIGHT, moved, network, MODELS, 1)
    maps = real.make_maps(seen, MODELS)
    assert len(maps.snapshots) == len(seen.masks) >= 4
    last = maps.snapshots[-1]
    assert last is not None and len(last.numbers) == len(maps.true_m)  # the noise registers
    # Flown where the ground was moved to.
    assert (np.abs(maps.true_m - SITE) < np.array([240.0, 200.0])).all()
    drawn = [cv2.imdecode(np.frombuffer(mask, np.uint8), cv2.IMREAD_UNCHANGED) for mask in seen.masks]
    assert {mask.shape for mask in drawn} == {(540, 960)}
    assert {int(v) for mask in drawn for v in np.unique(mask)} <= {0, 255}
    # The true outlines for masks: every house that is seen whole is one of the reference.
    faultless = real.make_drawn_maps(FLIGHT, seen.track, moved, MODELS, 1)
    own = measure(real.own_outlines(FLIGHT, moved))
    assert share_in_reference(faultless, own.centroids_m) == 1.0


def grid_maps(count: int = 3) -> Maps:
    """A map of a 3 x 3 grid that is turned by a quarter turn; three keyframes."""
    x, y = np.meshgrid(np.arange(3) * 40.0, np.arange(3) * 40.0)
    placed = np.column_stack([x.ravel(), y.ravel()])
    local_map = LocalMap.whole(
        0, np.arange(9), placed, np.full(9, 90.0), np.full((9, 4), 0.5), np.full(9, 3, dtype=np.int64)
    )
    keyframes = tuple(Keyframe(n, 40.0 * n, 0.0, 0.0) for n in range(count))
    true = SITE + np.column_stack([np.zeros(count), 40.0 * np.arange(count)])
    snapshot = Snapshot(local_map, keyframes, tuple(range(count)))
    yaws = np.full(count, math.pi / 2)
    return Maps((snapshot,) * count, (), (1.0, 2.0, 3.0), np.empty((0, 3)), true, yaws)


def reference() -> np.ndarray:
    """The nine of the grid, where they truly are, three of them 20 m away."""
    x, y = np.meshgrid(np.arange(3) * 40.0, np.arange(3) * 40.0)
    away = np.where(np.arange(9) < 3, 20.0, 1.0)
    places = SITE + np.column_stack([-y.ravel(), x.ravel() + away])
    half = np.array([6.0, 4.0])
    return np.asarray(shapely.box(*(places - half).T, *(places + half).T))


def test_the_share_of_a_map_that_the_reference_has() -> None:
    assert share_in_reference(grid_maps(), measure(reference()).centroids_m) == pytest.approx(6 / 9)
    lost = Maps((None,), (), (1.0, 2.0, 3.0), np.empty((0, 3)), SITE[None], np.zeros(1))
    assert share_in_reference(lost, SITE[None]) is None


def keep(stores: Stores, flight: TokyoFlight | RealFlight, plan: Plan, seed: int) -> None:
    """Maps, and predictions that find nothing."""
    stores.maps.save(maps_name(flight, seed), grid_maps())
    for name in plan.methods:
        for radius in plan.radii_km:
            kept = prediction_name(name, radius, flight, seed, prefixes=False)
            stores.predictions.save(kept, nothing("map has fewer than four buildings"))


def test_the_report_tells_what_is_real_what_was_left_out_and_what_lost_each_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BUILDLOC_DATA", str(tmp_path))
    (tmp_path / "footprints").mkdir()
    methods = ("paper preset", "default preset")
    over = TokyoFlight(1, (float(SITE[0]), float(SITE[1])), "osm", "plateau")
    plan = Plan((over.name,), 1, (tokyo.RADIUS_KM,), {}, methods)
    stores = Stores(tmp_path / "tokyo", 1, MODELS, code=tokyo.CODE)
    stores.ground.save(over.name, ragged(reference()))
    stores.ground.save("plateau", (ragged(reference()), measure(reference())))
    keep(stores, over, plan, 1)
    first = two_digitisers(tmp_path, stores, [over], plan, MODELS, 1)

    found, left_out = real.networks(real.FLIGHTS, {})
    plan = Plan((FLIGHT.name,), 1, (6, 12), {}, methods)
    stores = real.stores_for(tmp_path, FLIGHT, found["barnarp"], MODELS, 1)
    site = Site(SITE - np.array([240.0, 200.0]), SITE, measure(reference()))
    stores.ground.save(maps_name(FLIGHT, 1), site)
    keep(stores, FLIGHT, plan, 1)
    keep(stores, real.drawn(FLIGHT), real.drawn_plan(plan), 1)
    second = real_imagery(tmp_path, {FLIGHT.name: stores}, [FLIGHT], found, left_out, plan, 1)

    text = write(tmp_path, [first, second], 1, True, 6.0)
    report = json.loads((tmp_path / "report.json").read_text())
    for chapter, what in ((first, chapters.TOKYO), (second, chapters.IMAGERY)):
        said = report[chapter.title]
        assert next(iter(said)) == "what is real" and said["what is real"] == what
        assert report["what is real"][chapter.title] == what
        assert {row["lost by"] for row in said["failures"]} == {"map has fewer than four buildings"}
        assert all(row["recall@1"] == 0.0 for row in said["results"])
        assert len(said["results"]) == (4 if chapter is first else 6)
        assert said["flights and references"][0]["of them in the reference"] == pytest.approx(6 / 9)
    held = {row["what"]: row["held"] for row in report["bars"]}
    assert held["Tokyo over osm, reference plateau: default preset, recall@1 at 5 km"] is False
    assert held["Tokyo, buildings of the smallest reference"] is False
    assert held["real imagery, barnarp: default preset, recall@1 at 12 km"] is False
    assert "banepa was left out" in text and "banepa was left out" in (tmp_path / "report.html").read_text()


def test_parts_and_networks_are_of_this_evaluation_alone() -> None:
    parser = argparse.ArgumentParser()
    add_eval_arguments(parser)
    given = parser.parse_args(["paper", "--out", "x", "--parts", "tokyo", "real", "--model", "banepa=a.onnx"])
    assert (given.parts, given.models) == (["tokyo", "real"], ["banepa=a.onnx"])
    with pytest.raises(BuildlocError, match="of `eval paper`, not of `eval scale`"):
        run_eval(parser.parse_args(["scale", "--out", "x", "--parts", "tokyo"]))
    with pytest.raises(BuildlocError, match="--model is of the part real"):
        run_eval(parser.parse_args(["paper", "--out", "x", "--parts", "tokyo", "--model", "banepa=a.onnx"]))
    with pytest.raises(BuildlocError, match="--model banepa: expected PLACE=MODEL"):
        run_eval(parser.parse_args(["paper", "--out", "x", "--model", "banepa"]))


@pytest.mark.data
def test_the_centres_of_tokyo_are_those_of_the_rule_and_have_enough_around_them() -> None:
    try:
        data = data_folder()
    except DataError as error:
        pytest.skip(str(error))
    points = {
        source: shapely.get_coordinates(shapely.centroid(read_outlines(data / path, tokyo.EPSG)))
        for source, path in tokyo.SOURCES.items()
    }
    assert tokyo.choose(points["osm"], 1) == tokyo.CENTRES_M
    for centre in tokyo.CENTRES_M:
        for near in points.values():
            assert (np.hypot(*(near - centre).T) <= 1000.0 * tokyo.RADIUS_KM).sum() >= 80_000


@pytest.mark.data
def test_the_labels_of_the_places_are_where_the_flights_expect_them() -> None:
    try:
        data = data_folder()
    except DataError as error:
        pytest.skip(str(error))
    for flight in real.FLIGHTS:
        place = flight.read(data)
        config = flight.like.config
        box = real.region(real.labelled_m(place), config, np.random.default_rng(1))
        path = fly(box, config, 1).xy_m
        # Buildings lie below the flight, and the reference has them one by one.
        below = shapely.dwithin(place.outlines, shapely.LineString(path), 40.0)
        assert below.sum() >= 50 and len(place.outlines) >= len(place.buildings)
