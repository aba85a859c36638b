"""What `buildloc eval beyond` varies is what it says; a small run over an invented town is reported whole."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from browser import open_page
from buildloc_eval.beyond import evaluate
from buildloc_eval.beyond.cases import EVERYWHERE, FACTORS, PRESETS, Case, Reference, ablated
from buildloc_eval.beyond.evaluate import FULL, Plan, cases, draw, spoilt, within
from buildloc_eval.beyond.report import failure_table, row
from buildloc_eval.paper.sources import measure
from buildloc_eval.paper.store import StaleError
from buildloc_eval.realworld import LEXINGTON_DEG
from buildloc_eval.town import suburb
from buildloc_eval.trials import Trial
from buildloc_eval.world import to_utm
from buildloc_matcher.reference.buildings import Buildings
from scipy.spatial import cKDTree

CENTRE = np.array(to_utm(*LEXINGTON_DEG)[1:])
grouped = pytest.mark.xdist_group("eval_beyond")
SHORT = Plan(3, 5, (FACTORS[0], FACTORS[3]))


def outlines() -> np.ndarray:
    return np.asarray(shapely.transform(np.array(suburb(2, 1800.0)), lambda xy: xy + CENTRE))


@pytest.fixture(scope="module")
def buildings() -> Buildings:
    return measure(outlines())


def test_every_case_is_valid_has_its_own_file_and_is_run_once() -> None:
    asked = cases(FULL)
    assert len({case.name for case in asked}) == len(asked)
    assert all("/" not in case.name for case in asked)
    assert EVERYWHERE in asked and replace(EVERYWHERE, preset="paper") in asked
    for preset in PRESETS:
        (_, whole), *others = ablated(preset, 1)
        assert whole == Case(preset)
        assert all(case.config != whole.config or not case.reference.shapes for _, case in others)


def test_a_map_is_the_same_for_all_presets_and_references(buildings: Buildings) -> None:
    ground, case = (buildings, cKDTree(buildings.centroids_m)), Case("default", buildings=40)
    one = draw(case, ground, 5)
    spoilt_too = replace(case, reference=Reference(missing=0.5, shift_m=3.0))
    for other in (replace(case, preset="paper"), spoilt_too):
        np.testing.assert_array_equal(draw(other, ground, 5).local_map.centroids_m, one.local_map.centroids_m)
    low = draw(replace(case, altitude_bias=-0.1), ground, 5)
    np.testing.assert_allclose(low.local_map.centroids_m, 0.9 * one.local_map.centroids_m)
    np.testing.assert_allclose(low.local_map.areas_m2, 0.81 * one.local_map.areas_m2)
    np.testing.assert_array_equal(low.true_m, one.true_m)
    # Without a heading walk the map bends no more than its buildings jitter.
    straight, bent = (draw(replace(case, drift=drift), ground, 5) for drift in (0.0, 80.0))
    assert _misfit_m(straight.local_map.centroids_m, straight.true_m) < 3.0
    assert _misfit_m(bent.local_map.centroids_m, bent.true_m) > 10.0


def _misfit_m(one: np.ndarray, other: np.ndarray) -> float:
    """RMS distance that the best similarity leaves."""
    a, b = ((points - points.mean(axis=0)) @ (1.0, 1.0j) for points in (one, other))
    return float(np.sqrt(np.mean(np.abs(a * np.vdot(a, b) / np.vdot(a, a).real - b) ** 2)))


def test_the_reference_is_spoilt_as_asked(buildings: Buildings) -> None:
    def made(**values: float | bool) -> Buildings:
        return spoilt(buildings, Reference(**values), np.random.default_rng(1))  # type: ignore[arg-type]

    np.testing.assert_array_equal(made().centroids_m, buildings.centroids_m)
    count = len(buildings)
    assert len(made(missing=0.3)) == pytest.approx(0.7 * count, abs=4.0 * math.sqrt(0.21 * count))
    each = made(shift_m=4.0).centroids_m - buildings.centroids_m
    np.testing.assert_allclose(np.hypot(*each.T), 4.0)
    assert np.abs(each.mean(axis=0)).max() < 0.5
    images = made(image_shift_m=5.0).centroids_m - buildings.centroids_m
    np.testing.assert_allclose(np.hypot(*images.T), 5.0)
    assert len(np.unique(np.round(images, 6), axis=0)) == 16  # 1800 m: four by four images of 500 m
    assert len(np.unique(made(shapes=False).shapes)) == 1
    assert len(within(buildings, 0.5)) < count == len(within(buildings, None))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str, list[str]]]:
    """The folder of a short run, its summary and what it said."""
    out, said = tmp_path_factory.mktemp("beyond"), list[str]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "read_boston", outlines)
        patch.setattr(evaluate, "QUICK", SHORT)
        yield out, evaluate.evaluate(out, 1, True, said.append), said


@grouped
@pytest.mark.slow
def test_a_short_run_is_kept_and_reported(run: tuple[Path, str, list[str]]) -> None:
    out, text, said = run
    made = {path: path.stat().st_mtime_ns for path in (out / "trials").glob("*.pickle")}
    assert len(made) == len(cases(SHORT)) and "min left" in said[-1]
    report = json.loads((out / "report.json").read_text())
    drift = report["Drift"]
    assert [(row["value"], row["preset"]) for row in drift] == [(0.0, "default"), (0.0, "paper")]
    # Some thousand houses and no drift: less than all maps would be a defect.
    assert drift[0]["recall@1"] == 1.0 and drift[0]["recall@1_95%"] == [0.4385, 1.0]
    assert {row["level"] for row in report["Without one part"]} == {1, 2}
    assert "simulated" in text and report["versions"]["numba"]
    again = list[str]()
    evaluate.evaluate(out, 1, True, again.append)
    assert again == [] and made == {path: path.stat().st_mtime_ns for path in made}
    with pytest.raises(StaleError, match="another seed"):
        evaluate.evaluate(out, 2, True, again.append)


@grouped
def test_the_report_is_whole_in_a_browser(run: tuple[Path, str, list[str]], tmp_path: Path) -> None:
    page = open_page(run[0] / "report.html", 1280, tmp_path / "report.png", tmp_path / "profile")
    assert page.console == [] and page.wide <= 1280
    assert len(page.images) == 4 and all(image["decoded"] > 100 for image in page.images)
    assert len(page.tables) >= 6 and all(table["height"] > 15 for table in page.tables)


def test_failures_are_told_by_stage_value_and_preset() -> None:
    factor = FACTORS[3]
    by_preset = {preset: factor.of(preset)[:2] for preset in PRESETS}
    right, lost = Trial(1, 2.0, True, {}), Trial(0, 900.0, False, {}, "matching: the true bin had no vote")
    located = {case: (right, lost) for values in by_preset.values() for _, case in values}
    located[by_preset["default"][0][1]] = (right, right)
    rows = failure_table([(factor, by_preset)], located)
    assert [(row["preset"], row["maps"], row["at"]) for row in rows] == [
        ("default", 1, "1.0: 1"), ("paper", 2, "0.0: 1, 1.0: 1"),
    ]  # fmt: skip
    assert row([right, lost])["lost by"] == ["matching: 1"]
