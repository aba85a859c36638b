"""Trials of the Monte-Carlo: drawn by their number, on grounds that do not touch, as bad as they claim."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from buildloc_eval.integrity.grounds import GridDesign, Grounds, Source, grid_design, grid_town
from buildloc_eval.integrity.plan import (
    CALIBRATION,
    CONTROLS,
    FLIGHT,
    GRID,
    SCATTERED,
    TEST,
    TOWN_NONE,
    TOWNS,
    Place,
    Plan,
    Territory,
    missing_variant,
    shift_of,
    trial,
)
from buildloc_eval.integrity.trials import attempt, other_city, run
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.reference.buildings import Buildings, concatenate
from buildloc_matcher.reference.region import WGS84, Circle, transformer
from pyproj import CRS
from scipy.spatial import cKDTree

ZONES = {"east": 32619, "west": 32618}
CENTRES_DEG = {"east": (42.4, -71.2), "west": (40.0, -75.0)}
KM = 1.6


def invented(name: str) -> Source:
    """A town of 3.2 km within its circle, and a second one 4 km to the north, for flights outside."""
    latitude, longitude = CENTRES_DEG[name]
    east, north = transformer(CRS(WGS84), CRS(ZONES[name])).transform(longitude, latitude)
    rng = np.random.default_rng(len(name) + ord(name[0]))
    points = rng.uniform(-1000.0 * KM, 1000.0 * KM, (9000, 2))
    areas = np.exp(rng.normal(5.0, 0.5, 9000)).astype(np.float32)
    shapes = rng.uniform(0.5, 1.0, (9000, 4)).astype(np.float32)
    town = Buildings(np.add(points, (east, north)), areas, shapes)
    away = Buildings(np.add(points[::-1], (east, north + 4600.0)), areas, shapes)
    return Source(ZONES[name], concatenate([town, away]))


PLACES = tuple(Place(name, name, name, name, CENTRES_DEG[name], (KM,), KM) for name in ZONES)
TINY = Plan("test", PLACES, {name: Territory((Circle(*CENTRES_DEG[name], 20.0),)) for name in ZONES})


@pytest.fixture(scope="module")
def grounds(tmp_path_factory: pytest.TempPathFactory) -> Grounds:
    made = Grounds(tmp_path_factory.mktemp("grounds"), TINY, 1, MatcherConfig())
    made.build(invented, lambda _: None)
    return made


def first(kind: str, detail: str = "") -> int:
    """The first trial of a kind."""
    numbers = (n for n in range(4000) if trial(TINY, 1, n).kind == kind)
    return next(n for n in numbers if detail in trial(TINY, 1, n).detail)


def test_a_fifth_of_all_trials_are_controls_of_equal_kinds_everywhere() -> None:
    for plan in (TEST, CALIBRATION):
        drawn = [trial(plan, 1, n) for n in range(4000)]
        assert Counter(one.kind for one in drawn) == {FLIGHT: 3200} | dict.fromkeys(CONTROLS, 100)
        for place in plan.places:
            here = {one.kind for one in drawn if one.place == place}
            assert here == {FLIGHT, *CONTROLS}
        largest = [one.radius_km == one.place.radii_km[-1] for one in drawn if not one.control]
        assert np.mean(largest) == pytest.approx(0.7, abs=0.03)
        # The paper's preset is tried on all kinds alike.
        assert {one.kind for one in drawn if one.paper} == {FLIGHT, *CONTROLS}


def test_a_trial_is_that_of_its_number_seed_and_plan() -> None:
    assert trial(TEST, 1, 77) == trial(TEST, 1, 77)
    one, other = ([trial(TEST, seed, n).buildings for n in range(50)] for seed in (1, 2))
    assert one != other
    assert one != [trial(CALIBRATION, 1, n).buildings for n in range(50)]


def test_grounds_of_calibration_and_test_do_not_touch() -> None:
    for source, epsg in (("boston_osm", 32619), ("tokyo_osm", 32654), ("tokyo_plateau", 32654)):
        mine, theirs = CALIBRATION.territories[source], TEST.territories[source]
        box = (139.65, 35.57, 139.76, 35.67) if epsg == 32654 else (-71.75, 42.1, -70.8, 42.7)
        degrees = np.random.default_rng(1).uniform(box[:2], box[2:], (20_000, 2))
        points = np.column_stack(transformer(CRS(WGS84), CRS(epsg)).transform(*degrees.T))
        ours, tested = mine.holds(points, epsg), theirs.holds(points, epsg)
        assert ours.mean() > 0.1 and tested.mean() > 0.1 and not (ours & tested).any()
        apart, _ = cKDTree(points[ours]).query(points[tested])
        assert apart.min() > 300.0
    assert {p.name for p in CALIBRATION.places}.isdisjoint(p.name for p in TEST.places)


def test_references_of_controls_are_what_they_claim(grounds: Grounds) -> None:
    place = PLACES[0]
    as_is = grounds.reference(place, KM, "as is").buildings
    plain = as_is.centroids_m
    for share in (0.30, 0.60):
        kept = grounds.reference(place, KM, missing_variant(share)).centroids_m
        assert len(kept) / len(plain) == pytest.approx(1.0 - share, abs=0.02)
        assert cKDTree(plain).query(kept)[0].max() == 0.0
    scattered = grounds.reference(place, KM, SCATTERED).buildings
    # Areas stay, the order does not; two of the same area may be taken for each other.
    mine, theirs = np.argsort(as_is.areas_m2), np.argsort(scattered.areas_m2)
    moved = np.hypot(*(plain[mine] - scattered.centroids_m[theirs]).T)
    assert np.median(moved) == pytest.approx(12.5, abs=0.5)
    assert ((moved >= 5.0) & (moved <= 20.0)).mean() > 0.99
    held = cKDTree(grounds.reference(place, KM, GRID).centroids_m)
    present_of = {}
    for town in range(2 * TOWNS):
        houses = grounds.town(place, town).centroids_m
        near = houses[np.hypot(*(houses - grounds.town_site_m(place, town)).T) < 300.0]
        present = present_of[town] = (held.query(near)[0] < 0.01).mean()
        assert present < 0.1 if town >= TOWNS else present > 0.2  # here they overlap, the last one is whole
    assert present_of[TOWNS - 1] == 1.0


def test_a_grid_suburb_agrees_with_itself_one_lot_further() -> None:
    design = GridDesign(20.0, 60.0, 0.2, 0.03, 0.3)
    houses = grid_town(design, np.zeros(2), np.random.default_rng(1)).centroids_m
    middle = houses[np.abs(houses).max(axis=1) < 300.0]
    nearest = houses - middle[0]
    row = nearest[np.argsort(np.hypot(*nearest.T))[1]]  # along the street, one lot on
    away, _ = cKDTree(houses).query(middle + row)
    assert np.hypot(*row) == pytest.approx(20.0, abs=2.0) and (away < 3.0).mean() > 0.9
    other = grid_design(np.random.default_rng(2))
    assert other != design and 17.0 <= other.lot_m <= 26.0


def test_ground_that_is_absent_is_absent(grounds: Grounds) -> None:
    for kind in ("outside", "another city", "mirrored"):
        number = first(kind)
        one = trial(TINY, 1, number)
        tried = attempt(one, grounds)
        assert one.absent and one.control
        distance, _ = cKDTree(tried.database.centroids_m).query(tried.truth_m)
        if kind != "mirrored":
            assert distance > 900.0
    assert trial(TINY, 1, first("grid suburbs", "absent")).absent
    assert not trial(TINY, 1, first("grid suburbs", "present")).absent
    assert other_city(TINY, PLACES[1]) == PLACES[0]


def test_shifts_are_those_of_the_trial() -> None:
    plain = [trial(TEST, 1, n) for n in range(2000) if trial(TEST, 1, n).kind == FLIGHT]
    drawn = {
        sigma: np.array(
            [shift_of(one, np.random.default_rng(one.number)) for one in plain if one.shift_m == sigma]
        )
        for sigma in (0.0, 1.0)
    }
    assert not drawn[0.0].any() and drawn[1.0].std() == pytest.approx(1.0, abs=0.06)
    far = [trial(TEST, 1, n) for n in range(4000) if trial(TEST, 1, n).detail == "by one vector"]
    lengths = [np.hypot(*shift_of(one, np.random.default_rng(1))) for one in far if one.shift_m == 0.0]
    assert min(lengths) >= 5.0 and max(lengths) <= 20.0 and len(lengths) > 10
    assert all(one.town == TOWN_NONE for one in plain)


def test_a_record_tells_the_errors_of_what_was_answered(grounds: Grounds) -> None:
    numbers = [n for n in range(60) if trial(TINY, 1, n).kind == FLIGHT and trial(TINY, 1, n).level == 1]
    large = [n for n in numbers if trial(TINY, 1, n).buildings >= 60][:4]
    records = [run(n, grounds) for n in large]
    fixed = [r for r in records if r["fixed"]]
    assert len(fixed) >= 3  # a dense town of a few km2: the search alone could miss one
    for r in fixed:
        assert r["fix_error_m"] < 15.0 and r["best_error_m"] < 30.0 and r["score"] > 30.0 and r["nees"] > 0.0
        assert r["fix_error_m"] == pytest.approx(np.hypot(r["east_error_m"], r["north_error_m"]))
    again = run(large[0], grounds)
    same = ("fix_error_m", "score", "funnel.log_odds", "var_east_m2")
    assert all(again[name] == records[0][name] or np.isnan(again[name]) for name in same)
    nowhere = run(first("mirrored"), grounds)
    assert not nowhere["fixed"] and nowhere["best_error_m"] in (np.inf,) and np.isnan(nowhere["fix_error_m"])


def test_the_footprints_of_a_run_are_read_once(grounds: Grounds) -> None:
    def never(name: str) -> Source:
        raise AssertionError(name)

    Grounds(Path(grounds.folder), TINY, 1, MatcherConfig()).build(never, lambda _: None)
