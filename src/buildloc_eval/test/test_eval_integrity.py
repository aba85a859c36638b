"""Trials of the Monte-Carlo: drawn by their number, on grounds that do not touch, as bad as they claim."""

from __future__ import annotations

import argparse
import json
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from buildloc_eval.cli import add_eval_arguments, run_eval
from buildloc_eval.integrity import run as runner
from buildloc_eval.integrity import scoring
from buildloc_eval.integrity.evaluate import plan_of
from buildloc_eval.integrity.grounds import GridDesign, Grounds, Source, grid_design, grid_town
from buildloc_eval.integrity.plan import (
    CALIBRATION,
    CONTROLS,
    FLIGHT,
    GRID,
    PAPER_EVERY,
    SCATTERED,
    TEST,
    TOWN_NONE,
    TOWNS,
    TOWNS_ALIKE,
    Place,
    Plan,
    Territory,
    missing_variant,
    shift_of,
    trial,
)
from buildloc_eval.integrity.report import report_of, write
from buildloc_eval.integrity.trials import attempt, other_city, run
from buildloc_eval.paper.store import StaleError
from buildloc_matcher.calibration import PROTECTED, measured
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.reference.buildings import Buildings, concatenate
from buildloc_matcher.reference.database import MANIFEST, DatabaseError
from buildloc_matcher.reference.region import WGS84, Circle, transformer
from buildloc_msgs_py.errors import BuildlocError
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
    points, others = rng.uniform(-1000.0 * KM, 1000.0 * KM, (2, 9000, 2))
    areas = np.exp(rng.normal(5.0, 0.5, 9000)).astype(np.float32)
    shapes = rng.uniform(0.5, 1.0, (9000, 4)).astype(np.float32)
    town = Buildings(np.add(points, (east, north)), areas, shapes)
    away = Buildings(np.add(others, (east, north + 4600.0)), areas, shapes)
    return Source(ZONES[name], concatenate([town, away]))


PLACES = tuple(Place(name, name, name, name, CENTRES_DEG[name], (KM,), KM) for name in ZONES)
TINY = Plan("test", 5, PLACES, {name: Territory((Circle(*CENTRES_DEG[name], 20.0),)) for name in ZONES})


@pytest.fixture(scope="module")
def grounds(tmp_path_factory: pytest.TempPathFactory) -> Grounds:
    made = Grounds(tmp_path_factory.mktemp("grounds"), TINY, 1, MatcherConfig())
    made.build(invented, lambda _: None)
    return made


def first(kind: str, detail: str = "") -> int:
    """The first trial of a kind."""
    numbers = (n for n in range(4000) if trial(TINY, 1, n).kind == kind)
    return next(n for n in numbers if detail in trial(TINY, 1, n).detail)


@pytest.mark.parametrize(
    ("plan", "flights"), [(TEST, 3200), (CALIBRATION, 2000)], ids=["test", "calibration"]
)
def test_controls_of_equal_kinds_everywhere(plan: Plan, flights: int) -> None:
    drawn = [trial(plan, 1, n) for n in range(4000)]
    kinds = dict.fromkeys(CONTROLS, (4000 - flights) // len(CONTROLS)) | {FLIGHT: flights}
    assert Counter(one.kind for one in drawn) == kinds
    for place in plan.places:
        assert {one.kind for one in drawn if one.place == place} == set(kinds)
    # The paper's preset is tried on all kinds alike.
    assert {one.kind for one in drawn if one.paper} == set(kinds)


def test_most_flights_are_searched_for_in_the_largest_reference() -> None:
    drawn = [trial(TEST, 1, n) for n in range(4000)]
    largest = [one.radius_km == one.place.radii_km[-1] for one in drawn if not one.control]
    assert np.mean(largest) == pytest.approx(0.7, abs=0.03)


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
    for town in range(0, 2 * TOWNS, 5):
        houses = grounds.town(place, town).centroids_m
        present = (held.query(houses)[0] < 0.01).mean()
        assert present < 0.1 if town >= TOWNS else present == 1.0
    assert cKDTree(plain).query(grounds.town(place, 0).centroids_m)[0].min() > 300.0  # beside the city


def test_a_grid_suburb_agrees_with_itself_one_lot_further() -> None:
    plans = ((14.0, 9.0, 0.0), (13.0, 10.0, 3.0))
    design = GridDesign(20.0, 60.0, 0.5, 12, True, plans, 1.0, 0.2, 0.0, 0.03, 0.3)
    houses = grid_town(design, np.zeros(2), np.random.default_rng(1))
    points = houses.centroids_m
    middle = points[np.abs(points).max(axis=1) < 300.0]
    nearest = points - middle[0]
    row = nearest[np.argsort(np.hypot(*nearest.T))[1]]  # along the street, one lot on
    away, _ = cKDTree(points).query(middle + row)
    # But for vacant lots, and those before a street that crosses: one of twelve.
    assert np.hypot(*row) == pytest.approx(20.0, abs=2.0) and 0.8 < (away < 3.0).mean() < 0.92
    # Two plans, and the house at the corners, of which there are two in twelve.
    areas, counts = np.unique(houses.areas_m2, return_counts=True)
    assert len(areas) == 3 and counts[np.argmax(areas)] / len(houses) == pytest.approx(2.0 / 12.0, abs=0.03)


def test_designs_differ_between_suburbs_that_are_not_alike(grounds: Grounds) -> None:
    drawn = [grid_design(np.random.default_rng(seed)) for seed in range(50)]
    assert len({one.lot_m for one in drawn}) == 50 and {one.corners for one in drawn} == {False, True}
    assert {one.stagger for one in drawn} > {0.0, 0.5} and {one.mirrored for one in drawn} == {0.0, 0.5}
    sizes = [len(np.unique(grounds.town(PLACES[0], town).areas_m2)) for town in range(TOWNS)]
    largest = [grounds.town(PLACES[0], town).areas_m2.max() for town in range(TOWNS)]
    assert min(sizes) >= 2 and len(set(largest)) == TOWNS // TOWNS_ALIKE


def test_ground_that_is_absent_is_absent(grounds: Grounds) -> None:
    for kind in ("outside", "another city", "mirrored"):
        number = first(kind)
        one = trial(TINY, 1, number)
        tried = attempt(one, grounds)
        assert one.absent and one.control
        distance, _ = cKDTree(tried.database.centroids_m).query(tried.camera_m)
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


def test_references_of_another_format_are_refused(grounds: Grounds, tmp_path: Path) -> None:
    kept = Grounds(shutil.copytree(grounds.folder, tmp_path / "grounds"), TINY, 1, MatcherConfig())
    assert len(kept.reference(PLACES[0], KM, "as is")) > 100
    for manifest in kept.folder.glob(f"*/{MANIFEST}"):
        manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"version": 2}))
    with pytest.raises(DatabaseError, match="has version 2, not 3"):
        kept.reference(PLACES[1], KM, "as is")


@pytest.fixture(scope="module")
def records(grounds: Grounds) -> pd.DataFrame:
    """Trials that the paper's preset is tried on too: flights and controls of both towns."""
    return pd.DataFrame([run(n, grounds) for n in range(0, 30 * PAPER_EVERY, PAPER_EVERY)])


def test_where_the_papers_argmax_is_wrong_ours_is_right_or_has_no_fix(records: pd.DataFrame) -> None:
    assert records.absent.sum() >= 2 and (~records.control).sum() >= 20
    wrong = records[records.paper_answers.astype(bool) & ~(records.paper_error_m <= 100.0)]
    assert records[records.absent].number.isin(wrong.number).all()  # it always answers
    assert not scoring.is_false(records).any()
    flights = records[~records.control]
    assert (flights.fixed & (flights.fix_error_m <= 100.0)).sum() >= 0.5 * len(flights)
    rows = scoring.beside_paper(records)
    assert [row["false"] for row in rows if row["method"] == "ours"] == [0, 0]
    assert sum(row["false"] for row in rows if row["method"] != "ours") == len(wrong) > 0


def test_the_report_is_made_of_the_trials(records: pd.DataFrame, tmp_path: Path) -> None:
    report = report_of(records, TINY, 30_000, 1, real="simulated: two invented towns")
    said = write(tmp_path, report, records)
    kept = json.loads((tmp_path / "report.json").read_text())
    assert kept["trials"] == len(records) and kept["false fixes"] == []
    # No false fix, but in fewer trials than the bar is of: neither met nor missed, up to the rule of three.
    zero = kept["bars"][0]
    assert zero["met"] == "-" and zero["reached"]["95%"] == [0.0, 3.0 / len(records)]
    assert sum(row["trials"] for row in kept["controls"]) == records.control.sum()
    fixes = scoring.consistent(records)
    assert kept["consistency"][0]["fixes"] == len(fixes) > 10
    assert any("horizontal error" in row["what"] and row["met"] == "met" for row in kept["bars"])
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 5 and "two invented towns" in page
    assert "two invented towns" in said and "false" in said


def test_shares_have_exact_intervals_and_nothing_has_the_rule_of_three() -> None:
    assert scoring.share(0, 300) == {"share": 0.0, "of": 300, "95%": [0.0, 0.01]}
    half = scoring.share(5, 10)
    assert half["95%"] == pytest.approx([0.187, 0.813], abs=1e-3)  # Clopper and Pearson's own table
    assert scoring.share(0, 0)["share"] is None


def made_up(**columns: Any) -> pd.DataFrame:
    """Four trials: a right fix, a refinement led astray, an accepted wrong place, a control refused."""
    rows = {
        "number": [0, 1, 2, 4], "place": "town", "kind": [FLIGHT, FLIGHT, FLIGHT, "outside"], "detail": "",
        "control": [False, False, False, True], "absent": [False, False, False, True], "radius_km": 12.0,
        "buildings": 60, "level": 1, "shift_m": 0.0, "fixed": [True, True, True, False],
        "score": [40.0, 30.0, 20.0, 1.0], "false_fix_probability": [1e-9, 1e-6, 1e-5, 0.1],
        "best_error_m": [5.0, 6.0, 900.0, np.inf], "fix_error_m": [1.0, 150.0, 901.0, np.nan],
        "candidate_error_m": [[5.0], [6.0], [900.0, 4.0], [np.inf]],
        "candidate_jaccard": [[0.6]] * 4, "candidate_pairs": [[40]] * 4, "candidate_rms_m": [[2.0]] * 4,
        "funnel.log_odds": 50.0, "funnel.lead": 30.0, "reason": ["", "", "", "undecided: score 1.0 nats"],
        "nees": [0.5, 30.0, 900.0, np.nan], "var_east_m2": 4.0, "var_north_m2": 1.0, "cov_east_north_m2": 0.0,
    }  # fmt: skip
    return pd.DataFrame(rows | columns)


def test_false_fixes_are_counted_and_told_apart() -> None:
    trials = made_up()
    assert scoring.is_false(trials).tolist() == [False, True, True, False]
    reasons = [row["reason"] for row in scoring.false_rows(trials)]
    assert "refinement led away" in reasons[0] and "true place was candidate 2" in reasons[1]
    lost = scoring.false_rows(made_up(absent=True, kind="outside", fix_error_m=np.inf))
    assert len(lost) == 3 and all("not in the reference" in row["reason"] for row in lost)
    assert scoring.bars(trials, 4)[0]["met"] == "missed"
    none_false = trials[~scoring.is_false(trials)]
    assert [scoring.bars(none_false, asked)[0]["met"] for asked in (2, 4)] == ["met", "-"]


def test_the_curve_trades_availability_for_false_fixes() -> None:
    rows = {row["threshold"]: row for row in scoring.our_curve(made_up(), 15.0)}
    assert rows[15.0]["false fixes"] == 2 and rows[15.0]["availability"]["share"] == pytest.approx(1.0 / 3.0)
    assert rows[0.0]["false fixes"] == 3  # the control's best candidate, which the score refused
    refused = scoring.our_curve(made_up(fixed=[True, False, False, False]), 15.0)
    assert [row["false fixes"] for row in refused if row["threshold"] == 15.0] == [0]


def test_consistency_counts_errors_within_their_bounds() -> None:
    turned = {"var_east_m2": 2.5, "var_north_m2": 2.5, "cov_east_north_m2": 1.5}  # axes of 2 and 1 m
    row = scoring.consistency(made_up(**turned))[0]  # of the one right fix
    assert row["fixes"] == 1 and row["within 95 % bound"]["share"] == 1.0
    radius = measured().errors.radius(PROTECTED)
    assert row["median protection level_m"] == pytest.approx(2.0 * radius)
    reliability = scoring.tail_reliability(made_up())
    assert reliability[0]["observed"] == scoring.share(2, 2)  # trials 2 and 4 have a wrong best candidate
    assert reliability[-1] == {"claimed": 1e-5, "observed": scoring.share(1, 2)}
    odds = {row["nats"]: row["observed right"]["share"] for row in scoring.odds_reliability(made_up())}
    assert odds == {"0 to 2": 0.0, "20 to inf": pytest.approx(2.0 / 3.0)}


def test_a_run_goes_on_where_it_was_and_refuses_what_another_seed_made(
    tmp_path: Path, grounds: Grounds, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[range] = []

    def here(_: Grounds, chunks: list[range]) -> Iterator[tuple[range, pd.DataFrame]]:
        for chunk in chunks:
            ran.append(chunk)
            yield chunk, pd.DataFrame({"number": list(chunk)})

    monkeypatch.setattr(runner, "_side_by_side", here)
    monkeypatch.setattr(Grounds, "build", lambda *_: None)
    assert len(runner.run_all(tmp_path, TINY, 150, 1, lambda _: None)) == 150
    assert ran == [range(100), range(100, 150)]
    told: list[str] = []
    assert len(runner.run_all(tmp_path, TINY, 250, 1, told.append)) == 250
    assert ran[2:] == [range(100, 200), range(200, 250)] and told[-1].startswith("250 of 250")
    assert runner.run_all(tmp_path, TINY, 50, 1, lambda _: None).number.tolist() == list(range(50))
    with pytest.raises(StaleError, match="another seed"):
        runner.run_all(tmp_path, TINY, 50, 2, lambda _: None)


def test_the_command_knows_plans_and_trials() -> None:
    parser = argparse.ArgumentParser()
    add_eval_arguments(parser)
    asked = parser.parse_args(["integrity", "--out", "x", "--plan", "calibration", "--trials", "3000"])
    assert (asked.plan, asked.trials) == ("calibration", 3000)
    with pytest.raises(BuildlocError, match="are of `eval integrity`"):
        run_eval(parser.parse_args(["scale", "--out", "x", "--trials", "3"]))
    with pytest.raises(SystemExit):
        parser.parse_args(["integrity", "--out", "x", "--trials", "0"])
    quick = plan_of("test", quick=True)
    assert {place.city for place in quick.places} == {"Boston", "Tokyo"} and quick.name != TEST.name
