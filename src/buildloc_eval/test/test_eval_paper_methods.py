"""The paper's protocol: baselines on cases where they must succeed, scores, kept results, the report."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from buildloc_eval.paper import brm, methods
from buildloc_eval.paper.evaluate import predict_all
from buildloc_eval.paper.flights import EPSG, PaperFlight
from buildloc_eval.paper.flown import Maps, Snapshot
from buildloc_eval.paper.methods import BRM, STARS, Prediction
from buildloc_eval.paper.plan import Models, Plan, Stores, maps_name, ragged
from buildloc_eval.paper.published import FLIGHTS
from buildloc_eval.paper.report import (
    Converged,
    Trial,
    acceptance_table,
    boston,
    convergence_table,
    failure_table,
    failures_one_by_one,
    held,
    recall_table,
    write,
)
from buildloc_eval.paper.scoring import (
    Score,
    bins_within,
    error_row,
    first_and_stable,
    interval,
    lost_by,
    mean_interval,
    rank_of_bin,
    recall_row,
    score,
)
from buildloc_eval.paper.store import StaleError, Store
from buildloc_eval.sections import source_digest
from buildloc_eval.segmentation_errors import SegmentationErrors
from buildloc_matcher.reference.buildings import Buildings
from buildloc_msgs_py.footprint import footprints
from buildloc_msgs_py.types import CameraModel, FrameObservation, Keyframe, LocalMap
from numpy.testing import assert_allclose

CENTRE = np.array([320_000.0, 4_690_000.0])
CAMERA = CameraModel(320, 240, 300.0, 300.0, 159.5, 119.5)
ERRORS = SegmentationErrors(
    1, 0.1, 0.05, 0.05, 100.0, 0.2, 30.0, 0.5, 0.0, 0.2, (0.05, 0.05, 0.05, 0.05), 0.6, 1, 0.1, 0.2, 0.5
)
DOWN = (0.0, 0.0, 0.0, 1.0)


def town(count: int = 3000, half_m: float = 1000.0, seed: int = 1) -> np.ndarray:
    """Houses of many sizes and headings at places drawn apart from each other."""
    rng = np.random.default_rng(seed)
    side = math.ceil(math.sqrt(count))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=2).reshape(-1, 2)[:count]
    places = (grid / side - 0.5) * 2.0 * half_m + rng.uniform(-9.0, 9.0, (count, 2))
    size = rng.uniform(7.0, 22.0, (count, 2)) @ np.diag([1.0, 0.6])
    box = np.array([-0.5 - 0.5j, 0.5 - 0.5j, 0.5 + 0.5j, -0.5 + 0.5j])
    corners = box.real * size[:, :1] + 1j * box.imag * size[:, 1:]
    corners = corners * np.exp(1j * rng.uniform(0, math.pi, count))[:, None] + (places @ (1.0, 1.0j))[:, None]
    outlines = shapely.polygons(np.stack([corners.real, corners.imag], axis=2) + CENTRE)
    return np.asarray(outlines)


def measured(outlines: np.ndarray) -> Buildings:
    found = footprints(outlines)
    return Buildings(found.centroids_m, found.areas_m2.astype(np.float32), found.shapes.astype(np.float32))


def flown_maps(outlines: np.ndarray, keyframes: int = 12, heading_rad: float = 0.7) -> Maps:
    """Faultless maps of a straight flight to the east through CENTRE, turned by a heading."""
    true = CENTRE + np.column_stack([np.linspace(-180.0, 180.0, keyframes), np.zeros(keyframes)])
    found = footprints(outlines)
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    to_map = np.array([[c, -s], [s, c]])  # world -> map: turned by the heading
    poses = (true - CENTRE) @ to_map.T
    snapshots, observations, ratios = [], [], []
    radii = brm.regions(CAMERA, 100.0)
    tree = shapely.STRtree(outlines)
    for n in range(1, keyframes + 1):
        apart = np.hypot(*(found.centroids_m[:, None] - true[None, :n]).transpose(2, 0, 1)).min(axis=1)
        rows = np.flatnonzero(apart < 70.0)
        local_map = LocalMap.whole(
            n, rows.astype(np.int64), (found.centroids_m[rows] - CENTRE) @ to_map.T, found.areas_m2[rows],
            found.shapes[rows], np.full(len(rows), 3, dtype=np.int64),
        )  # fmt: skip
        frames = tuple(Keyframe(i + 1, *poses[i].tolist(), heading_rad) for i in range(n))
        snapshots.append(Snapshot(local_map, frames, tuple(range(n))))
        near = rows[np.hypot(*(found.centroids_m[rows] - true[n - 1]).T) < 40.0]
        observations.append(FrameObservation(n, found.centroids_m[near] - true[n - 1], 100.0))
        ratios.append(
            [_built(outlines, tree, true[n - 1], a, b) for a, b in zip((0.0, *radii[:2]), radii, strict=True)]
        )
    # Image-right is east: the keyframe's yaw in the map is the map's own turn.
    return Maps(tuple(snapshots), tuple(observations), radii, np.array(ratios), true, np.zeros(keyframes))


def _built(outlines: np.ndarray, tree: shapely.STRtree, at: np.ndarray, inner: float, outer: float) -> float:
    ring = shapely.Point(*at).buffer(outer, 64).difference(shapely.Point(*at).buffer(inner, 64))
    return float(shapely.area(shapely.intersection(outlines[tree.query(ring)], ring)).sum() / ring.area)


@pytest.fixture(scope="module")
def outlines() -> np.ndarray:
    return town()


@pytest.fixture(scope="module")
def maps(outlines: np.ndarray) -> Maps:
    return flown_maps(outlines)


def test_the_ratios_of_a_mask_are_those_of_its_rings() -> None:
    mask = np.zeros((240, 320), dtype=np.uint8)
    y, x = np.mgrid[:240, :320]
    radii = brm.regions(CAMERA, 100.0)  # at 1/3 m per pixel: 12.7, 25.3 and 38 m
    assert_allclose(radii, np.array([1, 2, 3]) * 0.95 * 40.0 / 3.0)
    mask[np.hypot(x - 159.5, y - 119.5) < radii[0] * 3.0] = 255
    assert_allclose(brm.coverage(mask, CAMERA, 100.0, DOWN, radii), [1.0, 0.0, 0.0], atol=0.02)
    mask[:, :160] = 255
    assert_allclose(brm.coverage(mask, CAMERA, 100.0, DOWN, radii), [1.0, 0.5, 0.5], atol=0.03)


def test_the_ratio_map_holds_the_built_share_of_the_rings(outlines: np.ndarray) -> None:
    radii = brm.regions(CAMERA, 100.0)
    reference = brm.ratio_map(outlines, CENTRE, 300.0, radii)
    tree = shapely.STRtree(outlines)
    rows = columns = np.array([5, 20, 44])
    for row, column in zip(rows, columns, strict=True):
        (at,) = reference.places_m(np.array([[column, row]], dtype=np.float64))
        truth = [_built(outlines, tree, at, a, b) for a, b in zip((0.0, *radii[:2]), radii, strict=True)]
        # The raster of 2.5 m: the inner region of 500 m2 feels it most.
        assert_allclose(reference.ratios[:, row, column], truth, atol=0.04)


def test_brm_finds_a_flight_of_unknown_heading(outlines: np.ndarray) -> None:
    # Half of the houses: BRM lives on ground that is built here more and there less.
    some = outlines[np.random.default_rng(4).random(len(outlines)) < 0.5]
    maps = flown_maps(some)
    reference = brm.ratio_map(some, CENTRE, 700.0, maps.radii_m)
    found, _ = methods.brm_survivors(reference, maps)
    prediction = methods.brm_prediction(found, 0.1, CENTRE, 0.7)
    result = score(prediction, maps, len(maps.true_m), 0.7)
    assert result.rank == 1 and result.coarse_m < 40.0
    assert not result.fix
    # Within a smaller circle are those of its hypotheses that lie inside.
    inside = found.ranked(maps.true_m[-1], 60.0)
    assert len(inside) and np.hypot(*(inside - maps.true_m[-1]).T).max() <= 60.0


def test_brm_with_impossible_ratios_has_no_survivor(outlines: np.ndarray, maps: Maps) -> None:
    reference = brm.ratio_map(outlines, CENTRE, 300.0, maps.radii_m)
    found = brm.search(reference, np.ones((3, 3)), np.array([[0.0, 0.0], [60.0, 0.0], [120.0, 0.0]]))
    assert len(found.residuals) == 0 and found.ranked(CENTRE, 300.0).shape == (0, 2)
    refused = methods.brm_prediction(found, 0.0, CENTRE, 0.3).refused
    assert refused == "no hypothesis survives"


def test_keyframes_used_by_brm_are_a_step_apart_and_end_with_the_last() -> None:
    path = np.column_stack([np.arange(0.0, 131.0, 10.0), np.zeros(14)])
    assert brm.used_keyframes(path) == [0, 5, 10, 13]


@pytest.mark.parametrize("name", STARS)
def test_every_star_method_finds_a_faultless_map(name: str, outlines: np.ndarray, maps: Maps) -> None:
    database = methods.reference_within(measured(outlines), CENTRE, 0.8)
    assert database.epsg == EPSG and len(database) < len(outlines)
    found = methods.locate(methods.make_matcher(name, database), maps, len(maps.true_m), final=True)
    result = score(found, maps, len(maps.true_m), 0.8)
    assert (result.rank, result.bin_rank, result.lost_by) == (1, 1, "")
    assert result.coarse_m < 5.0 and result.final_m < 2.0
    assert set(found.seconds) >= {"match", "vote", "select", "refine"}


def test_a_flight_without_a_map_is_a_failure_with_its_reason(maps: Maps) -> None:
    @dataclass(frozen=True)
    class Never:
        """A matcher that is not asked."""

    alone = Maps((None,), maps.observations[:1], maps.radii_m, maps.ratios[:1], maps.true_m[:1], np.zeros(1))
    found = methods.locate(Never(), alone, 1, final=True)  # type: ignore[arg-type]
    result = score(found, alone, 1, 1.0)
    assert result == Score(0, math.inf, math.inf, bins_within(1.0), False, str(found.refused))
    assert "no keyframe is mapped" in result.lost_by


def prediction(places: list[list[float]], bins: list[list[int]]) -> Prediction:
    at = np.array(places, dtype=np.float64).reshape(-1, 2)
    ranked = np.array(bins, dtype=np.int32).reshape(-1, 2)
    return Prediction(at, np.zeros_like(at), np.zeros(2), ranked, None, None, {}, {})


def test_the_rank_of_the_true_bin_counts_its_neighbours() -> None:
    found = prediction([[0.0, 0.0]], [[0, 0], [5, 5], [6, 7], [7, 7]])
    assert rank_of_bin(found, np.array([700.0, 710.0]), 6.0) == 3
    assert rank_of_bin(found, np.array([20.0, -30.0]), 6.0) == 1
    # A bin without votes ties for the last of 11,310, as the paper counts them at 6 km.
    assert rank_of_bin(found, np.array([5000.0, 0.0]), 6.0) == 11_310


def test_each_failure_names_the_stage_that_lost_it() -> None:
    found = prediction([[0.0, 0.0]], [[0, 0], [9, 9]])
    assert lost_by(found, 2, 1, 6.0).startswith("ranking")
    assert lost_by(found, 0, 2, 6.0).startswith("selection")
    assert lost_by(found, 0, bins_within(6.0), 6.0).startswith("matching")
    none = prediction([], [])
    assert lost_by(none, 0, bins_within(6.0), 6.0).startswith("voting")
    assert lost_by(methods.nothing("too few"), 0, bins_within(6.0), 6.0) == "too few"


@pytest.mark.parametrize(
    ("right", "first", "stable"),
    [
        ([False, True, False, True, True], 2, 4),
        ([True, True], 1, 1),
        ([True, False], 1, None),
        ([False, False], None, None),
    ],
)
def test_first_and_stable_success(right: list[bool], first: int | None, stable: int | None) -> None:
    assert first_and_stable(right) == (first, stable)


def test_recall_has_an_interval_and_errors_are_of_the_right_ones() -> None:
    scores = [Score(1, 10.0 + n, 4.0, 1, True, "") for n in range(7)]
    assert interval(7, 7) == (0.6457, 1.0)  # "7 of 7" is no certainty
    scores += [
        Score(3, 900.0, math.inf, 3, True, "ranking"),
        Score(0, math.inf, math.inf, 9, False, "matching"),
    ]
    row = recall_row(scores)
    assert (row["recall@1"], row["recall@5"], row["recall@10"]) == (7 / 9, 8 / 9, 8 / 9)
    assert (row["fixes"], row["false fixes"], row["final within 100 m"]) == (8 / 9, 1, 7 / 9)
    assert error_row(scores) == {
        "coarse_median_m": 13.0, "coarse_worst_m": 16.0, "final_median_m": 4.0, "final_worst_m": 4.0,
        "refined": 7,
    }  # fmt: skip
    assert error_row(scores[-1:])["final_median_m"] is None


def test_the_interval_of_a_mean_is_students() -> None:
    assert mean_interval([1.0, 2.0, 3.0]) == [-0.48, 4.48]  # 2 -/+ 4.303 / sqrt(3)
    assert mean_interval([5.0]) is None


def test_convergence_is_over_flights_and_seeds_that_reach_it() -> None:
    ranks = (9, 1, 1)
    traces = [
        Converged("default preset", 6, 1, "flight1", 2, 2, ranks, 2, 9),
        Converged("default preset", 6, 2, "flight1", 4, 6, ranks, 2, 12),
        Converged("default preset", 6, 1, "flight2", 3, None, ranks, 2),
        Converged("default preset", 6, 2, "flight2", None, None, ranks, None),
    ]
    (row,) = convergence_table(traces)
    assert (row["flights"], row["first success"], row["stable success"]) == (4, 3.0, 4.0)
    assert (row["first success, flights"], row["stable success, flights"]) == (3, 2)
    assert row["first success_95%"] == mean_interval([2.5, 4.0])
    assert (row["first accepted fix"], row["first accepted fix, flights"]) == (10.5, 2)
    assert row["by flight, first"] == "flight1: 3.0 (2 to 4), flight2: 3.0 (3 to 3)"
    assert row["by flight, stable"] == "flight1: 4.0 (2 to 6), flight2: never"


def test_a_method_that_was_not_run_at_a_radius_is_told_as_such() -> None:
    right = Score(1, 3.0, 2.0, 1, True, "")
    place = prediction([[0.0, 0.0]], [[0, 0]])
    trials = [Trial("default preset", 6, "flight1", 1, right, place),
              Trial("default preset", 9, "flight1", 1, right, place),
              Trial("paper preset", 6, "flight1", 1, right, place)]  # fmt: skip
    cells = {(row["method"], row["metric"]): row.get("9 km") for row in recall_table(trials, (6, 9))}
    assert cells["paper preset", "R@1"] == "not run"
    assert cells["default preset", "R@1"] == "1.000 [0.21, 1.00] of 1"
    assert [(row["method"], row["radius_km"]) for row in acceptance_table(trials, (6, 9))] == [
        ("paper preset", 6), ("default preset", 6), ("default preset", 9),
    ]  # fmt: skip


def test_after_a_keyframe_that_links_to_nothing_the_last_place_of_the_map_counts(
    outlines: np.ndarray, maps: Maps
) -> None:
    lost = replace(maps, snapshots=(*maps.snapshots[:-1], maps.snapshots[-2]))
    database = methods.reference_within(measured(outlines), CENTRE, 0.8)
    matcher = methods.make_matcher("default preset", database)
    found = methods.locate(matcher, lost, len(maps.true_m), final=True)
    result = score(found, lost, len(maps.true_m), 0.8)
    assert result.rank == 1 and result.final_m < 2.0  # of the last but one, 33 m behind


def test_a_failure_is_told_with_its_funnel() -> None:
    wrong = replace(prediction([[0.0, 0.0]], [[0, 0]]), funnel={"stars": 64.0}, refused="undecided: few")
    right, lost = Score(1, 3.0, 2.0, 1, True, ""), Score(0, 900.0, math.inf, 9, False, "selection: lost")
    trials = [Trial("default preset", 6, "flight1", 1, right, wrong),
              Trial("default preset", 6, "flight1", 2, lost, wrong)]  # fmt: skip
    (row,) = failures_one_by_one(trials, "default preset")
    assert (row["flight"], row["seed"], row["rank"], row["rank of the true bin"]) == ("flight1", 2, None, 9)
    assert (row["lost by"], row["refused"], row["stars"]) == ("selection: lost", "undecided: few", 64.0)
    (row,) = failure_table(trials)
    assert (row["trials"], row["where"], row["stars"], row["looks"]) == (1, "flight1 at 6 km: 1", 64.0, None)


@pytest.mark.parametrize(
    ("bar", "value", "more", "answer"),
    [
        (0.97, 0.98, True, True),
        (0.97, 0.9, True, False),
        (30.0, 20.0, False, True),
        (30.0, None, False, False),
        (None, 0.5, True, None),
    ],
)
def test_a_bar_is_held_by_a_value_alone(
    bar: float | None, value: float | None, more: bool, answer: bool | None
) -> None:
    assert held(bar, value, more) is answer


def test_results_are_kept_whole(tmp_path: Path) -> None:
    store = Store(tmp_path / "stage", {"seed": 1})
    assert not store.has("one")
    store.save("one", {"a": 5})
    assert Store(tmp_path / "stage", {"seed": 1}).load("one") == {"a": 5}
    assert {path.name for path in store.folder.iterdir()} == {"made_by.json", "one.pickle"}


def test_results_of_another_configuration_or_code_are_refused(tmp_path: Path) -> None:
    Store(tmp_path / "stage", {"seed": 1, "code": "a"})
    with pytest.raises(StaleError, match="another code"):
        Store(tmp_path / "stage", {"seed": 1, "code": "b"})
    models, out = Models(ERRORS), tmp_path / "run"
    Stores(out, 1, models)
    with pytest.raises(StaleError, match="another seed"):
        Stores(out, 2, models)


def test_the_code_hash_follows_the_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "some_code.py").write_text("A = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    before = source_digest(["some_code"])
    assert before == source_digest(["some_code"])
    (tmp_path / "some_code.py").write_text("A = 2\n")
    assert source_digest(["some_code"]) != before


def test_a_run_is_predicted_scored_and_reported_and_goes_on_where_it_was(
    tmp_path: Path, outlines: np.ndarray, maps: Maps
) -> None:
    flight = PaperFlight(FLIGHTS[0], (float(CENTRE[0]), float(CENTRE[1])))
    plan, models, said = Plan(("flight1",), 1, (1,), {"default preset": {1: 1}}), Models(ERRORS), list[str]()
    stores = Stores(tmp_path, 1, models)
    stores.ground.save("reference", (ragged(outlines), measured(outlines)))
    stores.maps.save(maps_name(flight, 1), maps)
    predict_all(stores, [flight], plan, 1, said.append)
    made = {path: path.stat().st_mtime_ns for path in stores.predictions.folder.glob("*.pickle")}
    assert len(made) == len(STARS) + 2  # BRM, and the prefixes
    assert any("min left" in line for line in said)
    predict_all(stores, [flight], plan, 1, said.append)
    assert made == {path: path.stat().st_mtime_ns for path in made}
    chapter = boston(tmp_path, stores, [flight], plan, models, 1)
    text = write(tmp_path, [chapter], 1, True, 12.0)
    report = json.loads((tmp_path / "report.json").read_text())
    assert list(report)[:2] == ["evaluation", "what is real"]
    assert [row["what"].split(",")[0] for row in report["bars"]] == ["minutes of this run"]
    said = report[chapter.title]
    assert list(said)[:2] == ["what is real", "not done"]
    recall = {(row["method"], row["metric"]): row for row in said["recall"]}
    assert recall["default preset", "R@1"]["1 km"].startswith("1.000 [0.21, 1.00]")
    assert recall["paper preset", "R@1"]["paper, 1 km"] == "7/7"
    assert recall["NetVLAD (not run)", "R@1"]["paper, 1 km"] == "5/7"
    (trace,) = said["convergence"]
    assert trace["first success"] <= trace["stable success"] <= len(maps.true_m)
    html = (tmp_path / "report.html").read_text()
    assert html.count("<img") == 4 and 'src="http' not in html
    assert html.index("simulated:") < html.index("recall")
    assert "NetVLAD has not been run" in text and BRM in text
